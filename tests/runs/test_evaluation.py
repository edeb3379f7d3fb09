"""Evaluation: the right means, honest depth errors, images that can be looked at."""

import json
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from prior_cases import showing
from refusals import refuses
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import read_image
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import select_cameras
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs import drawing, metrics
from d2_plugin.runs.evaluation import RenderView, evaluate, evaluate_scene
from d2_plugin.runs.scene import Scene
from d2_plugin.runs.settings import RunSettings

NAMES = ["test0", "test1"]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return select_cameras(synthetic_recording(cameras=3, frames=2, width=72, height=40), NAMES)


def renderer(
    recording: Recording, offset: Callable[[str, int], float] = lambda *_: 0.0, missing: float | None = None
) -> RenderView:
    """Renders the truth plus the offset of a view; what is `missing` stands in the first quarter of the depth."""

    def render(camera: str, frame: int) -> tuple[Tensor, Tensor]:
        color = torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255) + offset(camera, frame)
        depth = torch.from_numpy(recording.depth(camera, frame)).clone()
        if missing is not None:
            depth[:, :18] = missing
        return color, depth

    return render


def plain(value: float, height: int = 40, width: int = 72) -> RenderView:
    """Renders one value at every pixel, and no depth."""
    return lambda camera, frame: (torch.full((height, width, 3), value), None)


def test_means_over_views_frames_and_cameras_are_those_of_the_rows(recording: Recording) -> None:
    render = renderer(recording, lambda camera, frame: 0.02 * (1 + frame) + 0.1 * (camera == "test1"))
    result = evaluate(render, recording, NAMES, iter(recording.frames))
    views = result["per_view"]
    assert [(row["camera"], row["frame"]) for row in views] == [(n, f) for n in NAMES for f in (0, 1)]
    assert views[0]["psnr"] > views[1]["psnr"]
    assert [row["frame"] for row in result["per_frame"]] == [0, 1]
    assert [row["camera"] for row in result["per_camera"]] == NAMES
    groups = [(result["test"], views)]
    groups += [(row, [v for v in views if v["frame"] == row["frame"]]) for row in result["per_frame"]]
    groups += [(row, [v for v in views if v["camera"] == row["camera"]]) for row in result["per_camera"]]
    for mean, rows in groups:
        for name in ("psnr", "ssim1", "ssim2", "ssim_3dgs", "depth_absrel", "depth_delta1"):
            assert mean[name] == pytest.approx(np.mean([row[name] for row in rows]))
    assert result["test"]["lpips"] is None
    assert set(result["variants"]) == set(metrics.VARIANTS)
    json.dumps(result)


def test_instants_between_the_trained_ones_are_scored_apart(recording: Recording) -> None:
    render = renderer(recording, lambda _, frame: 0.02 + 0.1 * (frame == 1))
    result = evaluate(render, recording, NAMES, recording.frames, between=(1,))
    psnr = {frame: np.mean([row["psnr"] for row in result["per_view"] if row["frame"] == frame]) for frame in (0, 1)}
    assert result["test"]["psnr"] == pytest.approx(psnr[0])
    assert result["test"]["psnr_between"] == pytest.approx(psnr[1])
    assert result["test"]["psnr_moving_between"] is None, "two frames do not say what moves"
    assert set(result["variants"]) == {*metrics.VARIANTS, "psnr_between", "psnr_moving_between"}
    assert "psnr_between" not in evaluate(render, recording, NAMES, recording.frames)["test"]


def test_every_second_instant_trains_and_those_after_the_last_are_left_out(tmp_path: Path) -> None:
    room = synthetic_recording(cameras=2, held_out=1, frames=5, width=48, height=27)
    folder = str(save_recording(room, tmp_path / "room"))
    for every, trained, between in ((0, 5, ()), (1, 5, ()), (2, 3, (1, 3)), (3, 2, (1, 2))):
        scene = Scene.open(RunSettings(folder, ("train0", "train1"), hold_out_instants=every))
        assert len(scene.recording.frames) == trained
        assert scene.between == between
        assert all(scene.scored.seconds(frame) == room.seconds(frame) for frame in scene.scored.frames)
    with pytest.raises(D2Error, match="leaves one of 5 instants: give a smaller number"):
        Scene.open(RunSettings(folder, ("train0", "train1"), hold_out_instants=5))
    refuses("16x9 pixels and scores need 11", Scene.open, RunSettings(folder, ("train0", "train1"), downscale=3))


def test_flicker_is_the_error_of_change_and_belongs_to_one_camera(recording: Recording) -> None:
    def blinking(camera: str, frame: int) -> tuple[Tensor, Tensor]:
        return renderer(recording)(camera, frame)[0] * (0.5 if frame else 1.0), None

    rows = evaluate(blinking, recording, NAMES, recording.frames)["per_view"]
    assert [row["flicker"] is None for row in rows] == [True, False, True, False]
    second = torch.from_numpy(recording.image("test1", 1).astype(np.float64) / 255)
    assert rows[3]["flicker"] == pytest.approx((0.5 * second).mean().item(), abs=1e-6)


def test_both_lpips_networks_are_kept_apart(recording: Recording) -> None:
    found = {"lpips": 0.25, "lpips_vgg": 0.5}
    nets = {name: Mock(return_value=value) for name, value in found.items()}
    result = evaluate(renderer(recording), recording, ["test0"], [0], **nets)
    assert {name: result["test"][name] for name in nets} == found
    assert "AlexNet" in result["variants"]["lpips"]
    assert "VGG" in result["variants"]["lpips_vgg"]


def test_images_too_small_for_lpips_are_scored_without_it(recording: Recording, monkeypatch) -> None:
    monkeypatch.setattr("d2_plugin.runs.evaluation.find_lpips", lambda net: Mock(side_effect=D2Error("too small")))
    black = Mock(render=lambda view: (torch.zeros(40, 72, 3), torch.zeros(40, 72), torch.zeros(40, 72)))
    scores = evaluate_scene(black, Mock(scored=recording, test_cameras=NAMES, between=()), "cpu")["test"]
    assert scores["lpips"] is scores["lpips_vgg"] is None


@pytest.mark.parametrize("missing", [0.0, np.nan, np.inf, -1.0])
def test_a_hole_in_the_rendered_depth_counts_as_wrong(recording: Recording, missing: float) -> None:
    [row] = evaluate(renderer(recording, missing=missing), recording, ["test0"], [0])["per_view"]
    assert row["depth_absrel"] == pytest.approx(18 / 72)
    assert row["depth_delta1"] == pytest.approx(1 - 18 / 72)


def test_colours_are_clamped_before_they_are_compared(recording: Recording) -> None:
    bright, white = (evaluate(plain(value), recording, ["test0"], [0])["test"] for value in (7.0, 1.0))
    assert bright["psnr"] == white["psnr"]
    assert bright["depth_absrel"] is None, "no depth was rendered"


def test_renders_that_cannot_be_compared_are_refused(recording: Recording) -> None:
    small, diverged = plain(1.0, 20, 36), plain(torch.nan)
    size = r"render of camera test0 at frame 1 is \(20, 36, 3\), expected \(40, 72, 3\)"
    refuses(size, evaluate, small, recording, ["test0"], [1])
    refuses("not finite: the model has diverged", evaluate, diverged, recording, ["test0"], [1])
    refuses("nothing to evaluate", evaluate, small, recording, [], [1])


def test_every_view_gets_one_image_with_panels_of_truth_render_depth_true_depth_and_error(recording, tmp_path) -> None:
    pytest.importorskip("cv2")
    evaluate(renderer(recording), recording, NAMES, [0, 1], tmp_path / "a" / "b")
    names = [path.name for path in sorted((tmp_path / "a" / "b").iterdir())]
    assert names == ["test0_00000.png", "test0_00001.png", "test1_00000.png", "test1_00001.png"]
    image = read_image(tmp_path / "a" / "b" / names[0])
    assert image.shape[:2] == (40 + 20, 5 * 72 + 4 * drawing.GAP)
    panels = [image[20:, i * (72 + drawing.GAP) : i * (72 + drawing.GAP) + 72] for i in range(5)]
    np.testing.assert_array_equal(panels[0], recording.image("test0", 0))
    np.testing.assert_array_equal(panels[1], panels[0])
    np.testing.assert_array_equal(panels[2], panels[3])  # the rendered depth is the true one here
    assert len(np.unique(panels[2].reshape(-1, 3), axis=0)) > 30
    assert (panels[4] == drawing.color_scale("inferno")[0]).all()  # no error: black


def moving_recording(share: float) -> Recording:
    """Five frames of one camera: noise that stands still, and a white bar that moves over `share` of the rows."""
    still = np.random.default_rng(0).integers(40, 120, (40, 72, 3)).astype(np.uint8)

    def image(camera: str, frame: int) -> np.ndarray:
        image = still.copy()
        image[: round(40 * share), 10 * frame : 10 * frame + 8] = 255
        return image

    return showing(synthetic_recording(cameras=3, frames=5, width=72, height=40), {"image": image})


def test_what_moves_is_scored_by_itself() -> None:
    recording = moving_recording(0.5)

    def render(camera: str, frame: int) -> tuple[Tensor, None]:
        """Right where nothing moves; the bar is too dark."""
        truth = torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255)
        return torch.where(truth == 1, 0.9, truth), None

    scores = evaluate(render, recording, ["test0"], recording.frames)["test"]
    assert scores["psnr_moving"] == pytest.approx(20, abs=1e-4)
    assert scores["psnr"] > 25
    still = evaluate(plain(0.0), moving_recording(0.0), ["test0"], recording.frames)["test"]
    assert still["psnr_moving"] is None, "where nothing moves there is no such score"


def test_viridis_is_kornias_within_a_shade() -> None:
    kornia = pytest.importorskip("kornia", reason="kornia is in the `test` extra")
    theirs = kornia.color.ColorMap("viridis", 256, device=torch.device("cpu"), dtype=torch.float64).colors.T
    difference = np.abs(drawing.color_scale("viridis") / 255 - theirs.numpy())
    assert difference.max() < 0.08  # nine anchors, straight lines between them
    assert difference.mean() < 0.01
