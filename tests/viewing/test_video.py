"""Videos: the right number of images at the right rate and size, which others decode to what was given."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.recordings.images import read_image
from d2_plugin.viewing.videos.video import write_video

av = pytest.importorskip("av", reason="PyAV is in the `video` extra")


def soft(count: int, width: int, height: int) -> list[np.ndarray]:
    """Smooth colours with a bar that moves."""
    y, x = np.mgrid[:height, :width]
    base = np.stack([255 * x / width, 255 * y / height, np.full_like(x, 90)], -1)
    images = []
    for i in range(count):
        bar = np.exp(-(((x - width * i / count) / (width / 12)) ** 2))[..., None]
        images.append(np.clip(base * (1 - bar) + 230 * bar, 0, 255).astype(np.uint8))
    return images


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def write(path: Path, images: list[np.ndarray], fps: float = 30, form: str = "mp4") -> None:
    with write_video(path, form, fps) as add:
        for image in images:
            add(image)


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2 + 1e-12)


@pytest.mark.parametrize(
    ("width", "height", "fps", "rate"),
    [
        (64, 48, 24, 24),
        (63, 48, 29.97, Fraction(30000, 1001)),
        (64, 47, 23.976, Fraction(24000, 1001)),
        (61, 43, 12.5, 12.5),
    ],
)
def test_every_image_comes_back_at_its_rate_odd_sides_gain_one_and_the_index_is_in_front(
    tmp_path: Path, width: int, height: int, fps: float, rate: Fraction
) -> None:
    images, path = soft(9, width, height), tmp_path / "video.mp4"
    write(path, images, fps)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
        assert (stream.average_rate, stream.frames) == (rate, 9)
        assert float(stream.duration * stream.time_base) == pytest.approx(9 / fps, rel=1e-3)
    found = decoded(path)
    assert len(found) == 9
    for image, given in zip(found, images, strict=True):
        assert decibels(image[:height, :width], given) > 35
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser can begin before it has the whole file"


def test_an_animated_webp_keeps_number_and_odd_size(tmp_path: Path) -> None:
    path = tmp_path / "video.webp"
    write(path, soft(5, 61, 43), 10, "webp")
    data = path.read_bytes()  # ffmpeg decodes no animated WebP: its frames are counted in the file
    assert (data[:4], data[8:12], data.count(b"ANMF")) == (b"RIFF", b"WEBP", 5)
    at = data.index(b"VP8X") + 12
    assert [int.from_bytes(data[at + i : at + i + 3], "little") for i in (0, 3)] == [60, 42]


def test_pngs_are_exact(tmp_path: Path) -> None:
    images = soft(3, 31, 17)
    write(tmp_path / "video", images, form="png")
    paths = sorted((tmp_path / "video").iterdir())
    assert [path.name for path in paths] == ["00000.png", "00001.png", "00002.png"]
    for path, image in zip(paths, images, strict=True):
        assert np.array_equal(read_image(path), image)


def test_a_video_that_fails_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"earlier")
    (tmp_path / ".0123.part").write_bytes(b"of a video that was killed")
    failures = {
        "32x32 pixels got": [*soft(1, 32, 32), *soft(1, 34, 32)],
        "without an image": [],
        r"cannot write the video .*\.mp4 \(.*\): choose other --width": [np.zeros((2, 20_000, 3), np.uint8)],
    }
    for says, images in failures.items():
        with pytest.raises(D2Error, match=says):
            write(path, images)
        assert path.read_bytes() == b"earlier"
        assert [entry.name for entry in tmp_path.iterdir()] == ["video.mp4"]


def test_a_place_where_no_video_can_be_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(D2Error, match="a video of 100000 images per second cannot be: give --fps from 0.001 to 1000"):
        write(tmp_path / "a.mp4", soft(1, 32, 32), 1e5)
    for path in (tmp_path / "file" / "a.mp4", tmp_path / f"{'y' * 300}.mp4", tmp_path / "folder.mp4"):
        with pytest.raises(D2Error, match="cannot write|is a file, expected a folder"):
            write(path, soft(1, 32, 32))
    with pytest.raises(D2Error, match="a video of format mp4 needs a name that ends so, got file"):
        write(tmp_path / "file", soft(1, 32, 32))
    assert (tmp_path / "file").read_text() == "in the way"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_without_pyav_one_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingExtra, match=r"pip install 'd2-4dgs\[video\]'"):
        write(tmp_path / "a.mp4", [])
