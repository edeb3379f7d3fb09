"""The drop-in modules: the signatures of the Inria family, the numbers of this plugin's rasterizer."""

import logging
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterizer_arguments import gaussians, inria_camera, view_24x16
from refusals import refuses
from splat_scenes import random_scene, single
from torch import Tensor

from d2_plugin.compat import depth, inria, nearest, vision
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.photometric import ssim
from d2_plugin.protocol import Splats, View
from d2_plugin.rasterizer import rasterize


class TestThreeDGS:
    def test_draws_what_the_plugin_s_rasterizer_draws(self, camera: dict) -> None:
        scene = random_scene(3, 40, 24, 16)
        given = {"means3D": scene.means, "opacities": scene.opacities[:, None], "means2D": torch.zeros(40, 3)}
        raster = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera))
        color, radii = raster(**given, colors_precomp=scene.colors, cov3D_precomp=scene.covariances)
        expected = rasterize(scene.splats, scene.colors, scene.view, background=camera["bg"].double())
        torch.testing.assert_close(color, expected.color.permute(2, 0, 1), atol=1e-6, rtol=1e-6)
        assert radii.dtype == torch.int32
        assert color.is_contiguous(), "trainers call `.view(-1)`"

    def test_camera_is_recovered_from_the_two_matrices(self) -> None:
        turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = turn * torch.linalg.det(turn), torch.tensor([0.3, -0.2, 1.5])
        K = torch.tensor([[300.0, 0, 150.25], [0, 310.0, 95.5], [0, 0, 1]])
        view = View("", 0, 0.0, pose, K, 320, 180)
        result = inria.view_of(inria.GaussianRasterizationSettings(**inria_camera(view)))
        torch.testing.assert_close(result.K, K, atol=1e-4, rtol=0)
        torch.testing.assert_close(result.T_camera_world, pose.float(), atol=1e-6, rtol=0)

    def test_matrices_may_come_as_a_batch_of_one(self, camera: dict) -> None:
        """As in the cameras that 4DGaussians makes for PanopticSports."""
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

    def test_scales_and_rotations_are_the_covariance(self, camera: dict) -> None:
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
        round_ones = torch.tensor([[0.01, 0, 0, 0.01, 0, 0.01]]).repeat(4, 1)
        _, radii = raster(
            means, torch.zeros(4, 3), torch.ones(4, 1), colors_precomp=torch.ones(4, 3), cov3D_precomp=round_ones
        )
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
        with pytest.raises(D2Error, match="either shs or colors_precomp, got both: give exactly one"):
            raster(**values, colors_precomp=torch.ones(6, 3))
        refuses("scales and rotations together", raster, **{**values, "scales": None})
        with pytest.raises(D2Error, match="antialiasing needs the original"):
            inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**camera, antialiasing=True))


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
        pairs, nearest.PAIRS = nearest.PAIRS, 64  # in several parts
        try:
            result = nearest.distCUDA2(torch.from_numpy(points))
        finally:
            nearest.PAIRS = pairs
        np.testing.assert_allclose(result, self.brute(points.astype(np.float64)), rtol=1e-6, atol=1e-12)

    def test_one_point_or_none_has_no_distance(self) -> None:
        assert nearest.distCUDA2(torch.rand(1, 3)).tolist() == [0.0]
        assert nearest.distCUDA2(torch.rand(0, 3)).tolist() == []
        refuses(r"points have shape \(4, 2\), expected \[N, 3\]", nearest.distCUDA2, torch.rand(4, 2))


class TestSSIM:
    def test_is_the_mean_over_the_batch_of_3dgs_similarity(self) -> None:
        a = torch.rand(2, 3, 20, 24, generator=torch.Generator().manual_seed(0)).requires_grad_()
        b = a.detach().roll(1, -1)
        result = vision.fused_ssim(a, b)
        each = [ssim(x.permute(1, 2, 0), y.permute(1, 2, 0)) for x, y in zip(a, b)]
        torch.testing.assert_close(result, torch.stack(each).mean())
        assert vision.fused_ssim(a, a.detach()).item() == pytest.approx(1.0, abs=1e-5)
        result.backward()
        assert a.grad.abs().sum() > 0

    def test_another_padding_is_refused(self) -> None:
        with pytest.raises(D2Error, match="this stand-in has 'same' only"):
            vision.fused_ssim(torch.rand(1, 3, 12, 12), torch.rand(1, 3, 12, 12), padding="valid")
