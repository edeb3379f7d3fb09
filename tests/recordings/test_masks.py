"""Masks beside images: what is foreground, and what was recorded at all."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refuses
from small_layouts import small_recording

from d2_plugin.gaussians.photometric import photometric_loss, weighted_photometric_loss
from d2_plugin.priors.construct import _relabelled
from d2_plugin.priors.fuse import fuse
from d2_plugin.priors.geometry import projected
from d2_plugin.protocol import Label
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.check import check_background_weight
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.cameras.undistort import Undistortion
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import MASK_FOLDERS
from d2_plugin.runs.evaluation import evaluate
from d2_plugin.runs.start import Extent, TimedPoints, TrainingFrames, initial_points

cv2 = pytest.importorskip("cv2", reason="opencv is in the `image` extra")

W, H = 48, 32
CAMERAS = ("cam00", "cam01")


def write_mask(path: Path, mask: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)


def left_half() -> np.ndarray:
    mask = np.zeros((H, W), np.uint8)
    mask[:, : W // 2] = 255
    return mask


def recorded_folder(path: Path, masks: str = "masks", valid: bool = False) -> Path:
    """Two cameras and two frames; camera cam00 has a mask at frame 0, and its lowest rows were not recorded."""
    save_recording(small_recording(), path)
    write_mask(path / masks / "cam00" / "0000.png", left_half())
    if valid:
        recorded = np.full((H, W), 255, np.uint8)
        recorded[-5:] = 0
        write_mask(path / "valid" / "cam00.png", recorded)
    return path


@pytest.mark.parametrize("folder", MASK_FOLDERS)
def test_masks_are_read_where_they_lie(folder: str, tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording", folder))
    np.testing.assert_array_equal(recording.mask("cam00", 0), left_half() / 255)
    assert recording.mask("cam00", 1) is None
    assert recording.mask("cam01", 0) is None
    assert any(note == f"foreground masks of cam00 from {folder}" for note in recording.notes)


@pytest.mark.parametrize("channels", ["RGB", "RGBA", "opaque"])
def test_a_mask_may_have_any_number_of_channels(channels: str, tmp_path: Path) -> None:
    path = recorded_folder(tmp_path / "recording")
    grey, full = left_half(), np.full((H, W), 255, np.uint8)
    layers = {"RGB": [grey] * 3, "opaque": [grey] * 3 + [full], "RGBA": [full // 3] * 3 + [grey]}  # a cut-out person
    write_mask(path / "masks" / "cam00" / "0000.png", np.dstack(layers[channels]))
    np.testing.assert_array_equal(open_recording(path).mask("cam00", 0), grey / 255)


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    path = recorded_folder(tmp_path / "recording")
    write_mask(path / "masks" / "cam00" / "0000.png", np.zeros((H, W + 1), np.uint8))
    refuses("mask of frame 0 of camera cam00 is 49x32 pixels", open_recording(path).mask, "cam00", 0)


def test_masks_are_downscaled_and_saved_with_the_images(tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording", valid=True), downscale=2)
    mask, recorded = recording.mask("cam00", 0), recording.recorded("cam00")
    assert (mask.shape, mask[:, : W // 4].min(), mask[:, W // 4 :].max()) == ((H // 2, W // 2), 1, 0)
    assert (recorded[: H // 2 - 3].all(), recorded[-3:].any()) == (True, False)  # half a block is not whole
    again = open_recording(save_recording(recording, tmp_path / "again"))
    np.testing.assert_array_equal(again.mask("cam00", 0), mask)
    np.testing.assert_array_equal(again.recorded("cam00"), recorded)


class TestUndistortion:
    """What a lens did not record is no image."""

    LENS = Lens(np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), "opencv", (0.3,))
    CAMERA = CalibratedCamera("a", W, H, LENS, np.eye(4))

    def test_the_valid_region_is_where_a_white_image_stays_white(self) -> None:
        undone = Undistortion(self.CAMERA)
        white = undone.image(np.full((H, W, 3), 255, np.uint8))
        assert (white[undone.valid] == 255).all()
        assert (white[0, 0] == 0).all()
        assert 0.5 < undone.valid.mean() < 0.95
        assert (white[~undone.valid].min(axis=-1) < 255).mean() > 0.5  # not much smaller than it has to be

    def test_opening_a_distorted_recording_says_the_same(self, tmp_path: Path) -> None:
        path = recorded_folder(tmp_path / "recording")
        content = json.loads((path / "cameras.json").read_text())
        content["cameras"][0] |= {"model": "opencv", "distortion": [0.3, 0, 0, 0]}
        (path / "cameras.json").write_text(json.dumps(content))
        recording = open_recording(path)
        recorded, mask = recording.recorded("cam00"), recording.mask("cam00", 0)
        assert recording.image("cam00", 0)[~recorded].mean() < 40
        assert recording.recorded("cam01") is None
        assert not np.array_equal(mask, left_half() / 255)  # it was bent with the image
        assert mask[H // 2, W // 2 - 3] == 1


class TestLoss:
    """Weights in the photometric loss."""

    def test_weights_of_one_change_nothing(self) -> None:
        image, target = torch.rand(2, 24, 20, 3, generator=torch.Generator().manual_seed(3)).double()
        expected = photometric_loss(image, target)
        torch.testing.assert_close(weighted_photometric_loss(image, target, 0.2, torch.ones(24, 20)), expected)

    def test_pixels_of_no_weight_pull_nothing_and_may_hold_anything(self) -> None:
        image, target = torch.rand(2, 24, 20, 3, generator=torch.Generator().manual_seed(3))
        weights = torch.ones(24, 20)
        weights[:, 12:] = 0
        other = torch.where(weights[..., None] > 0, target, torch.zeros(()))
        losses, gradients = [], []
        for shown in (target, other):
            image = image.detach().requires_grad_()
            loss = photometric_loss(image, shown, 0.2, weights)
            (gradient,) = torch.autograd.grad(loss, image)
            losses.append(loss), gradients.append(gradient)
        assert torch.equal(losses[0], losses[1])
        assert torch.equal(gradients[0], gradients[1])
        assert gradients[0][:, 18:].abs().max() == 0  # beyond the reach of a window
        assert gradients[0][:, :12].abs().min() > 0

    def test_gradients_are_right(self) -> None:
        generator = torch.Generator().manual_seed(0)
        image, target = (torch.rand(7, 6, 3, generator=generator, dtype=torch.float64) for _ in range(2))
        weights = torch.rand(7, 6, generator=generator, dtype=torch.float64) + 0.1
        image.requires_grad_()
        assert torch.autograd.gradcheck(lambda x: weighted_photometric_loss(x, target, 0.2, weights), image)


def test_training_weighs_by_masks_and_never_by_what_was_not_recorded(tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording", valid=True))
    frames = TrainingFrames(recording, CAMERAS, background_weight=0.25)
    by_view = {(view.camera, view.frame): frames.weights(i) for i, view in enumerate(frames.views)}
    first, later = by_view["cam00", 0], by_view["cam00", 1]
    assert (first[0, 0], first[0, -1], first[-1, 0]) == (1, 0.25, 0)
    assert (later[0, -1], later[-1, 0]) == (1, 0)  # no mask: all of what was recorded counts
    assert by_view["cam01", 0] is None
    unweighted = TrainingFrames(recording, CAMERAS).weights(0)
    assert (unweighted[0, -1], unweighted[-1, 0]) == (1, 0)


def test_images_without_a_mask_are_named_where_masks_weigh(tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording"))
    assert check_background_weight(recording, CAMERAS, 1) == ()
    one, other = check_background_weight(recording, CAMERAS, 0.5)
    assert "camera cam00 has no foreground mask at frame 1:" in one
    assert "camera cam01 has no foreground mask at frame 0, 1:" in other
    refuses("has no foreground mask: put masks at", check_background_weight, recording, CAMERAS[1:], 0.5)
    shutil.move(tmp_path / "recording/masks/cam00/0000.png", tmp_path / "recording/masks/cam00/0001.png")
    assert len(check_background_weight(open_recording(tmp_path / "recording"), CAMERAS, 0.5)) == 2


def test_the_score_inside_the_mask(tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording"))
    truth = torch.from_numpy(recording.image("cam00", 0)).float() / 255

    def render(camera: str, frame: int) -> tuple[torch.Tensor, None]:
        drawn = torch.from_numpy(recording.image(camera, frame)).float() / 255
        drawn[:, : W // 2] = (drawn[:, : W // 2] + 0.1).clamp(0, 1)
        return drawn, None

    found = evaluate(render, recording, CAMERAS, recording.frames)["per_view"]
    rows = {(row["camera"], row["frame"]): row for row in found}
    error = ((truth[:, : W // 2] + 0.1).clamp(0, 1) - truth[:, : W // 2]).square().mean()
    assert rows["cam00", 0]["psnr_mask"] == pytest.approx(-10 * torch.log10(error).item(), abs=1e-3)
    assert rows["cam00", 1]["psnr_mask"] is None
    assert rows["cam01", 0]["psnr_mask"] is None


def test_what_was_not_recorded_is_not_scored(tmp_path: Path) -> None:
    whole = open_recording(recorded_folder(tmp_path / "recording"))

    def scores(of: Recording, off: float) -> dict[str, float]:
        def render(camera: str, frame: int) -> tuple[torch.Tensor, None]:
            drawn = torch.from_numpy(whole.image(camera, frame)).float() / 255
            drawn[-5:] += off
            return (0.9 * drawn).clamp(0, 1), None

        found = evaluate(render, of, CAMERAS[:1], of.frames)["test"]
        return {name: value for name, value in found.items() if value is not None and "depth" not in name}

    cut = open_recording(recorded_folder(tmp_path / "cut", valid=True))
    assert scores(cut, 0.0) == scores(cut, 0.5)
    assert scores(whole, 0.0) != scores(whole, 0.5)
    assert scores(cut, 0.0)["psnr"] == pytest.approx(scores(whole, 0.0)["psnr"], abs=1)


def test_a_run_begins_with_nothing_that_was_not_recorded(tmp_path: Path) -> None:
    recording = open_recording(recorded_folder(tmp_path / "recording", valid=True))
    start = initial_points(recording, CAMERAS[:1], TimedPoints(*np.zeros((3, 0, 3))[:2], np.zeros(0)), Extent(1, 9, 3))
    rows = projected(recording.cameras["cam00"], start.positions)[0][:, 1]
    assert len(rows) > 0
    assert rows.max() < H - 5
    assert not TrainingFrames(recording, CAMERAS).recorded(0)[-5:].any()


def test_a_prior_knows_nothing_of_what_was_not_recorded() -> None:
    full = np.full((H, W), 2.0, np.float32)
    maps = fuse(full, full, tau_c=0.1)
    assert (maps.labels == Label.VERIFIED).all()
    recorded = left_half() > 0
    kept = _relabelled(maps, ~recorded, 0, Label.EMPTY)
    assert (kept.labels[recorded] == Label.VERIFIED).all()
    assert (kept.labels[~recorded] == Label.EMPTY).all()
    assert (kept.depth[~recorded] == 0).all()
    assert np.isinf(kept.sigma[~recorded]).all()
