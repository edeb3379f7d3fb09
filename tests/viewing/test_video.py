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


def write(path: Path, images: list[np.ndarray]) -> None:
    with write_video(path, "mp4", 30) as video:
        for image in images:
            video.add(image)


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * np.log10(np.mean((a.astype(float) - b.astype(float)) ** 2) / 255**2 + 1e-12)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (63, 48), (64, 47), (61, 43)])
def test_every_image_comes_back_and_odd_sides_gain_one(tmp_path: Path, width: int, height: int) -> None:
    images, path = soft(9, width, height), tmp_path / "video.mp4"
    with write_video(path, "mp4", 24) as video:
        for image in images:
            video.add(image)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (width + width % 2, height + height % 2)
        assert stream.average_rate == 24
        assert stream.frames == 9
        assert float(stream.duration * stream.time_base) == pytest.approx(9 / 24)
    found = decoded(path)
    assert len(found) == 9
    for image, given in zip(found, images, strict=True):
        assert decibels(image[:height, :width], given) > 35


def test_a_browser_can_begin_before_it_has_the_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    with write_video(path, "mp4", 30) as video:
        video.add(soft(1, 32, 32)[0])
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


RATES = [(29.97, Fraction(30000, 1001)), (23.976, Fraction(24000, 1001)), (12.5, Fraction(25, 2))]


@pytest.mark.parametrize(("fps", "rate"), RATES)
def test_the_rate_is_that_of_the_recording(tmp_path: Path, fps: float, rate: Fraction) -> None:
    with write_video(tmp_path / "video.mp4", "mp4", fps) as video:
        for image in soft(4, 32, 32):
            video.add(image)
    with av.open(str(tmp_path / "video.mp4")) as container:
        assert container.streams.video[0].average_rate == rate


@pytest.mark.parametrize("form", ["webp", "gif"])
def test_animated_images_keep_number_and_odd_size(tmp_path: Path, form: str) -> None:
    path = tmp_path / f"video.{form}"
    with write_video(path, form, 10) as video:
        for image in soft(5, 61, 43):
            video.add(image)
    if form == "webp":  # ffmpeg decodes no animated WebP: its frames are counted in the file
        data = path.read_bytes()
        assert data[:4] == b"RIFF"
        assert data[8:12] == b"WEBP"
        assert data.count(b"ANMF") == 5
        at = data.index(b"VP8X") + 12
        assert [int.from_bytes(data[at + i : at + i + 3], "little") for i in (0, 3)] == [60, 42]
    else:
        found = decoded(path)
        assert len(found) == 5
        assert found[0].shape == (43, 61, 3)
        assert decibels(found[0], soft(5, 61, 43)[0]) > 25


def test_pngs_are_exact(tmp_path: Path) -> None:
    images = soft(3, 31, 17)
    with write_video(tmp_path / "video", "png", 30) as video:
        for image in images:
            video.add(image)
    names = sorted(path.name for path in (tmp_path / "video").iterdir())
    assert names == ["00000.png", "00001.png", "00002.png"]
    for name, image in zip(names, images, strict=True):
        assert np.array_equal(read_image(tmp_path / "video" / name), image)


def test_a_video_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "video.mp4"
    path.write_bytes(b"earlier")
    with pytest.raises(D2Error, match="32x32 pixels got"):
        write(path, [*soft(1, 32, 32), *soft(1, 34, 32)])
    assert path.read_bytes() == b"earlier"
    assert [entry.name for entry in tmp_path.iterdir()] == ["video.mp4"]


def test_what_the_encoder_refuses_is_one_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / ".0123.part").write_bytes(b"of a video that was killed")
    with pytest.raises(D2Error, match=r"cannot write the video .*a\.mp4 \(.*\): choose other --width"):
        write(tmp_path / "a.mp4", [np.zeros((2, 20_000, 3), np.uint8)])
    assert not list(tmp_path.iterdir())


def test_a_video_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.mp4").mkdir()
    for path in (tmp_path / "file" / "a.mp4", tmp_path / f"{'y' * 300}.mp4", tmp_path / "folder.mp4"):
        with pytest.raises(D2Error, match="cannot write"):
            write(path, soft(1, 32, 32))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_a_video_replaces_no_other_kind_of_file(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text("{}")
    with pytest.raises(D2Error, match=r"a video of format mp4 needs a name that ends so, got cameras\.json"):
        write(tmp_path / "cameras.json", soft(1, 32, 32))
    assert (tmp_path / "cameras.json").read_text() == "{}"


def test_a_video_without_a_image_is_refused(tmp_path: Path) -> None:
    with pytest.raises(D2Error, match="without an image"):
        write(tmp_path / "video.mp4", [])


def test_without_pyav_one_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingExtra, match=r"pip install 'd2-4dgs\[video\]'"):
        write(tmp_path / "a.mp4", [])
