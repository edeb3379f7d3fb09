"""kornia as a yardstick: our lenses and colours against the field's library, where both define the same."""

import numpy as np
import pytest
import torch

from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.runs.drawing import color_scale

kornia = pytest.importorskip("kornia", reason="kornia is in the `test` extra")

K = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])


@pytest.mark.parametrize("coefficients", [(0.1, 0.02, 0.0, 0.0, 0.0), (-0.2, 0.05, 0.001, -0.002, -0.01)])
def test_a_lens_bends_as_kornias(coefficients: tuple[float, ...]) -> None:
    k1, k2, p1, p2, k3 = coefficients
    pixels = np.random.default_rng(0).uniform((0, 0), (640, 480), (200, 2))
    ours = Lens(K, "opencv", (k1, k2, p1, p2, k3)).recorded_pixels(pixels)
    theirs = kornia.geometry.calibration.distort_points(*map(torch.tensor, (pixels, K, np.array(coefficients))))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_viridis_is_kornias_within_a_shade() -> None:
    theirs = kornia.color.ColorMap("viridis", 256, device=torch.device("cpu"), dtype=torch.float64).colors.T
    difference = np.abs(color_scale("viridis") / 255 - theirs.numpy())
    assert difference.max() < 0.08  # nine anchors, straight lines between them
    assert difference.mean() < 0.01
