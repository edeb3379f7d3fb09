"""A video as its container describes it: time stamps, turn, timecode, and its frames in any order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recorded import write_video

from d2_plugin.errors import D2Error
from d2_plugin.recordings.importing.video import Decoder, VideoFile, read_video

pytest.importorskip("av")

SIZE = (48, 64)


def images(count: int) -> list[np.ndarray]:
    """Soft stripes that move by two pixels a frame."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    return [
        np.stack([120 + 80 * np.sin((x + 2 * i) / 9), 100 + y, np.full(SIZE, 4.0 * i)], -1).round().astype(np.uint8)
        for i in range(count)
    ]


@pytest.fixture(scope="module")
def unsteady(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A video whose camera left out frames at times, and when each was shown."""
    rng = np.random.default_rng(3)
    times = np.cumsum(np.r_[0.0, rng.choice([1, 1, 1, 2], 39) / 30])
    path = tmp_path_factory.mktemp("video") / "a.mp4"
    return write_video(path, images(40), list(times), turn=90, timecode="01:00:00:05"), times


def test_time_stamps_are_those_of_the_container(unsteady: tuple[Path, np.ndarray]) -> None:
    path, times = unsteady
    video = read_video(path)
    assert np.abs(video.times - times).max() < 1e-4
    assert video.rate == pytest.approx(30, rel=1e-3)
    assert video.timecode == "01:00:00:05"
    assert not video.sound


def test_a_table_keeps_everything(unsteady: tuple[Path, np.ndarray]) -> None:
    video = read_video(unsteady[0])
    again = VideoFile.from_dict(video.as_dict())
    assert again.as_dict() == video.as_dict()
    assert (again.times == video.times).all()


def test_frames_in_any_order_are_the_same(unsteady: tuple[Path, np.ndarray]) -> None:
    decoder, truth = Decoder(read_video(unsteady[0])), images(40)
    for index in (0, 1, 39, 5, 6, 38, 0):
        assert np.abs(decoder.image(index).astype(int) - truth[index]).mean() < 3
    in_order = Decoder(read_video(unsteady[0]))
    kept = [in_order.image(index) for index in range(40)]
    assert all((decoder.image(index) == kept[index]).all() for index in (17, 3, 29))


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_images_stand_as_players_show_them(tmp_path: Path, turn: int) -> None:
    path = write_video(tmp_path / "a.mp4", images(3), [0, 0.04, 0.08], turn=turn)
    video = read_video(path)
    assert video.turn == turn
    assert video.size == SIZE[::-1]
    assert np.abs(Decoder(video).image(0).astype(int) - images(1)[0]).mean() < 3
    cv2 = pytest.importorskip("cv2")
    _, shown = cv2.VideoCapture(str(path)).read()
    assert np.abs(shown[..., ::-1].astype(int) - images(1)[0]).mean() < 3  # OpenCV turns as players do


def test_small_brightness_has_the_shape_of_the_upright_image(unsteady: tuple[Path, np.ndarray]) -> None:
    grey = Decoder(read_video(unsteady[0])).grey(2, 32)
    assert grey.shape == (24, 32)


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".mts", ".m2ts", ".avi"])
def test_the_containers_of_cameras_are_read(suffix: str, tmp_path: Path) -> None:
    path = write_video(tmp_path / f"a{suffix}", images(5), [i / 25 for i in range(5)])
    assert len(read_video(path).stamps) == 5


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile 'a.mp4'\n",
        "<MPD><Period><BaseURL>http://127.0.0.1:9/</BaseURL></Period></MPD>",
        "1\n00:00:01,000 --> 00:00:02,000\nhello\n",
        "v=0\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
    ],
)
def test_playlists_and_scripts_are_no_videos_and_lead_nowhere(text: str, tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", images(5), [i / 25 for i in range(5)])
    (tmp_path / "b.mp4").write_text(text)
    with pytest.raises(D2Error, match=r"b\.mp4 is no video in an MP4, MOV, .* container"):
        read_video(tmp_path / "b.mp4")
