"""kornia as a yardstick: our colours against the field's library, where both define the same."""

import numpy as np
import pytest
import torch

from d2_plugin.runs.drawing import color_scale

kornia = pytest.importorskip("kornia", reason="kornia is in the `test` extra")


def test_viridis_is_kornias_within_a_shade() -> None:
    theirs = kornia.color.ColorMap("viridis", 256, device=torch.device("cpu"), dtype=torch.float64).colors.T
    difference = np.abs(color_scale("viridis") / 255 - theirs.numpy())
    assert difference.max() < 0.08  # nine anchors, straight lines between them
    assert difference.mean() < 0.01
