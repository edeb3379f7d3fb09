"""Every reader of recordings on damaged files: a valid recording or one sentence, in bounded time and memory."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from fuzzing import bounded_memory, expect_result_or_sentence, mutate_file
from small_layouts import write_layout

from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.cameras.formats.colmap import find_model, read_points

pytest.importorskip("cv2", reason="opencv is in the `image` extra")

LAYOUTS = ("folder", "n3dv", "videos", "technicolor", "enerf", "transforms", "colmap", "colmap_text")
IMAGES = (".png", ".mp4")
FEW, MANY = 50, 2000


def look_at(path: Path) -> Recording:
    """Open a recording and read what one camera has at each frame."""
    recording = open_recording(path)
    for name in recording.cameras:
        for frame in recording.frames[:2]:
            recording.image(name, frame)
            recording.depth(name, frame)
            recording.mono(name, frame)
    if recording.layout == "colmap":
        model = find_model(path)
        assert model is not None
        read_points(model)
    return recording


def fuzz(layout: str, path: Path, count: int, seed: int = 0) -> int:
    """Damage one file at a time, two in three times one that is no image; returns how many were still valid."""
    write_layout(layout, path)
    expect_result_or_sentence(lambda: look_at(path), "none")
    files = sorted(file for file in path.rglob("*") if file.is_file())
    plain = [file for file in files if file.suffix not in IMAGES]
    valid = 0
    with bounded_memory():
        for number in range(count):
            rng = random.Random(f"{layout} {seed} {number}")
            file = rng.choice(plain if rng.random() < 0.67 else files)
            before = file.read_bytes()
            mutate_file(file, rng)
            valid += expect_result_or_sentence(lambda: look_at(path), f"{layout} {seed} {number} {file.name}")
            file.write_bytes(before)
    return valid


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_damaged_recording_is_valid_or_one_sentence(layout: str, tmp_path: Path) -> None:
    valid = fuzz(layout, tmp_path / "recording", FEW)
    assert valid < FEW, "no mutation did any harm: the test would not notice"


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_two_thousand_damaged_recordings(layout: str, tmp_path: Path) -> None:
    fuzz(layout, tmp_path / "recording", MANY, seed=1)


def test_a_pose_beyond_every_number_is_named(tmp_path: Path) -> None:
    path = write_layout("colmap_text", tmp_path / "recording")
    images = path / "sparse" / "0" / "images.txt"
    words = images.read_text().split(" ")
    images.write_text(" ".join([*words[:6], "1e200", *words[7:]]))
    with pytest.raises(D2Error, match=r"images.txt is damaged or no COLMAP model \(an image stands at .*1e\+200"):
        open_recording(path)


@pytest.mark.parametrize("number", ["inf", "nan", "1e300"])
def test_a_focal_length_without_end_is_named(number: str, tmp_path: Path) -> None:
    path = write_layout("colmap_text", tmp_path / "recording")
    cameras = path / "sparse" / "0" / "cameras.txt"
    comment, first, *rest = cameras.read_text().splitlines()
    words = first.split()
    cameras.write_text("\n".join([comment, " ".join([*words[:4], number, *words[5:]]), *rest]))
    with pytest.raises(D2Error, match=r"camera .* has a K with a number that is not finite or larger than 1e\+09"):
        open_recording(path)


def test_focal_lengths_of_another_order_are_named(tmp_path: Path) -> None:
    path = write_layout("colmap_text", tmp_path / "recording")
    cameras = path / "sparse" / "0" / "cameras.txt"
    comment, first, *rest = cameras.read_text().splitlines()
    words = first.split()
    cameras.write_text("\n".join([comment, " ".join([*words[:5], "1e-305", *words[6:]]), *rest]))
    with pytest.raises(
        D2Error, match=r"camera .* has focal lengths .* and 1e-305, expected positive"
    ):
        open_recording(path)
