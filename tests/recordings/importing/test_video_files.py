"""A video as its container describes it: time stamps, turn, timecode, and its frames in any order."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from prior_cases import showing
from recorded import write_avi, write_video
from refusals import refuses
from stand_in_recordings import smooth_recording

from d2_plugin.recordings import open_recording, select_cameras, select_frames
from d2_plugin.recordings.importing.settings import ImportChoices
from d2_plugin.recordings.importing.solved_rig import rig_of_videos
from d2_plugin.recordings.importing.steady import steadiness
from d2_plugin.recordings.importing.video import Decoder, read_video
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import spread

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
    times = np.cumsum(np.r_[0.0, np.random.default_rng(3).choice([1, 1, 1, 2], 39) / 30])
    path = tmp_path_factory.mktemp("video") / "a.mp4"
    return write_video(path, images(40), list(times), turn=90, timecode="01:00:00:05"), times


def test_time_stamps_are_those_of_the_container(unsteady: tuple[Path, np.ndarray]) -> None:
    path, times = unsteady
    video = read_video(path)
    assert np.abs(video.times - times).max() < 1e-4
    assert video.rate == pytest.approx(30, rel=1e-3)
    assert video.timecode == "01:00:00:05"
    assert not video.sound


def test_frames_in_any_order_are_the_same(unsteady: tuple[Path, np.ndarray]) -> None:
    decoder, truth = Decoder(read_video(unsteady[0])), images(40)
    for index in (0, 1, 39, 5, 6, 38, 0):
        assert np.abs(decoder.image(index).astype(int) - truth[index]).mean() < 3
    in_order = Decoder(read_video(unsteady[0]))
    kept = [in_order.image(index) for index in range(40)]
    assert all((decoder.image(index) == kept[index]).all() for index in (17, 3, 29))


def test_no_frame_is_decoded_that_a_key_frame_makes_needless_nor_twice(tmp_path: Path, monkeypatch) -> None:
    """Moments far apart, in a video with several key frames."""
    path = write_video(tmp_path / "a.mp4", images(50) * 3, list(np.arange(150) / 30), gop=30)
    placed, place = [], Decoder._place
    monkeypatch.setattr(Decoder, "_place", lambda self, frame: placed.append(place(self, frame)) or placed[-1])
    decoder = Decoder(read_video(path))
    for index in (0, 60, 65, 120):
        decoder.image(index)
    assert len(placed) == len(set(placed)) <= 40
    assert placed == sorted(placed)


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_images_stand_as_players_show_them(tmp_path: Path, turn: int) -> None:
    path = write_video(tmp_path / "a.mp4", images(3), [0, 0.04, 0.08], turn=turn)
    video = read_video(path)
    assert video.turn == turn
    assert video.size == SIZE[::-1]
    assert np.abs(Decoder(video).image(0).astype(int) - images(1)[0]).mean() < 3
    assert Decoder(video).grey(2, 32).shape == (24, 32)
    cv2 = pytest.importorskip("cv2")
    _, shown = cv2.VideoCapture(str(path)).read()
    assert np.abs(shown[..., ::-1].astype(int) - images(1)[0]).mean() < 3  # OpenCV turns as players do


@pytest.mark.parametrize(("codec", "tag"), [("mpeg4", "XVID"), ("libx264", "H264")])
def test_b_frames_in_avi_come_in_the_order_in_which_they_are_shown(codec: str, tag: str, tmp_path: Path) -> None:
    """AVI holds the order of decoding alone, and what FFmpeg makes of it does not always rise."""
    write_avi(tmp_path / "a.avi", images(30), 30, codec, tag)
    video = read_video(tmp_path / "a.avi")
    assert len(video.stamps) == 30
    assert video.rate == pytest.approx(30, rel=1e-3)
    decoder = Decoder(video)
    for index in (0, 1, 2, 3, 11, 12, 13, 29, 5):
        assert np.abs(decoder.image(index).astype(int) - images(30)[index]).mean() < 4, index


def test_hdr_becomes_what_other_cameras_show(tmp_path: Path) -> None:
    """White paper, 203 candela per square metre, is white, and a quarter of that the grey that BT.709 has for it."""
    import av

    names = "colorprim=bt2020:transfer=smpte2084:colormatrix=bt2020nc"
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = {"x264-params": names, "crf": "1"}
        for _ in range(3):
            frame = av.VideoFrame(SIZE[1], SIZE[0], "yuv420p")
            for plane, code in zip(frame.planes, (143, 128, 128), strict=True):  # 203 candela in PQ, of 16 to 235
                plane.update(bytes([code]) * plane.buffer_size)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    video = read_video(tmp_path / "a.mp4")
    assert video.hdr == "PQ, BT.2020"
    assert Decoder(video).image(1).min() > 245


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".mts", ".m2ts", ".avi"])
def test_the_containers_of_cameras_are_read(suffix: str, tmp_path: Path) -> None:
    assert len(read_video(write_video(tmp_path / f"a{suffix}", images(5), [i / 25 for i in range(5)])).stamps) == 5


def test_half_images_and_pixels_that_are_not_square_are_known_and_no_lens_is_found_for_the_latter(
    tmp_path: Path,
) -> None:
    av = pytest.importorskip("av")
    for name in ("a.mp4", "b.mp4"):
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("libx264", rate=25)
            stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
            stream.options, stream.codec_context.sample_aspect_ratio = {"x264-params": "tff=1"}, Fraction(4, 3)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(images(1)[0], format="rgb24")))
            container.mux(stream.encode())
    videos = {name: read_video(tmp_path / f"{name}.mp4") for name in ("a", "b")}
    assert videos["a"].interlaced
    assert not read_video(write_video(tmp_path / "c.mp4", images(2), [0, 0.04])).interlaced
    refuses("pixels of video a are 1.33 times as wide as high", rig_of_videos, videos, ImportChoices())


@pytest.mark.parametrize("name", ["a.ts", "open.mp4"])
def test_frames_of_mpeg_streams_and_open_groups_of_pictures_are_read_in_any_order(name: str, tmp_path: Path) -> None:
    """A container may be entered behind the frame that is sought."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.height, stream.width, stream.pix_fmt, stream.gop_size = *SIZE, "yuv420p", 6
        stream.options = {"bf": "2", "x264-params": "open-gop=1"}
        for image in images(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    video = read_video(tmp_path / name)
    decoder = Decoder(video)
    forward = [decoder.image(i) for i in range(len(video.stamps))]
    for start in (17, 11, 5, 0, 13):
        assert (decoder.image(start) == forward[start]).all()
        assert (Decoder(video).image(start) == forward[start]).all()


def wall(count: int, shift: int = 0, gain: float = 1.0) -> list[np.ndarray]:
    """A wall of soft noise; from the middle on it lies `shift` pixels beside, and it becomes brighter up to `gain`."""
    cv2 = pytest.importorskip("cv2")
    noise = np.random.default_rng(0).uniform(0, 255, (120, 200, 1))
    soft = (cv2.GaussianBlur(noise, (0, 0), 3)[..., None] - 128) * 5 + 110
    gains = np.linspace(1, gain, count)
    views = [np.roll(soft, shift * (2 * i >= count), axis=1)[:, 20:180] * gains[i] for i in range(count)]
    return [np.repeat(view.clip(0, 255).round().astype(np.uint8), 3, axis=2) for view in views]


@pytest.mark.parametrize(("shift", "gain", "moved", "drift"), [(0, 1, 0, 0), (12, 1, 12, 0), (0, 1.25, 0, 0.25)])
def test_a_camera_that_was_moved_or_drifts_is_noticed(shift, gain, moved, drift) -> None:
    views = wall(24, shift, gain)
    recording = smooth_recording(("a",), 24, 160, 120)
    steady = steadiness(showing(recording, {"image": lambda camera, frame: views[frame]}), "a")
    assert 160 * steady.moved == pytest.approx(moved, abs=1)
    assert steady.drift == pytest.approx(drift, abs=0.02)
    assert not moved or steady.between[0] <= 0.5 <= steady.between[1]


def bumped(recording: Recording, first: int, degrees: float) -> Recording:
    """The recording, whose cameras are turned from a frame on."""
    cv2, axis = pytest.importorskip("cv2"), np.array([0.3, -0.2, 0.93])

    def image(camera: str, frame: int) -> np.ndarray:
        K = recording.cameras[camera].K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        turn = K @ cv2.Rodrigues(np.deg2rad(degrees) * axis)[0] @ np.linalg.inv(K)
        image = recording.image(camera, frame)
        return cv2.warpPerspective(image, turn, image.shape[1::-1]) if frame >= first else image

    return showing(recording, {"image": image})


@pytest.mark.parametrize(("name", "camera"), [("studio", "02"), ("dome", "03")])
def test_a_camera_that_is_bumped_by_half_a_degree_is_noticed_though_people_walk(shared_data, name, camera) -> None:
    """Mostly about its own axis, where nothing in the middle of the image moves."""
    whole = select_cameras(open_recording(shared_data(name)), (camera,))
    recording = select_frames(whole, spread(whole.frames, 9))
    first = recording.frames[5]
    assert steadiness(recording, camera).moved == 0
    steady = steadiness(bumped(recording, first, 0.5), camera)
    assert steady.moved > 0
    assert steady.between[0] < first / recording.fps <= steady.between[1]


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
    refuses(r"b\.mp4 (is no video in an MP4, MOV, .* container|\(Invalid data)", read_video, tmp_path / "b.mp4")
