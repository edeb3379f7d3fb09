"""The PLY of one instant: what viewers of 3DGS read is what the backbone draws."""

from pathlib import Path

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.export_files import covariances_from, read_still_ply

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.checkpoints import read_ply
from d2_plugin.viewing.checkpoints.files import columns
from d2_plugin.viewing.export.ply import scales_and_rotations, write_ply


def gaussians(count: int, seed: int = 0, spread: float = 3.0) -> tuple[torch.Tensor, ...]:
    """Random means, covariances, colours and opacities."""
    generator = torch.Generator().manual_seed(seed)
    factors = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    scales = torch.exp(spread * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5))
    matrices = factors @ torch.diag_embed(scales**2) @ factors.mT
    packed = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    means, colors = torch.randn(count, 3, generator=generator), torch.rand(count, 3, generator=generator)
    return means, packed, colors, torch.rand(count, generator=generator)


def write(path: Path, *parts: torch.Tensor) -> None:
    """A file of means, covariances, colours and opacities."""
    means, covariances, colors, opacities = (part.double() for part in parts)
    still = MovingGaussians(means, covariances, opacities, Harmonics((colors[:, None] - 0.5) / SH_C0, 0))
    write_ply(path, still, scales_and_rotations(covariances))


def off(rebuilt: torch.Tensor, true: torch.Tensor) -> float:
    """The largest difference of covariances [M, 6] in sizes of theirs."""
    return float(((rebuilt - true).abs() / true.abs().amax(1, keepdim=True)).max())


def test_a_viewer_reads_back_the_gaussians(tmp_path: Path) -> None:
    means, covariances, colors, opacities = gaussians(50)
    opacities = 0.02 + 0.9 * opacities
    path = tmp_path / "frame_00000.ply"
    write(path, means, covariances, colors, opacities)
    header = path.read_bytes().partition(b"end_header\n")[0].decode("ascii").splitlines()
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 50" in header
    order = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert [line for line in header if "property" in line] == [f"property float {name}" for name in order.split()]
    rotations = columns(read_ply(path), "rot")
    torch.testing.assert_close(rotations.norm(dim=1), torch.ones(50))
    read = read_still_ply(path)
    assert torch.equal(read.positions, means.double())
    torch.testing.assert_close(0.5 + SH_C0 * read.harmonics.coefficients[:, 0], colors.double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(read.opacities, opacities.double(), atol=1e-6, rtol=0)
    assert off(read.covariances, covariances) < 2e-6


def test_harmonics_lie_where_viewers_look(tmp_path: Path) -> None:
    """After the constant one all coefficients of red, then of green, then of blue."""
    means, covariances, *_ = gaussians(5)
    coefficients = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    still = MovingGaussians(means.double(), covariances, torch.full((5,), 0.5).double(), Harmonics(coefficients, 3))
    write_ply(tmp_path / "a.ply", still, scales_and_rotations(covariances))
    rest = coefficients[:, 1:].transpose(1, 2).flatten(1)
    torch.testing.assert_close(columns(read_ply(tmp_path / "a.ply"), "f_rest"), rest.float())


def test_what_no_rasterizer_draws_is_left_out(tmp_path: Path) -> None:
    means, covariances, colors, _ = gaussians(6)
    opacities = torch.tensor([0.5, 1 / 254, 1 / 256, 0.0, 1.0, 0.5])
    means[5, 1] = torch.nan
    write(tmp_path / "a.ply", means, covariances, colors, opacities)
    rows = read_ply(tmp_path / "a.ply")
    assert torch.equal(rows["x"], means[[0, 1, 4], 0])
    assert all(torch.isfinite(column).all() for column in rows.values()), "an opacity of 1 too has a logit"
    write(tmp_path / "a.ply", means, covariances, colors, 0 * opacities)
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 12))
def test_rotations_rebuild_the_covariance(seed: int, spread: float) -> None:
    _, covariances, *_ = gaussians(8, seed, spread)
    assert off(covariances_from(*scales_and_rotations(covariances)), covariances) < 1e-10


def test_flat_and_round_gaussians_have_finite_scales() -> None:
    flat = torch.tensor([[1.0, 0, 0, 1.0, 0, 0], [1.0, 0, 0, 1.0, 0, 1.0], [1e-30, 0, 0, 1e-30, 0, 1e-30]]).double()
    flat[0, 5] = -1e-8  # rounding of a float32 covariance
    scales, quaternions = scales_and_rotations(flat)
    assert torch.isfinite(scales.log()).all()
    assert torch.isfinite(quaternions).all()
    torch.testing.assert_close(scales[1], torch.ones(3, dtype=torch.float64))
