"""Which image of which video belongs to a frame of the recording, and by how much it is late."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from d2_plugin.errors import D2Error
from d2_plugin.recordings.importing.clocks import Clock
from d2_plugin.recordings.importing.grid import grid_of
from d2_plugin.recordings.importing.video import VideoFile


def video(times: np.ndarray) -> VideoFile:
    return VideoFile(Path("a.mp4"), (64, 48), 0, np.rint(times * 90_000).astype(np.int64), Fraction(1, 90_000))


def clock(seconds: float) -> Clock:
    return Clock(seconds, 0.0, "given")


STEADY = np.arange(60) / 30


def test_cameras_that_expose_together_are_not_late() -> None:
    grid = grid_of({"a": video(STEADY), "b": video(STEADY)}, {"a": clock(0), "b": clock(10 / 30)})
    assert grid.rate == 30
    assert grid.indices["a"][0] == 10
    assert grid.indices["b"][0] == 0
    assert len(grid.indices["a"]) == 50
    assert grid.late == {}


def test_half_a_frame_is_kept_and_not_interpolated() -> None:
    grid = grid_of({"a": video(STEADY), "b": video(STEADY)}, {"a": clock(0), "b": clock(-7.5 / 30)})
    late = np.array(list(grid.late["b"].values())) * 30
    assert np.abs(np.abs(late) - 0.5).max() < 1e-3
    assert max(map(abs, grid.late["a"].values())) < 1e-6


def test_what_a_camera_dropped_is_left_out_for_all() -> None:
    dropped = np.delete(STEADY, [20, 21, 22, 40])
    grid = grid_of({"a": video(STEADY), "b": video(dropped)}, {"a": clock(0), "b": clock(0)})
    assert not {20, 21, 22, 40} & grid.indices["a"].keys()
    assert grid.indices["b"][23] == 20
    assert any("4 of 60 frames left out" in note for note in grid.notes)


def test_a_slower_rate_takes_every_other_image() -> None:
    grid = grid_of({"a": video(STEADY)}, {"a": clock(0)}, rate=15, times=(0.2, 1.0))
    assert list(grid.indices["a"].values()) == list(range(6, 31, 2))
    assert list(grid.indices["a"]) == list(range(3, 16))


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"times": (9.0, 10.0)}, r"--times asks for 9 to 10 seconds and the videos share 0 to 1.97: choose within"),
        ({"times": (1.0,)}, r"--times must be FIRST,LAST"),
        ({"frames": (3, 99)}, r"--frames asks for 99 and the cameras have 0 to 59 in common: choose within"),
    ],
)
def test_what_nobody_recorded_is_refused(asked: dict, says: str) -> None:
    with pytest.raises(D2Error, match=says):
        grid_of({"a": video(STEADY)}, {"a": clock(0)}, **asked)


def test_videos_without_a_common_instant_are_refused() -> None:
    with pytest.raises(D2Error, match=r"camera a stopped 3\.0\d seconds before camera b began: leave one out"):
        grid_of({"a": video(STEADY), "b": video(STEADY)}, {"a": clock(0), "b": clock(5.0)})
