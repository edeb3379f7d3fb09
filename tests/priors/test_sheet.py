"""The contact sheet: every view of the store, with its labels and shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from d2_plugin.captures.synthetic.room import synthetic_capture
from d2_plugin.errors import D2Error
from d2_plugin.priors.fuse import FusedPrior
from d2_plugin.priors.sheet import LABEL_COLORS, contact_sheet, depth_colors, label_colors
from d2_plugin.priors.store import PriorStore
from d2_plugin.protocol import Label

cv2 = pytest.importorskip("cv2")


def test_the_sheet_shows_picture_depth_and_labels_of_every_view(tmp_path: Path) -> None:
    capture = synthetic_capture(cameras=2, held_out=0, frames=2, width=64, height=36)
    store = PriorStore.create(tmp_path / "priors", list(capture.cameras), capture.frames, {"capture": capture.name})
    for camera in capture.cameras:
        labels = np.full((36, 64), Label.MONO, np.uint8)
        labels[:, 32:] = Label.CONFLICT
        depth = np.where(labels == Label.MONO, capture.depth(camera, 0), 0)
        sigma = np.where(labels == Label.MONO, 0.05, np.inf).astype(np.float32)
        prior = FusedPrior(depth, labels, sigma, capture.image(camera, 0))
        record = {"shares": prior.shares(), "refused": "", "monocular": "maps"}
        store.write(camera, 0, prior, record)
    sheet = cv2.imread(str(contact_sheet(store, capture, tmp_path / "out" / "sheet.png", width=64)))[..., ::-1]
    assert sheet.shape == (2 * (36 + 18), 3 * 64, 3)
    row = sheet[18 : 18 + 36]
    np.testing.assert_allclose(row[:, :64].astype(int), capture.image("train0", 0), atol=1)
    assert tuple(row[10, 2 * 64 + 10]) == LABEL_COLORS[Label.MONO]
    assert tuple(row[10, 2 * 64 + 50]) == LABEL_COLORS[Label.CONFLICT]
    assert not row[:, 64 + 32 : 128].any()
    with pytest.raises(D2Error, match="no prior at frames 1"):
        contact_sheet(store, capture, tmp_path / "none.png", frames=[1])


def test_near_is_red_far_is_blue_and_empty_is_black() -> None:
    depth = np.array([[1.0, 10.0, 0.0]])
    red, blue, black = depth_colors(depth)[0].astype(int)
    assert red[0] > 2 * red[2]
    assert blue[2] > blue[0]
    assert not black.any()
    assert not depth_colors(np.zeros((2, 2))).any()


def test_each_label_has_its_own_colour() -> None:
    colors = label_colors(np.array([list(Label)]))
    assert len({tuple(color) for color in colors[0]}) == len(Label)
