"""From real videos and their calibration to a trained scene with one command: pose2sim's four cameras."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from recorded import Filmed, Shooting, video

from d2_plugin.commands.cli import main
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.selection import select_frames

pytest.importorskip("av")
pytest.importorskip("cv2")


@pytest.fixture
def pose2sim(shared_data: Callable[[str], Path], tmp_path: Path) -> Callable[[int], Filmed]:
    recording = open_recording(shared_data("pose2sim_single"))
    shootings = {name: Shooting() for name in recording.cameras}
    return lambda frames: video(select_frames(recording, recording.frames[:frames]), tmp_path / "filmed", shootings)


def words(filmed: Filmed, run: Path, *more: str) -> list[str]:
    given = ["train", str(filmed.videos), "--calibration", str(filmed.calibration), "--train-cameras", "all"]
    return [*given, "--output", str(run), "--import.scale", "0.2", *more]


def test_four_real_videos_become_a_scene(pose2sim: Callable[[int], Filmed], tmp_path: Path, capsys, answered) -> None:
    run = tmp_path / "run"
    command = words(pose2sim(4), run, "--import.offsets", "none", "--import.frames", "0:3:3", "--hooks", "none")
    said = answered(*command, "--iterations", "20")
    assert "8 images of 4 cameras" in said
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["test"] is None
    assert metrics["train"]["psnr"] > 8
    assert metrics["train_cameras"] == ["cam01", "cam02", "cam03", "cam04"]
    assert len(list((run / "images").glob("*.png"))) == 8
    recording = open_recording(tmp_path / "run-recording")
    assert {(camera.width, camera.height) for camera in recording.cameras.values()} == {(72, 128)}
    before = (run / "checkpoint.pt").read_bytes()
    assert main([*command, "--iterations", "20"]) == 0  # every step is there already
    assert "write images" not in capsys.readouterr().out
    assert (run / "checkpoint.pt").read_bytes() == before


@pytest.mark.slow
def test_with_the_whole_method_and_motion_as_the_only_clock(pose2sim: Callable[[int], Filmed], tmp_path: Path) -> None:
    assert main(words(pose2sim(20), tmp_path / "run", "--import.frames", "0:6:3", "--iterations", "60")) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["train"]["psnr"] > 12
    assert metrics["prior"] is not None
