"""The PLY of one instant: what viewers of 3DGS read is what the backbone draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from d2_plugin.gaussians.moving import Harmonics, MovingGaussians
from d2_plugin.gaussians.spherical_harmonics import SH_C0
from d2_plugin.viewing.export.ply import scales_and_rotations, write_ply


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """(header lines, structured rows), read as a viewer does."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("ascii").splitlines()
    names = [line.split()[2] for line in header if line.startswith("property float")]
    return header, np.frombuffer(data[end:], dtype=[(name, "<f4") for name in names])


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices [M, 3, 3] of unit quaternions [M, 4], w first."""
    w, x, y, z = quaternions.T
    entries = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(entries), -1, 0)


def gaussians(count: int, seed: int = 0, spread: float = 3.0) -> tuple[torch.Tensor, ...]:
    """Random means, covariances, colours, opacities, and the covariances as matrices."""
    generator = torch.Generator().manual_seed(seed)
    factors = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    scales = torch.exp(spread * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5))
    matrices = factors @ torch.diag_embed(scales**2) @ factors.mT
    packed = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    means, colors = torch.randn(count, 3, generator=generator), torch.rand(count, 3, generator=generator)
    return means, packed, colors, torch.rand(count, generator=generator), matrices


def written(path: Path, *parts: torch.Tensor) -> tuple[list[str], np.ndarray]:
    """Header and rows of a file of means, covariances, colours and opacities."""
    means, covariances, colors, opacities = (part.double() for part in parts)
    still = MovingGaussians(means, covariances, opacities, Harmonics((colors[:, None] - 0.5) / SH_C0, 0))
    write_ply(path, still, scales_and_rotations(covariances))
    return read_ply(path)


def test_a_viewer_reads_back_the_gaussians(tmp_path: Path) -> None:
    means, covariances, colors, opacities, matrices = gaussians(50)
    opacities = 0.02 + 0.9 * opacities
    path = tmp_path / "frame_00000.ply"
    header, rows = written(path, means, covariances, colors, opacities)
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 50" in header
    order = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert list(rows.dtype.names) == order.split()
    assert path.stat().st_size == len("\n".join(header)) + 1 + 50 * 17 * 4
    np.testing.assert_array_equal(np.stack([rows["x"], rows["y"], rows["z"]], -1), means.numpy())
    f_dc = np.stack([rows[f"f_dc_{i}"] for i in range(3)], -1)
    np.testing.assert_allclose(0.5 + SH_C0 * f_dc, colors.numpy(), atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows["opacity"])), opacities.numpy(), atol=1e-6)
    scales = np.exp(np.stack([rows[f"scale_{i}"] for i in range(3)], -1).astype(float))
    quaternions = np.stack([rows[f"rot_{i}"] for i in range(4)], -1).astype(float)
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    R = rotations(quaternions)
    rebuilt = R @ (scales[:, :, None] ** 2 * R.transpose(0, 2, 1))
    size = np.abs(matrices.numpy()).max(axis=(1, 2), keepdims=True)
    assert (np.abs(rebuilt - matrices.numpy()) / size).max() < 2e-6


def test_harmonics_lie_where_viewers_look(tmp_path: Path) -> None:
    """After the constant one all coefficients of red, then of green, then of blue."""
    means, covariances, _, _, _ = gaussians(5)
    coefficients = torch.randn(5, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    still = MovingGaussians(means.double(), covariances, torch.full((5,), 0.5).double(), Harmonics(coefficients, 3))
    write_ply(tmp_path / "a.ply", still, scales_and_rotations(covariances))
    _, rows = read_ply(tmp_path / "a.ply")
    for place in range(45):
        expected = coefficients[:, 1 + place % 15, place // 15].numpy()
        np.testing.assert_allclose(rows[f"f_rest_{place}"], expected, rtol=1e-6)


def test_what_no_rasterizer_draws_is_left_out(tmp_path: Path) -> None:
    means, covariances, colors, _, _ = gaussians(6)
    opacities = torch.tensor([0.5, 1 / 254, 1 / 256, 0.0, 1.0, 0.5])
    means[5, 1] = torch.nan
    _, rows = written(tmp_path / "a.ply", means, covariances, colors, opacities)
    np.testing.assert_array_equal(rows["x"], means[[0, 1, 4], 0].numpy())
    assert np.isfinite(np.array(rows.tolist())).all()  # an opacity of 1 too has a logit
    header, rows = written(tmp_path / "a.ply", means, covariances, colors, 0 * opacities)
    assert "element vertex 0" in header
    assert len(rows) == 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 12))
def test_rotations_are_right_handed_and_rebuild_the_covariance(seed: int, spread: float) -> None:
    _, covariances, _, _, matrices = gaussians(8, seed, spread)
    scales, quaternions = scales_and_rotations(covariances)
    R = torch.from_numpy(rotations(quaternions.numpy()))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(8, dtype=torch.float64))
    rebuilt = R @ torch.diag_embed(scales**2) @ R.mT
    size = matrices.abs().amax(dim=(1, 2), keepdim=True)
    assert ((rebuilt - matrices).abs() / size).max() < 1e-10


def test_flat_and_round_gaussians_have_finite_scales() -> None:
    flat = torch.tensor([[1.0, 0, 0, 1.0, 0, 0], [1.0, 0, 0, 1.0, 0, 1.0], [1e-30, 0, 0, 1e-30, 0, 1e-30]]).double()
    flat[0, 5] = -1e-8  # rounding of a float32 covariance
    scales, quaternions = scales_and_rotations(flat)
    assert torch.isfinite(scales.log()).all()
    assert torch.isfinite(quaternions).all()
    torch.testing.assert_close(scales[1], torch.ones(3, dtype=torch.float64))
