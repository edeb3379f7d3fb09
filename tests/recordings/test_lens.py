"""Lens distortion undone on load: a recorded image becomes the one a pinhole camera would have taken."""

import json
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from d2_plugin.errors import D2Error
from d2_plugin.recordings import Source, open_recording
from d2_plugin.recordings.cameras.camera import CalibratedCamera, pinhole
from d2_plugin.recordings.cameras.lens import Lens, checked_lens
from d2_plugin.recordings.cameras.undistort import UndistortedSource, refuse_black
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

SIZE = (96, 64)
K = pinhole(80.0, 84.0, 50.5, 30.25)


def texture(pixels: np.ndarray) -> np.ndarray:
    """A smooth image that is known at every position [..., 2], as RGB in 0..255."""
    x, y = pixels[..., 0] / 9, pixels[..., 1] / 7
    return 127 + 100 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)


def centres() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), axis=-1)


class Recorded(Source):
    """A source that took `texture` through a lens: the pixel at q shows what a pinhole has at the undistorted q."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens

    def image(self, camera: str, frame: int) -> np.ndarray:
        target, guess = centres(), centres()
        for _ in range(60):  # invert the lens by fixed-point steps
            guess = guess + target - self.lens.recorded_pixels(guess)
        assert np.abs(self.lens.recorded_pixels(guess) - target).max() < 1e-6
        return np.rint(texture(guess)).astype(np.uint8)


def of(lens: Lens) -> CalibratedCamera:
    """A camera at the origin with this lens."""
    return CalibratedCamera("a", *SIZE, lens, np.eye(4))


LENSES = {
    "barrel": Lens(K, "opencv", (-0.12, 0.02)),
    "pincushion": Lens(K, "opencv", (0.08,)),
    "decentred": Lens(K, "opencv", (-0.05, 0.01, 0.004, -0.003, 0.002)),
    "fisheye": Lens(K, "fisheye", (-0.03, 0.004, -0.001, 0.0002)),
    "skewed": Lens(K + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])),
}


@pytest.mark.parametrize("name", list(LENSES))
def test_an_undistorted_image_is_what_the_pinhole_sees(name: str) -> None:
    pytest.importorskip("cv2")
    lens = LENSES[name]
    source = pickle.loads(pickle.dumps(UndistortedSource(Recorded(lens), {"a": of(lens)})))  # for workers that load
    image, expected = source.image("a", 0).astype(float), texture(centres())
    recorded = lens.recorded_pixels(centres())
    inside = ((recorded > 1) & (recorded < np.array(SIZE) - 1)).all(axis=-1)
    assert inside.mean() > 0.75
    error = np.abs(image - expected)[inside]
    # Interpolation and rounding; half a pixel of shift would cost 3 to 5 grey levels on average.
    assert error.mean() < 0.8
    assert error.max() < 5


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.8, -0.05), st.floats(0.0, 0.2))
def test_rays_beyond_the_fold_of_the_polynomial_have_no_image(k1: float, k2: float) -> None:
    lens = Lens(K, "opencv", (k1, k2))
    radius = np.linspace(0.0, 6.0, 2001)
    distorted = lens.distort(np.stack([radius, np.zeros_like(radius)], axis=-1))[:, 0]
    known = np.isfinite(distorted)
    assert known[0]
    assert not (np.diff(known.astype(int)) > 0).any()  # once folded, always folded
    assert (np.diff(distorted[known]) > -1e-12).all()


def test_the_share_of_black_pixels_is_measured() -> None:
    assert refuse_black(of(Lens(K, "opencv", (-0.1,)))) == 0  # a barrel is cut, not widened
    wide = refuse_black(of(Lens(K, "opencv", (0.4,))))
    x, y = np.moveaxis(Lens(K, "opencv", (0.4,)).recorded_pixels(centres()), -1, 0)
    exact = 1 - ((x >= 0) & (x <= SIZE[0]) & (y >= 0) & (y <= SIZE[1])).mean()
    assert wide == pytest.approx(exact, abs=1e-9)


def test_a_lens_that_leaves_hardly_anything_of_a_image_is_refused(tmp_path: Path) -> None:
    path = save_recording(synthetic_recording(cameras=2, held_out=0, frames=1, width=64, height=48), tmp_path / "room")
    table = json.loads((path / "cameras.json").read_text())
    table["cameras"][0] |= {"model": "fisheye", "distortion": [-50.0, 0, 0, 0]}
    (path / "cameras.json").write_text(json.dumps(table))
    refuses(r"camera train0 leaves \d% of its images, expected at least 50%", open_recording, path)


def test_a_rational_lens_ends_before_it_folds_or_has_a_pole() -> None:
    rays = np.array([[0.9, 0.0], [1.1, 0.0], [3.0, 0.0]])
    pole = checked_lens(K, "opencv", np.array([0, 0, 0, 0, 0, -1.0, 0, 0]), "here")  # r / (1 - r^2)
    np.testing.assert_allclose(pole.distort(rays)[:, 0], [0.9 / 0.19, np.nan, np.nan])
    fold = checked_lens(K, "opencv", np.array([0, 0, 0, 0, 0, 1.0, 0, 0]), "here")  # r / (1 + r^2) is largest at 1
    np.testing.assert_allclose(fold.distort(rays)[:, 0], [0.9 / 1.81, np.nan, np.nan])


def test_models_beyond_eight_coefficients_are_refused() -> None:
    assert checked_lens(K, "opencv", np.zeros((1, 14)), "here").bends is False
    with pytest.raises(D2Error, match="camera 3 in intri.yml has 12 distortion coefficients.*undistort the images"):
        checked_lens(K, "opencv", np.array([0.1, 0, 0, 0, 0, 0, 0, 0.2, 0, 0, 0.1, 0]), "camera 3 in intri.yml")
    refuses("expected finite numbers", checked_lens, K, "opencv", np.array([math.nan, 0, 0, 0]), "here")


@pytest.mark.parametrize("coefficients", [(0.1, 0.02, 0.0, 0.0, 0.0), (-0.2, 0.05, 0.001, -0.002, -0.01)])
def test_a_lens_bends_as_kornias(coefficients: tuple[float, ...]) -> None:
    kornia = pytest.importorskip("kornia", reason="kornia is in the `test` extra")
    pixels = np.random.default_rng(0).uniform((0, 0), SIZE, (200, 2))
    theirs = kornia.geometry.calibration.distort_points(*map(torch.tensor, (pixels, K, np.array(coefficients))))
    np.testing.assert_allclose(Lens(K, "opencv", coefficients).recorded_pixels(pixels), theirs, rtol=0, atol=1e-9)
