"""Sparse points from known poses: accurate, in two views too, and never a crash."""

import signal
import subprocess
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from d2_plugin.errors import MissingExtra
from d2_plugin.priors.colmap.points import SparsePoints, triangulate, triangulate_frames
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.recording import Camera, Recording
from d2_plugin.recordings.synthetic.room import synthetic_recording

pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic_recording(frames=2)


def points_of(recording: Recording, names: list[str], frame: int = 0) -> SparsePoints:
    images = [recording.image(name, frame) for name in names]
    return triangulate(images, [recording.cameras[name] for name in names], frame)


def seen_by(camera: Camera, points: SparsePoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row of the pixel that each point is in, and its depth."""
    in_camera = points.positions @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
    pixels = in_camera @ camera.K.T
    return *np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T, in_camera[:, 2]


def depth_errors(recording: Recording, names: list[str], points: SparsePoints) -> np.ndarray:
    """Relative depth error of each point in the camera that agrees best (the others may not see it)."""
    errors = np.full(len(points), np.inf)
    for name in names:
        camera, depth = recording.cameras[name], recording.depth(name, 0)
        column, row, found = seen_by(camera, points)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        truth = depth[row[inside], column[inside]]
        errors[inside] = np.minimum(errors[inside], np.abs(found[inside] / truth - 1))
    return errors


def test_points_of_two_views_lie_on_the_true_surfaces_and_carry_their_colour_without_a_word(recording, capfd) -> None:
    points = points_of(recording, ["train1", "train2"])
    assert capfd.readouterr() == ("", "")
    assert len(points) > 100
    errors = depth_errors(recording, ["train1", "train2"], points)
    assert np.median(errors) < 0.005
    assert np.mean(errors < 0.05) > 0.9
    camera, image = recording.cameras["train1"], recording.image("train1", 0) / 255
    column, row, _ = seen_by(camera, points)
    seen = image[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
    assert points.colors.min() >= 0
    assert points.colors.max() <= 1
    assert np.median(np.abs(points.colors - seen)) < 0.06


def test_points_of_several_frames_carry_their_frame(recording: Recording) -> None:
    joined = triangulate_frames(recording, ["train1", "train2"], [0, 1])
    assert set(joined.frames) == {0, 1}
    single = points_of(recording, ["train1", "train2"], frame=1)
    np.testing.assert_array_equal(joined.positions[joined.frames == 1], single.positions)


def test_hopeless_input_gives_no_points_and_no_abort(recording: Recording) -> None:
    first, second = recording.cameras["train1"], recording.cameras["train2"]
    image = recording.image("train1", 0)
    black, noise = np.zeros_like(image), np.random.default_rng(0).integers(0, 256, image.shape, dtype=np.uint8)
    for images, cameras in (
        ([], []),
        ([image], [first]),
        ([image, image], [first, replace(first, name="twin")]),  # no baseline
        ([black, black], [first, second]),
        ([image, black], [first, second]),
        ([black + 255, image], [first, second]),
        ([noise, noise[::-1].copy()], [first, second]),
        ([image[:1, :1], image[:1, 1:2]], [replace(c, width=1, height=1) for c in (first, second)]),
        ([image[:9, :9], image[:9, :9]], [replace(c, width=9, height=9) for c in (first, second)]),
    ):
        points = triangulate(images, cameras)
        assert len(points) == 0
        assert points.positions.shape == points.colors.shape == (0, 3)


@pytest.mark.parametrize(("found", "needed"), [(None, "pycolmap"), (ModuleType("pycolmap"), "pycolmap 4.2 or later")])
def test_a_pycolmap_that_is_missing_or_old_names_its_extra(found: object, needed: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", found)
    with pytest.raises(MissingExtra, match=rf"{needed}, which is not installed: run `pip install 'd2-4dgs\[stereo\]'`"):
        triangulate([], [])


def test_compression_survives_pycolmap_and_the_process_ends_silently_at_sigterm() -> None:
    """Its own zlib, imported before the system's, makes compression abort; its logging answers SIGTERM with a trace."""
    imports = "from d2_plugin.extras import import_pycolmap; import_pycolmap('a test', 'stereo')"
    ends = "zlib.compress(bytes(10**5)); print('alive', flush=True); os.kill(os.getpid(), signal.SIGTERM)"
    code = "\n".join([imports, "import os, signal, zlib", ends])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, "alive\n", "")


def test_real_images_of_studio_give_accurate_points(shared_data) -> None:
    studio = open_recording(shared_data("studio"))
    points = points_of(studio, ["00", "02", "05", "07"])
    assert len(points) > 150
    errors = depth_errors(studio, ["00", "02", "05", "07"], points)
    assert np.median(errors) < 0.003
    assert np.mean(errors < 0.01) > 0.85
