"""The stand-in for the 4D rasterizer, beside our own slices and published numbers."""

import math

import numpy as np
import pytest
import torch
from rasterizer_arguments import gaussians, inria_camera
from slice_scenes import GOLDEN
from splat_scenes import single
from torch import Tensor

from d2_plugin.compat import fourd
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.spherical_harmonics import colors as harmonic_colors

FOUR = {"sh_degree_t": 2, "timestamp": 0.3, "time_duration": 1.0, "rot_4d": True, "gaussian_dim": 4}


def four_dimensional(count: int = 6, seed: int = 0) -> dict[str, Tensor]:
    values, g = gaussians(count, seed, 48), torch.Generator().manual_seed(seed + 1)
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
        arguments = {
            "means3D": torch.tensor([mean], dtype=torch.float64),
            "means2D": torch.zeros(1, 3),
            "opacities": torch.tensor([[0.9]], dtype=torch.float64),
            "colors_precomp": torch.ones(1, 3, dtype=torch.float64),
            "ts": torch.tensor([[t0]], dtype=torch.float64),
            "scales": torch.tensor([scales[:3]], dtype=torch.float64),
            "scales_t": torch.tensor([scales[3:]], dtype=torch.float64),
            "rotations": left / left.norm(),
            "rotations_r": right / right.norm(),
        }
        at = {**camera, **FOUR, "timestamp": t, "force_sh_3d": False}
        raster = fourd.GaussianRasterizer(fourd.GaussianRasterizationSettings(**at))
        *_, covariances = raster(**arguments)
        np.testing.assert_allclose(covariances[0], covariance, atol=1e-8)
        expected = fourd.inria.GaussianRasterizer(fourd.inria.GaussianRasterizationSettings(**camera))(
            torch.tensor([sliced], dtype=torch.float64),
            torch.zeros(1, 3),
            torch.tensor([[0.9 * marginal]], dtype=torch.float64),
            colors_precomp=arguments["colors_precomp"],
            cov3D_precomp=torch.tensor([covariance], dtype=torch.float64),
        )[0]
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
        *_, alpha, _, _ = raster(
            scene.means,
            torch.zeros(1, 3),
            scene.opacities[:, None],
            colors_precomp=scene.colors,
            ts=torch.tensor([[0.25]]),
            scales=torch.full((1, 3), 0.1, dtype=torch.float64),
            scales_t=torch.tensor([[0.4]]),
            rotations=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        )
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
        with pytest.raises(D2Error, match="4D Gaussians need ts and scales_t"):
            raster(**gaussians())
