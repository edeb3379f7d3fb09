"""The bundled Yang-style backbone: what it draws, how it grows, what it leaves out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import TinyFrames, is_finite, make_model, make_trainer, make_views, parameters

from d2_plugin.backbones.densify import DensifySettings, grow, prune
from d2_plugin.backbones.starting import nearest_neighbour_scales
from d2_plugin.backbones.trainer import Trainer, TrainSettings
from d2_plugin.backbones.yang4d import create
from d2_plugin.gaussians import spherical_harmonics as sh
from d2_plugin.gaussians.photometric import photometric_loss


class TestSlice:
    def test_a_new_gaussian_stands_still_and_fades_over_a_fifth_of_the_duration(self) -> None:
        rows = (torch.rand(9, 3), torch.rand(9, 3), torch.full((9,), 0.3))
        model = create(*rows, extent=1.0, duration=1.0, temporal=True)
        early, late = (model.slice_at(replace(make_views()[0], time=time)) for time in (0.28, 0.32))
        torch.testing.assert_close(early.means, late.means)
        torch.testing.assert_close(early.covariances, late.covariances)
        expected = torch.sigmoid(model.gaussians["opacity_logits"]) * torch.exp(torch.tensor(-0.5 * 0.02**2 / 0.2))
        torch.testing.assert_close(late.opacities, expected)


class TestInitialScales:
    def test_is_the_root_mean_square_distance_to_three_neighbours(self) -> None:
        positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 0, 0]])
        expected = math.sqrt((1 + 4 + 9) / 3)
        assert nearest_neighbour_scales(positions)[0].item() == pytest.approx(expected)


class TestColour:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_basis_is_orthonormal_over_the_sphere(self, degree: int) -> None:
        z, weight = np.polynomial.legendre.leggauss(16)
        phi = np.arange(32) * 2 * math.pi / 32
        radius = np.sqrt(1 - z**2)
        grid = np.stack([np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi)), np.outer(z, np.ones(32))], -1)
        values = sh.basis(torch.from_numpy(grid.reshape(-1, 3)), degree)
        gram = (values * torch.from_numpy(np.repeat(weight, 32) * 2 * math.pi / 32)[:, None]).T @ values
        torch.testing.assert_close(gram, torch.eye((degree + 1) ** 2, dtype=torch.float64))

    def test_constant_colours_survive_the_coefficients(self) -> None:
        rgb, directions = torch.rand(7, 3), torch.randn(7, 3)
        for degree, time_degree in ((0, 0), (2, 0), (1, 2)):
            coefficients = sh.coefficients_from_rgb(rgb, degree, time_degree)
            assert coefficients.shape == (7, sh.channel_count(degree, time_degree), 3)
            phase = torch.rand(7)
            torch.testing.assert_close(sh.colors(coefficients, directions, phase, degree, time_degree), rgb)

    def test_time_modulates_with_the_cosine_of_the_phase(self) -> None:
        coefficients = torch.zeros(1, sh.channel_count(0, 1), 3)
        coefficients[:, 1] = 0.4 / sh.SH_C0
        color = sh.colors(coefficients, torch.ones(1, 3), torch.tensor([1 / 6]), 0, 1)
        torch.testing.assert_close(color, torch.full((1, 3), 0.5 + 0.4 * math.cos(math.pi / 3)))


class TestPhotometricLoss:
    def test_passes_gradcheck(self) -> None:
        generator = torch.Generator().manual_seed(0)
        image, target = torch.rand(2, 12, 13, 3, dtype=torch.float64, generator=generator)
        assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target), image.requires_grad_())


class TestDensityControl:
    def test_small_gaussians_are_cloned_and_large_ones_split_into_two(self) -> None:
        model = make_model()
        with torch.no_grad():
            model.gaussians["log_scales"][:30] = math.log(1e-3)
            model.gaussians["log_scales"][30:] = math.log(0.1)
        model.gaussians.statistics["screen_gradient"][[0, 40]] = 1.0
        model.gaussians.statistics["seen"].fill_(1)
        before = parameters_of(model)
        grow(model, DensifySettings(gradient=0.5), torch.Generator().manual_seed(0))
        after = parameters_of(model)
        assert len(model) == 62, "one clone; one parent replaced by two children"
        assert torch.equal(after["positions"][-3], before["positions"][0])
        torch.testing.assert_close(after["log_scales"][-2:], before["log_scales"][[40, 40]] - math.log(1.6))
        assert not (after["positions"] == before["positions"][40]).all(-1).any(), "the parent is gone"

    def test_growth_stops_at_the_budget(self) -> None:
        model = make_model()
        model.gaussians.statistics["screen_gradient"].fill_(1)
        model.gaussians.statistics["seen"].fill_(1)
        grow(model, DensifySettings(gradient=0.5, budget=64), torch.Generator())
        assert len(model) == 64

    def test_transparent_and_huge_gaussians_are_pruned(self) -> None:
        model = make_model()
        with torch.no_grad():
            model.gaussians["opacity_logits"][3] = -10
            model.gaussians["log_scales"][5, 1] = 10
        prune(model)
        assert len(model) == 58


def test_every_training_view_is_used_once_per_round() -> None:
    trainer = make_trainer()
    count = len(TinyFrames().views)
    assert sorted(trainer._next_view() for _ in range(count)) == list(range(count))


@pytest.mark.parametrize("settings", [{}, {"sh_degree": 1, "sh_time_degree": 2}])
@pytest.mark.parametrize("temporal", [True, False])
def test_every_variant_trains_and_grows(settings: dict[str, object], temporal: bool) -> None:
    points = torch.rand(3, 60, 3, generator=torch.Generator().manual_seed(0))
    growth = {"start": 0.0, "stop": 1.0, "every": 7, "gradient": 1e-3}
    model = create(
        points[0] + torch.tensor([-0.5, -0.5, 2.5]), points[1], points[2, :, 0] / 2, extent=2.0, duration=0.5,
        temporal=temporal, settings=settings | {"densify": growth},
    )  # fmt: skip
    trainer = Trainer(model, TinyFrames(), TrainSettings(iterations=30))
    trainer.run()
    assert is_finite(trainer)
    assert len(model) > 60


def parameters_of(model) -> dict[str, torch.Tensor]:
    return parameters(type("Holder", (), {"model": model})())
