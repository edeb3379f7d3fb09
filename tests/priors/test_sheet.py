"""The contact sheet: every view of the store, with its labels and shares."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

from d2_plugin.priors.sheet import LABEL_COLORS, UNKNOWN, contact_sheet, depth_colors, sigma_colors
from d2_plugin.protocol import Label
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.maps import FusedPrior
from d2_plugin.store.store import PriorStore

cv2 = pytest.importorskip("cv2")


def test_the_sheet_shows_image_depth_and_labels_of_every_view(tmp_path: Path) -> None:
    recording = synthetic_recording(cameras=2, held_out=0, frames=2, width=64, height=36)
    store = PriorStore.create(
        tmp_path / "priors", list(recording.cameras), recording.frames, {"recording": recording.name}
    )
    for camera in recording.cameras:
        labels = np.full((36, 64), Label.MONO, np.uint8)
        labels[:, 32:] = Label.CONFLICT
        labels[:8] = Label.FAR
        depth = np.where(labels == Label.CONFLICT, 0, recording.depth(camera, 0))
        sigma = np.where(labels == Label.MONO, 0.05, np.inf).astype(np.float32)
        prior = FusedPrior(depth, labels, sigma, recording.image(camera, 0))
        record = {"shares": prior.shares(), "refused": "", "monocular": "maps"}
        store.write(camera, 0, prior, record)
    sheet = cv2.imread(str(contact_sheet(store, recording, tmp_path / "out" / "sheet.png", width=64)))[..., ::-1]
    assert sheet.shape == (18 + 2 * (18 + 36), 4 * 64, 3)
    row = sheet[36 : 36 + 36]
    np.testing.assert_allclose(row[:, :64].astype(int), recording.image("train0", 0), atol=1)
    assert tuple(row[10, 2 * 64 + 10]) == LABEL_COLORS[Label.MONO]
    assert tuple(row[10, 2 * 64 + 50]) == LABEL_COLORS[Label.CONFLICT]
    assert not row[8:, 64 + 32 : 128].any()
    assert (row[:8, 64:] == LABEL_COLORS[Label.FAR]).all()
    expected = sigma_colors(np.full((1, 1), 0.05), np.ones((1, 1)))[0, 0].astype(int)
    shown = row[8:, 3 * 64 : 3 * 64 + 32].astype(int)
    np.testing.assert_allclose(shown, np.broadcast_to(expected, shown.shape), atol=3)
    assert not row[8:, 3 * 64 + 32 :].any()
    refuses("no prior at frames 1", contact_sheet, store, recording, tmp_path / "none.png", frames=[1])


def test_near_is_red_far_is_blue_and_empty_is_black() -> None:
    red, blue, black = depth_colors(np.array([[1.0, 10.0, 0.0]]))[0].astype(int)
    assert red[0] > 2 * red[2]
    assert blue[2] > blue[0]
    assert not black.any()


def test_sigma_is_brighter_where_it_is_larger_grey_where_unknown_and_black_without_a_depth() -> None:
    sigma = np.array([[0.0, 1e-3, 0.01, 0.1, 0.5, np.inf, 0.1]])
    *known, unknown, empty = sigma_colors(sigma, np.array([[1.0] * 6 + [0.0]]))[0].astype(int)
    brightness = np.sum(known, axis=1)
    assert (np.diff(brightness[1:]) > 0).all()
    assert 0 < brightness[0] <= brightness[1], "a certain depth is not shown as none"
    assert tuple(unknown) == UNKNOWN
    assert not empty.any()
