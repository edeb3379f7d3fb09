"""When cameras started: timecode, sound, motion, each alone and against each other; the images of a frame by then."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from recorded import SOUND_RATE, graded, room_sound, write_video
from refusals import refuses

from d2_plugin.recordings import Camera, Recording, open_recording
from d2_plugin.recordings.importing.clocks import Clock, Evidence, _solved, common_clock, given_clock, timecode_seconds
from d2_plugin.recordings.importing.grid import Grid, grid_of
from d2_plugin.recordings.importing.motion import Seen, offsets_from_motion, watch
from d2_plugin.recordings.importing.sound import RATE, Sound, lag_between, read_sound
from d2_plugin.recordings.importing.video import VideoFile, read_video

cv2 = pytest.importorskip("cv2")


@pytest.mark.parametrize(
    ("text", "rate", "seconds"),
    [
        ("00:00:10:12", 24.0, 10.5),
        ("01:00:00:00", 25.0, 3600.0),
        ("00:01:00;02", 30000 / 1001, 1800 * 1001 / 30000),  # numbers 0 and 1 of the minute do not exist
        ("00:10:00;00", 30000 / 1001, 17982 * 1001 / 30000),
        ("01:00:00;00", 60000 / 1001, 215784 * 1001 / 60000),
    ],
)
def test_timecode_counts_frames_as_smpte_12m_does(text: str, rate: float, seconds: float) -> None:
    assert timecode_seconds(text, rate) == pytest.approx(seconds, abs=1e-9)


def test_the_clock_of_an_mpeg_stream_begins_with_it_whatever_its_stamps_begin_at(tmp_path: Path) -> None:
    images, times = [np.full((48, 64, 3), 9 * i, np.uint8) for i in range(10)], np.arange(10) / 25
    one, other = (read_video(write_video(tmp_path / f"{at}.ts", images, list(times + at))) for at in (0.0, 7.3))
    assert other.times == pytest.approx(one.times, abs=1e-4)
    sounds = []
    for lead in (0.5, 0.8):
        sound = room_sound(4.0)[round(lead * SOUND_RATE) :]
        write_video(tmp_path / f"heard{lead}.ts", images, list(times), sound=sound)
        sounds.append(read_sound(tmp_path / f"heard{lead}.ts"))
    assert lag_between(*sounds).seconds == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize("text", ["", "noon", "00:61:00:00", "00:00:00:30", "1:2:3"])
def test_what_is_no_timecode_counts_for_nothing(text: str) -> None:
    assert timecode_seconds(text, 30.0) is None


def heard(sound: np.ndarray, seed: int, loudness: float) -> Sound:
    """What a microphone of its own makes of a sound."""
    whole = loudness * sound + np.random.default_rng(seed).normal(0, 0.005, len(sound))
    step = SOUND_RATE // RATE
    return Sound(whole[: len(whole) // step * step].reshape(-1, step).mean(1).astype(np.float32), 0.0)


@pytest.mark.parametrize("frames", [-7.5, -0.3, 0.0, 4.25, 12.0])
def test_sound_finds_the_offset_within_a_tenth_of_a_frame(frames: float) -> None:
    room, begin = room_sound(4.0), 0.5
    offset = frames / 30
    one = heard(room[round(begin * SOUND_RATE) :], 1, 0.8)
    lag = lag_between(one, heard(room[round((begin + offset) * SOUND_RATE) :], 2, 0.2))
    assert abs(lag.seconds - offset) * 30 < 0.1
    assert abs(lag.seconds - offset) < 5 * lag.error


Views = dict[str, tuple[Camera, list[np.ndarray], np.ndarray]]  # camera -> (pinhole, grey images, times)


def filmed(recording: Recording, offsets: dict[str, float], seed: int, order: Sequence[int] = ()) -> Views:
    """What cameras that begin some frames later saw, with gains and frames that they dropped; frames in an `order`."""
    found, rng, order = {}, np.random.default_rng(seed), order or range(len(recording.frames))
    for name, offset in offsets.items():
        places = np.arange(round(max(offset, 0)), len(order) + min(round(offset), 0))
        places = places[rng.random(len(places)) > 0.08]
        gain = tuple(rng.uniform(0.85, 1.15, 3))
        images = [graded(recording.image(name, recording.frames[order[i]]), gain) for i in places]
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
        found[name] = recording.cameras[name], grey, (places - offset) / recording.fps
    return found


def by_motion(views: Views) -> dict[str, Seen]:
    seen = {name: watch(images, times, camera) for name, (camera, images, times) in views.items()}
    return offsets_from_motion(seen, search=max(float(np.ptp(times)) for _, _, times in views.values()))


CASES = [
    ("plaza", 1, {"01": 0, "02": -7, "03": 5, "04": 2}),
    ("studio", 1, {"03": 0, "04": -3}),
    ("dome", 2, {"03": 0, "07": 2, "12": -4, "15": 3}),
]


@pytest.mark.parametrize(("scene", "downscale", "offsets"), CASES)
def test_motion_finds_the_offset_within_two_of_its_errors_and_half_a_frame(
    shared_data: Callable[[str], Path], scene: str, downscale: int, offsets: dict[str, float]
) -> None:
    recording = open_recording(shared_data(scene), downscale=downscale)
    every = len(recording.frames) // 20  # of dome each third
    seen = by_motion(filmed(recording, offsets, 0, recording.frames[::every]))
    for name, offset in offsets.items():
        assert not seen[name].doubt
        assert abs(seen[name].seconds * recording.fps - offset) < min(0.5, 2 * seen[name].error * recording.fps)


def test_motion_that_repeats_itself_is_doubted(shared_data: Callable[[str], Path]) -> None:
    recording = open_recording(shared_data("studio"), downscale=2)
    there_and_back = [*range(12), *range(10, 0, -1)]
    seen = by_motion(filmed(recording, {"03": 0, "04": 5, "05": 14}, 0, 2 * there_and_back))
    assert any("is the motion repeated?" in one.doubt for one in seen.values())


def test_motion_of_another_event_is_doubted(shared_data: Callable[[str], Path]) -> None:
    views = filmed(open_recording(shared_data("studio"), downscale=2), dict.fromkeys(["02", "03", "04", "05"], 0.0), 0)
    camera, images, times = views["03"]
    rng = np.random.default_rng(1)
    wall = rng.integers(0, 255, (90, 12)).astype(np.uint8)
    walks = [np.concatenate([images[0][:, :148], np.roll(wall, 2 * i, 0)], axis=1) for i in range(len(times))]
    views["03"] = camera, walks, times
    assert by_motion(views)["03"].doubt


def test_what_motion_cannot_say_the_files_of_one_recorder_say() -> None:
    camera = Camera("a", 32, 24, np.array([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]]), np.eye(4))
    aside = replace(camera, T_camera_world=np.array([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    still = np.full((10, 24, 32), 90, np.uint8)
    times = np.arange(10) / 25
    watching = {"a": watch(still, times, camera), "b": watch(still, times, aside)}
    alike = {"a": a_video(25, None), "b": a_video(25, None)}
    clocks = common_clock(alike, "auto", lambda: watching)
    assert [clock.seconds for clock in clocks.values()] == [0.0, 0.0]
    assert clocks["b"].error == pytest.approx(0.5 / 25)
    assert clocks["b"].method.startswith("the files' own stamps")
    assert "motion does not say" in clocks["b"].method
    longer = replace(alike["b"], stamps=np.arange(14))
    refuses("motion does not say when .* started", common_clock, {**alike, "b": longer}, "auto", lambda: watching)


def a_video(rate: int, timecode: str | None) -> VideoFile:
    return VideoFile(Path("a.mp4"), (64, 48), 0, np.arange(10), Fraction(1, rate), timecode)


def never() -> dict:
    pytest.fail("all videos would be decoded although they have timecode")


def test_timecode_needs_no_look_at_images() -> None:
    videos = {"a": a_video(25, "10:00:00:00"), "b": a_video(25, "09:59:59:20"), "c": a_video(25, "10:00:01:00")}
    clocks = common_clock(videos, "auto", never)
    assert [clocks[name].seconds for name in videos] == pytest.approx([0.0, -0.2, 1.0], abs=1e-9)
    assert 0 < clocks["b"].error < 0.04
    midnight = common_clock({"a": a_video(25, "23:59:59:00"), "b": a_video(25, "00:00:00:00")}, "auto", never)
    assert midnight["b"].seconds == pytest.approx(1.0)
    assert clocks["b"].method == "timecode"


def evidence(**pairs: float) -> list[Evidence]:
    return [Evidence(pair[0], pair[1], seconds, 0.002, "sound") for pair, seconds in pairs.items()]


def test_a_camera_of_another_event_is_named() -> None:
    pairs = evidence(ab=0.1, ac=0.2, bc=0.1, ad=0.5, bd=2.0, cd=-1.0)
    refuses(r"without camera d all agree .*--offsets", _solved, "abcd", pairs, 0.04)


def test_a_loop_that_does_not_close_is_refused() -> None:
    pairs = evidence(ab=0.1, bc=0.1, ac=0.5)
    refuses(r"the sound contradicts itself by .* frames between", _solved, "abc", pairs, 0.04)


def test_given_offsets_are_in_frames_of_each_camera() -> None:
    clocks = given_clock({"a": a_video(25, None), "b": a_video(50, None)}, ("b=-7.5",))
    assert clocks["a"].seconds == 0
    assert clocks["b"].seconds == pytest.approx(-0.15)


STEADY = np.arange(60) / 30


def grid(began: float = 0.0, other: np.ndarray = STEADY, **asked: object) -> Grid:
    """Of two cameras that filmed at these times; `b` began so many seconds later."""
    videos = {}
    for name, times in (("a", STEADY), ("b", other)):
        stamps = np.rint(times * 90_000).astype(np.int64)
        videos[name] = VideoFile(Path("a.mp4"), (64, 48), 0, stamps, Fraction(1, 90_000))
    return grid_of(videos, {"a": Clock(0, 0.0, "given"), "b": Clock(began, 0.0, "given")}, **asked)


def test_cameras_that_expose_together_are_not_late() -> None:
    found = grid(10 / 30)
    assert found.rate == 30
    assert (found.indices["a"][0], found.indices["b"][0]) == (10, 0)
    assert len(found.indices["a"]) == 50
    assert found.late == {}


def test_half_a_frame_is_kept_and_not_interpolated() -> None:
    found = grid(-7.5 / 30)
    late = np.array(list(found.late["b"].values())) * 30
    assert np.abs(np.abs(late) - 0.5).max() < 1e-3
    assert max(map(abs, found.late["a"].values())) < 1e-6


def test_what_a_camera_dropped_is_left_out_for_all() -> None:
    found = grid(other=np.delete(STEADY, [20, 21, 22, 40]))
    assert not {20, 21, 22, 40} & found.indices["a"].keys()
    assert found.indices["b"][23] == 20
    assert any("4 of 60 frames left out" in note for note in found.notes)


def test_a_slower_rate_takes_every_other_image() -> None:
    found = grid(rate=15, times=(0.2, 1.0))
    assert list(found.indices["a"].values()) == list(range(6, 31, 2))
    assert list(found.indices["a"]) == list(range(3, 16))


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"times": (9.0, 10.0)}, r"--times asks for 9 to 10 seconds and the videos share 0 to 1.97: choose within"),
        ({"times": (1.0,)}, r"--times must be FIRST,LAST"),
        ({"began": 5.0}, r"camera a stopped 3\.0\d seconds before camera b began: leave one out"),
    ],
)
def test_what_nobody_recorded_is_refused(asked: dict, says: str) -> None:
    refuses(says, grid, **asked)
