"""The drop-in modules: the signatures of the rasterizers of Inria's family, SpacetimeGaussians and Ex4DGS, with the
numbers of this plugin's; and what stands in for torchvision, mmcv, pytorch3d and faiss."""

import logging
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mimics.ex4dgs import opacity_compensation
from mimics.inria import Camera
from rasterizer_arguments import gaussians, inria_camera, view_24x16
from refusals import refuses
from slice_scenes import GOLDEN
from splat_scenes import random_scene, single
from torch import Tensor

from d2_plugin.compat import depth, ex4dgs, fourd, inria, kinematic, nearest, spacetime, vision
from d2_plugin.compat.python_config import Config
from d2_plugin.gaussians.photometric import ssim
from d2_plugin.gaussians.rotation4d import rotation_matrices_3d
from d2_plugin.gaussians.spherical_harmonics import colors as harmonic_colors
from d2_plugin.protocol import RasterSettings, Splats, View
from d2_plugin.rasterizer import rasterize, reference


@pytest.fixture
def scene():
    return random_scene(3, 40, 24, 16)


class TestThreeDGS:
    def test_draws_what_the_plugin_s_rasterizer_draws(self, camera: dict, scene) -> None:
        given = {"means3D": scene.means, "opacities": scene.opacities[:, None], "means2D": torch.zeros(40, 3)}
        raster = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))
        color, radii = raster(**given, colors_precomp=scene.colors, cov3D_precomp=scene.covariances)
        expected = rasterize(scene.splats, scene.colors, scene.view, background=camera["bg"].double())
        torch.testing.assert_close(color, expected.color.permute(2, 0, 1), atol=1e-6, rtol=1e-6)
        assert radii.dtype == torch.int32
        assert color.is_contiguous(), "trainers call `.view(-1)`"

    def test_camera_is_recovered_from_the_two_matrices(self, camera: dict) -> None:
        turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = turn * torch.linalg.det(turn), torch.tensor([0.3, -0.2, 1.5])
        K = torch.tensor([[300.0, 0, 150.25], [0, 310.0, 95.5], [0, 0, 1]])
        view = View("", 0, 0.0, pose, K, 320, 180)
        result = inria.view_of(inria.GaussianRasterizationSettings(**inria_camera(view)))
        torch.testing.assert_close(result.K, K, atol=1e-4, rtol=0)
        torch.testing.assert_close(result.T_camera_world, pose.float(), atol=1e-6, rtol=0)
        # A batch of one, as in the cameras that 4DGaussians makes for PanopticSports.
        batched = {**camera, "viewmatrix": camera["viewmatrix"][None], "projmatrix": camera["projmatrix"][None]}
        result = inria.view_of(inria.GaussianRasterizationSettings(**batched))
        torch.testing.assert_close(result.K, view_24x16().K, atol=1e-5, rtol=0)

    def test_passes_gradcheck(self, camera: dict) -> None:
        raster = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))
        values = gaussians(4)
        names = [name for name in values if name != "means2D"]

        def color(*tensors: Tensor) -> Tensor:
            return raster(means2D=values["means2D"].detach(), **dict(zip(names, tensors)))[0]

        assert torch.autograd.gradcheck(color, [values[name] for name in names], atol=1e-6, fast_mode=True)

    def test_gradient_of_viewspace_points_is_per_normalised_device_coordinate(self, camera: dict) -> None:
        """densify_grad_threshold is in that unit: pixels times half the image's width and height."""
        values, weights = gaussians(), torch.linspace(-1, 1, 3 * 16 * 24, dtype=torch.float64).view(3, 16, 24)
        raster = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))
        (raster(**values)[0] * weights).sum().backward()
        offsets = torch.zeros(6, 2, dtype=torch.float64, requires_grad=True)
        covariances = inria.covariances_of(values["scales"], values["rotations"], 1.0)
        splats = Splats(values["means3D"], covariances, values["opacities"][:, 0], torch.arange(6))
        seen = inria.colors_of(values["shs"], 3, values["means3D"], camera["campos"])
        image = rasterize(splats, seen, view_24x16(), background=camera["bg"].double(), screen_offsets=offsets).color
        (image.permute(2, 0, 1) * weights).sum().backward()
        expected = torch.nn.functional.pad(offsets.grad * torch.tensor([12.0, 8.0]), (0, 1))
        assert expected.abs().sum() > 0
        torch.testing.assert_close(values["means2D"].grad, expected, atol=1e-5, rtol=1e-4)

    def test_scales_and_rotations_are_the_covariance(self) -> None:
        """R S S^T R^T, with the modifier on the scales; a longer quaternion scales the Gaussian, as in CUDA."""
        scales, turned = torch.tensor([[0.1, 0.2, 0.4]]), torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])
        result = inria.covariances_of(scales, turned, 2.0)
        torch.testing.assert_close(result, 4 * torch.tensor([[0.04, 0, 0, 0.01, 0, 0.16]]), atol=1e-7, rtol=1e-6)
        longer = inria.covariances_of(scales, torch.tensor([[2.0, 0, 0, 0.0]]), 1.0)
        torch.testing.assert_close(longer, inria.covariances_of(scales, torch.tensor([[1.0, 0, 0, 0]]), 1.0))
        oblique = inria.covariances_of(scales, torch.tensor([[0.0, 0, 0, 2.0]]), 1.0)
        torch.testing.assert_close(oblique[0, 0], torch.tensor(0.01 * 49))  # (1 - 2 z^2) = -7

    def test_radius_is_three_deviations_and_zero_where_nothing_is_drawn(self, camera: dict) -> None:
        raster = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))
        means = torch.tensor([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 0.2], [50, 0, 2.0]])
        given = {"colors_precomp": torch.ones(4, 3), "cov3D_precomp": torch.tensor([[0.01, 0, 0, 0.01, 0, 0.01]] * 4)}
        _, radii = raster(means, torch.zeros(4, 3), torch.ones(4, 1), **given)
        variance = (0.85 * 24 * 0.1 / 2) ** 2 + 0.3
        assert radii.tolist() == [math.ceil(3 * math.sqrt(variance + math.sqrt(0.1))), 0, 0, 0]
        assert raster.markVisible(means).tolist() == [True, False, False, True]

    def test_a_field_of_view_of_minus_one_is_mended_and_said(self, camera: dict, caplog) -> None:
        """fudan-zvg/4d-gaussian-splatting issue 64: tanfov = tan(-0.5) where fl_x is given."""
        values = gaussians()
        right = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))(**values)[0]
        broken = {**camera, "tanfovx": math.tan(-0.5), "tanfovy": math.tan(-0.5)}
        inria.warn_once.cache_clear()
        with caplog.at_level(logging.WARNING):
            result = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**broken))(**values)[0]
        torch.testing.assert_close(result, right, atol=0, rtol=0)
        assert "the projection matrix has 20.4" in caplog.text

    def test_mistakes_are_one_sentence(self, camera: dict) -> None:
        raster, values = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera)), gaussians()
        refuses("either shs or colors_precomp, got both: give", raster, **values, colors_precomp=torch.ones(6, 3))
        refuses("scales and rotations together", raster, **{**values, "scales": None})
        settings = inria.GaussianRasterizationSettings(**camera, antialiasing=True)
        refuses("antialiasing needs the original", inria.GaussianRasterizer, settings)


class TestDepth:
    def test_depth_is_not_normalised_and_has_gradients(self) -> None:
        scene = single(depth=4.0, opacity=0.5, size=15)
        raster = depth.GaussianRasterizer(depth.GaussianRasterizationSettings(**inria_camera(scene.view)))
        means = scene.means.requires_grad_()
        given = {"colors_precomp": scene.colors, "cov3D_precomp": scene.covariances}
        _, _, result = raster(means, torch.zeros(1, 3), scene.opacities[:, None], **given)
        assert result[0, 7, 7].item() == pytest.approx(0.5 * 4.0, rel=1e-4)
        result[0, 7, 7].backward()
        assert float(means.grad[0, 2]) == pytest.approx(0.5, rel=0.1)

    def test_the_gradient_for_densification_is_the_signed_one_and_the_log_says_so(self, camera: dict, caplog) -> None:
        """means2D_densify of Deformable-3D-Gaussians, which sums absolute values in the original."""
        inria.warn_once.cache_clear()
        raster, values = depth.GaussianRasterizer(depth.GaussianRasterizationSettings(**camera)), gaussians()
        densify = torch.zeros_like(values["means2D"]).requires_grad_()
        color, *_ = raster(**values, means2D_densify=densify)
        color.square().sum().backward()
        assert densify.grad.any()
        torch.testing.assert_close(values["means2D"].grad, densify.grad)
        assert caplog.text.count("--densify_grad_threshold 0.0002") == 1


class TestNearest:
    @staticmethod
    def brute(points: np.ndarray) -> np.ndarray:
        squared = ((points[:, None] - points[None]) ** 2).sum(-1)
        np.fill_diagonal(squared, np.inf)
        return np.sort(squared, 1)[:, : min(3, len(points) - 1)].mean(1)

    @settings(max_examples=40)
    @given(st.integers(2, 60), st.integers(0, 1000), st.sampled_from(["even", "line", "outliers", "repeated"]))
    def test_is_the_mean_of_the_three_smallest_squared_distances(self, count: int, seed: int, kind: str) -> None:
        points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
        if kind == "line":
            points[:, 1:] = 0
        elif kind == "outliers":
            points[::7] *= 1e5
        elif kind == "repeated":
            points[count // 2 :] = points[: count - count // 2]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("d2_plugin.gaussians.nearest.GROUP", 8)  # in several parts
            result = nearest.distCUDA2(torch.from_numpy(points))
        np.testing.assert_allclose(result, self.brute(points.astype(np.float64)), rtol=1e-6, atol=1e-12)

    @pytest.mark.parametrize("size", [1e-25, 1.0, 1e25], ids=["vanishing squares", "usual", "infinite squares"])
    def test_distances_are_those_of_all_pairs_and_few_are_looked_at(self, size: float, monkeypatch) -> None:
        points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0))
        points[::300] *= 1e5
        points *= size
        cdist, looked = torch.cdist, []
        monkeypatch.setattr(torch, "cdist", lambda a, b, **how: (looked.append(len(a) * len(b)), cdist(a, b, **how))[1])
        distances, indices = nearest.nearest(points, points, 4)
        every = cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        assert torch.equal(distances, every.topk(4, largest=False).values)
        assert torch.equal(distances, every.gather(1, indices))
        assert size != 1 or sum(looked) < every.numel() / 3

    def test_one_point_or_none_has_no_distance(self) -> None:
        assert nearest.distCUDA2(torch.rand(1, 3)).tolist() == [0.0]
        assert nearest.distCUDA2(torch.rand(0, 3)).tolist() == []
        refuses(r"points have shape \(4, 2\), expected \[N, 3\]", nearest.distCUDA2, torch.rand(4, 2))


class TestSSIM:
    def test_is_the_mean_over_the_batch_of_3dgs_similarity_and_another_padding_is_refused(self) -> None:
        a = torch.rand(2, 3, 20, 24, generator=torch.Generator().manual_seed(0)).requires_grad_()
        b = a.detach().roll(1, -1)
        result = vision.fused_ssim(a, b)
        each = [ssim(x.permute(1, 2, 0), y.permute(1, 2, 0)) for x, y in zip(a, b)]
        torch.testing.assert_close(result, torch.stack(each).mean())
        assert vision.fused_ssim(a, a.detach()).item() == pytest.approx(1.0, abs=1e-5)
        result.backward()
        assert a.grad.abs().sum() > 0
        refuses("this stand-in has 'same' only", vision.fused_ssim, a, b, padding="valid")


FOUR = {"sh_degree_t": 2, "timestamp": 0.3, "time_duration": 1.0, "rot_4d": True, "gaussian_dim": 4}


def four_dimensional(count: int = 6) -> dict[str, Tensor]:
    values, g = gaussians(count, 0, 48), torch.Generator().manual_seed(1)
    values["rotations"] = torch.nn.functional.normalize(values["rotations"].detach(), dim=-1).requires_grad_()
    right = torch.nn.functional.normalize(torch.randn(count, 4, generator=g, dtype=torch.float64), dim=-1)
    values["ts"] = torch.full((count, 1), 0.25, dtype=torch.float64, requires_grad=True)
    values["scales_t"] = torch.full((count, 1), 0.4, dtype=torch.float64, requires_grad=True)
    return {**values, "rotations_r": right.requires_grad_()}


class TestFourD:
    @pytest.mark.parametrize("name", GOLDEN)
    def test_slices_like_the_cuda_source(self, camera: dict, name: str) -> None:
        mean, t0, scales, left, right, t, sliced, covariance, marginal, _, _ = GOLDEN[name]
        left, right = (torch.tensor([q], dtype=torch.float64) for q in (left, right))
        numbers = {"opacities": [0.9], "ts": [t0], "scales": scales[:3], "scales_t": scales[3:], "means3D": mean}
        arguments = {name: torch.tensor([value], dtype=torch.float64) for name, value in numbers.items()}
        arguments |= {"means2D": torch.zeros(1, 3), "colors_precomp": torch.ones(1, 3, dtype=torch.float64)}
        arguments |= {"rotations": left / left.norm(), "rotations_r": right / right.norm()}
        at = {**camera, **FOUR, "timestamp": t, "force_sh_3d": False}
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**at))
        *_, covariances = raster(**arguments)
        np.testing.assert_allclose(covariances[0], covariance, atol=1e-8)
        numbers = {"means3D": sliced, "opacities": [0.9 * marginal], "cov3D_precomp": covariance}
        three = {name: torch.tensor([value], dtype=torch.float64) for name, value in numbers.items()}
        three |= {name: arguments[name] for name in ("means2D", "colors_precomp")}
        expected = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))(**three)[0]
        torch.testing.assert_close(raster(**arguments)[0], expected, atol=1e-5, rtol=1e-5)

    def test_passes_gradcheck_through_time(self, camera: dict) -> None:
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**camera, **FOUR, force_sh_3d=False))
        values = four_dimensional(4)
        names = [name for name in values if name != "means2D"]

        def outputs(*tensors: Tensor) -> tuple[Tensor, ...]:
            color, _, depth, alpha, _, _ = raster(means2D=None, **dict(zip(names, tensors)))
            return color, depth, alpha

        assert torch.autograd.gradcheck(outputs, [values[name] for name in names], atol=1e-6, fast_mode=True)

    def test_gaussians_outside_their_support_are_skipped(self, camera: dict) -> None:
        """F <= 0.05 is beyond 2.4477 standard deviations; no radius, no covariance, no gradient."""
        values = four_dimensional(2)
        sigma = 0.4  # scales differ, so does the temporal deviation; far beyond all of them for row 1
        values["ts"] = torch.tensor([[0.3], [0.3 + 100 * sigma]], dtype=torch.float64, requires_grad=True)
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**camera, **FOUR, force_sh_3d=False))
        color, radii, *_, covariances = raster(**values)
        color.sum().backward()
        assert radii[1] == 0
        assert not covariances[1].any()
        assert not values["means3D"].grad[1].any()
        assert covariances[0].any()

    def test_harmonics_in_time_join_at_the_full_degree_only(self, camera: dict) -> None:
        values = four_dimensional()

        def colors(degree: int) -> Tensor:
            four = fourd.GaussianRasterizationSettings(**{**camera, **FOUR, "sh_degree": degree}, force_sh_3d=False)
            rows = torch.arange(6)
            return fourd.GaussianRasterizer(four)._colors(values["shs"], values["means3D"], values["ts"], rows)

        phase = (values["ts"][:, 0] - 0.3) / 1.0
        directions = values["means3D"] - camera["campos"]
        torch.testing.assert_close(colors(3), harmonic_colors(values["shs"], directions, phase, 3, 2))
        torch.testing.assert_close(colors(2), harmonic_colors(values["shs"][:, :9], directions, None, 2, 0))

    def test_without_a_right_quaternion_scale_t_is_the_variance(self, camera: dict) -> None:
        flat = {**camera, **FOUR, "rot_4d": False, "timestamp": 0.65, "force_sh_3d": True, "sh_degree": 0}
        scene = single(depth=2.0, opacity=0.8)
        view = inria_camera(scene.view)
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**{**flat, **view, "sh_degree": 0}))
        shape = {"scales": torch.full((1, 3), 0.1, dtype=torch.float64), "scales_t": torch.tensor([[0.4]])}
        shape |= {"rotations": torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64), "ts": torch.tensor([[0.25]])}
        given = scene.means, torch.zeros(1, 3), scene.opacities[:, None]
        *_, alpha, _, _ = raster(*given, colors_precomp=scene.colors, **shape)
        assert float(alpha[0, 7, 7]) == pytest.approx(0.8 * math.exp(-0.5 * 0.4**2 / 0.4), rel=1e-4)

    def test_flow_is_composited_like_a_colour(self, camera: dict) -> None:
        values = four_dimensional()
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**camera, **FOUR, force_sh_3d=False))
        flow_2d = torch.tensor([[1.0, -2.0]], dtype=torch.float64).repeat(6, 1).requires_grad_()
        color, _, _, alpha, flow, _ = raster(**values, flow_2d=flow_2d)
        torch.testing.assert_close(flow, torch.cat([alpha, -2 * alpha]))
        torch.testing.assert_close(color, raster(**values, flow_2d=torch.zeros(6, 2))[0])
        flow.sum().backward()
        assert flow_2d.grad.abs().sum() > 0

    def test_missing_time_is_one_sentence(self, camera: dict) -> None:
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**camera, **FOUR, force_sh_3d=False))
        refuses("4D Gaussians need ts and scales_t", raster, **gaussians())


class TestSpacetime:
    @pytest.mark.parametrize("channels", [3, 9])
    def test_draws_as_many_channels_as_there_are_on_the_reference(self, camera: dict, scene, channels: int) -> None:
        """The lite trainer gives nine background values for three channels (train.py:90)."""
        colors = torch.rand(40, channels, generator=torch.Generator().manual_seed(1)).to(scene.means)
        settings = spacetime.GaussianRasterizationSettings(**{**camera, "bg": torch.zeros(9)})
        color, radii, depths = spacetime.GaussianRasterizer(settings)(
            means3D=scene.means, means2D=torch.zeros(40, 3), opacities=scene.opacities[:, None],
            colors_precomp=colors, cov3D_precomp=scene.covariances,
        )  # fmt: skip
        splats = Splats(*(value.double() for value in scene.splats[:3]), scene.splats.rows)
        expected = reference.rasterize(splats, colors.double(), scene.view, RasterSettings())
        torch.testing.assert_close(color.double(), expected.color.permute(2, 0, 1), atol=1e-5, rtol=1e-5)
        seen = expected.alpha > 0.5
        assert 0 < seen.sum() < seen.numel()
        assert (depths[0][~seen] == 15.0).all()
        mean = (expected.depth_sum / expected.alpha)[seen]
        torch.testing.assert_close(depths[0][seen].double(), mean, atol=1e-4, rtol=1e-4)
        assert not depths.requires_grad
        assert radii.shape == (40,)


class TestEx4DGS:
    KERNEL = 0.1

    def drawn(self, camera: dict, scene, dir3D=None, **changed):
        known = {key: value for key, value in camera.items() if key not in ("antialiasing", "debug")}
        settings = ex4dgs.GaussianRasterizationSettings(
            **known, kernel_size=self.KERNEL, subpixel_offset=torch.zeros(16, 24, 2), max_depth=100.0, **changed
        )
        return ex4dgs.GaussianRasterizer(settings)(
            means3D=scene.means, means2D=torch.zeros(40, 3), dir3D=dir3D, opacities=scene.opacities[:, None],
            colors_precomp=scene.colors, cov3D_precomp=scene.covariances,
        )  # fmt: skip

    def test_is_the_reference_with_compensated_opacities(self, camera: dict, scene) -> None:
        color, _, depths, flow, acc, _ = self.drawn({**camera, "bg": torch.zeros(3)}, scene)
        stand = Camera(scene.view, torch.zeros(16, 24, 3))
        means, covariances = scene.means.float(), scene.covariances.float()
        projected = torch.cat([means, torch.ones(40, 1)], 1) @ stand.full_proj_transform
        inside = (projected[:, :2] / projected[:, 3:]).abs().amax(1) <= 1.3
        factor = opacity_compensation(means, covariances, stand, self.KERNEL).double() * inside
        opacities = scene.opacities.double() * factor
        splats = Splats(scene.means.double(), scene.covariances.double(), opacities, scene.splats.rows)
        expected = reference.rasterize(splats, scene.colors.double(), scene.view, RasterSettings(blur=self.KERNEL))
        torch.testing.assert_close(color.double(), expected.color.permute(2, 0, 1), atol=2e-3, rtol=1e-3)
        covered = expected.alpha > 0.1
        mean = (expected.depth_sum / expected.alpha)[covered]
        torch.testing.assert_close(depths[0][covered].double(), mean, atol=1e-2, rtol=1e-2)
        assert (depths[0][acc[0] == 0] == 100.0).all()
        assert not flow.any()

    def test_the_gradient_of_the_flow_reaches_the_directions_alone(self, camera: dict, scene) -> None:
        """train.py:148 replaces it by errors, whose weighted sums it reads from `viewspace_l1points.grad`."""
        scene.means.requires_grad_(True)
        directions = torch.zeros(40, 3, dtype=scene.means.dtype, requires_grad=True)
        _, _, _, flow, acc, _ = self.drawn(camera, scene, directions)
        flow.register_hook(lambda gradient: acc.detach().expand(3, -1, -1).contiguous())
        (flow.mean() * 0).backward()
        assert scene.means.grad is None or not scene.means.grad.any()
        total = directions.grad[:, 0].sum()  # sum over Gaussians of w acc / acc
        torch.testing.assert_close(total, acc.sum().to(total), atol=1e-3, rtol=1e-3)


class TestPackages:
    def test_images_go_there_and_back(self, tmp_path: Path) -> None:
        from PIL import Image

        image = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
        vision.save_image(image, tmp_path / "a.png")
        again = vision.ToTensor()(Image.open(tmp_path / "a.png"))
        torch.testing.assert_close(again, image, atol=0.5 / 255 + 1e-6, rtol=0)
        grid = vision.make_grid([image, image], nrow=2)
        assert grid.shape == (3, 5 + 4, 2 * (7 + 2) + 2)
        assert torch.equal(grid[:, 2:7, 2:9], image)
        assert torch.equal(vision.make_grid(image[None]), image)  # as torchvision: one has no frame
        assert vision.resize(image, (10, 14)).shape == (3, 10, 14)

    def test_a_python_configuration_lies_over_its_base(self, tmp_path: Path) -> None:
        (tmp_path / "base.py").write_text("A = dict(x=1, y=dict(z=2))\nB = 3\n")
        (tmp_path / "own.py").write_text("import math\n_base_ = './base.py'\nA = dict(y=dict(w=math.pi))\n")
        config = Config.fromfile(tmp_path / "own.py")
        assert config["A"] == {"x": 1, "y": {"z": 2, "w": np.pi}}
        assert config.A.y.z == 2
        assert config.B == 3


class TestKinematic:
    """What cem-4dgs calls of pytorch3d and of faiss on a GPU."""

    @staticmethod
    def rotations(seed: int) -> torch.Tensor:
        values = torch.randn(50, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return torch.nn.functional.normalize(values, dim=-1)

    def test_quaternions_turn_points_as_their_matrices_do(self) -> None:
        a, b, points = self.rotations(1), self.rotations(2), self.rotations(3)[:, :3]
        A, B, AB = (rotation_matrices_3d(q.T).permute(2, 0, 1) for q in (a, b, kinematic.quaternion_multiply(a, b)))
        torch.testing.assert_close(kinematic.quaternion_apply(a, points), (A @ points[..., None])[..., 0])
        torch.testing.assert_close(AB, A @ B)
        assert (kinematic.quaternion_multiply(a, b)[:, 0] >= 0).all()
        back = kinematic.quaternion_apply(kinematic.quaternion_invert(a), kinematic.quaternion_apply(a, points))
        torch.testing.assert_close(back, points)
        one = kinematic.quaternion_apply(a[:1], points)  # for many points
        torch.testing.assert_close(one, kinematic.quaternion_apply(a[:1].expand(50, 4), points))


def test_nearest_points_are_those_of_all_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    """By pytorch3d's knn and by faiss on a GPU."""
    monkeypatch.setattr("d2_plugin.gaussians.nearest.GROUP", 8)  # in several parts
    points, queries = torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0))
    distances = torch.cdist(queries, points)
    index = nearest.GpuIndexFlatL2(nearest.StandardGpuResources(), 3)
    index.add(points[:20].numpy())
    index.add(points[20:].numpy())
    squared, found = index.search(queries.numpy(), 1)
    assert np.array_equal(found[:, 0], distances.argmin(1))
    np.testing.assert_allclose(squared[:, 0], distances.amin(1).square(), rtol=1e-4)
    own, other = nearest.knn(2, points[None], points[None], False)[0].long()
    assert torch.equal(own, torch.arange(50))
    assert torch.equal(other, torch.cdist(points, points).fill_diagonal_(9).argmin(1))
