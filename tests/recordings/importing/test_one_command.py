"""From videos to a recording, and to a scene: offsets, gains, turns, drops are undone; a stopped import goes on."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recorded import Filmed, Shooting, video

from d2_plugin.commands.cli import main
from d2_plugin.durable import read_table
from d2_plugin.recordings import Recording, open_recording, select_cameras
from d2_plugin.recordings.cameras.camera import CalibratedCamera
from d2_plugin.recordings.cameras.lens import Lens
from d2_plugin.recordings.importing.importing import import_videos
from d2_plugin.recordings.importing.settings import ImportSettings
from d2_plugin.recordings.importing.source import Cut, VideosSource
from d2_plugin.recordings.importing.steps import KIND
from d2_plugin.recordings.selection import select_frames

pytest.importorskip("av")
pytest.importorskip("cv2")

NAMES = ("01", "02", "03")
FPS = 24.0
SHOOTINGS = {
    "01": Shooting(),
    "02": Shooting(-7.5 / FPS, gain=(1.12, 1.1, 1.08), turn=90, dropped=(4, 11)),
    "03": Shooting(12 / FPS, gain=(0.87, 0.9, 0.93), turn=180),
}
"""By sound: a camera that started first, turned and left out frames; one that is darker and started last."""


@pytest.fixture(scope="module")
def plaza(shared_data: Callable[[str], Path]) -> Recording:
    return select_cameras(open_recording(shared_data("plaza")), NAMES)


@pytest.fixture(scope="module")
def filmed(plaza: Recording, tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    return video(plaza, tmp_path_factory.mktemp("filmed"), SHOOTINGS, sound=True)


@pytest.fixture(scope="module")
def imported(filmed: Filmed) -> Path:
    """An import whose images stay in the videos."""
    import_videos(settings_of(filmed, filmed.folder / "recording", images="videos"))
    return filmed.folder / "recording"


def settings_of(filmed: Filmed, folder: Path, **more: object) -> ImportSettings:
    return ImportSettings(videos=(filmed.videos,), calibration=filmed.calibration, output=folder, **more)


def test_offsets_by_sound_are_within_a_tenth_of_a_frame(imported: Path) -> None:
    clocks = read_table(imported / "import" / "clocks.json", KIND)
    for name, shot in SHOOTINGS.items():
        assert clocks[name]["method"] == "sound"
        assert abs(clocks[name]["seconds"] - shot.offset) * FPS < 0.1
        assert 0 <= clocks[name]["error"] * FPS < 0.1


def test_each_frame_is_the_right_one_of_each_camera(imported: Path, plaza: Recording) -> None:
    recording = open_recording(imported)
    first = 12  # the camera that started last
    assert len(recording.frames) >= 10
    for name in ("01", "03"):
        gain = np.array(SHOOTINGS[name].gain)
        for frame in (recording.frames[0], recording.frames[-1]):
            error = [
                np.abs(
                    recording.image(name, frame) / gain - plaza.image(name, plaza.frames[min(first + frame + off, 23)])
                ).mean()
                for off in (-1, 0, 1)
            ]
            assert int(np.argmin(error)) == 1 or first + frame + 1 > 23
            assert error[1] < 3


def test_gains_are_within_one_percent_of_what_was_applied(imported: Path, plaza: Recording) -> None:
    from d2_plugin.recordings.importing.exposure import measured_exposures

    own = measured_exposures(plaza, NAMES)  # plaza's cameras differ by up to three percent themselves
    found = open_recording(imported).exposures
    applied = np.log([np.array(SHOOTINGS[name].gain) for name in NAMES])
    measured = np.log([np.array(found[name].gain) / own[name].gain for name in NAMES])
    assert np.abs(measured - (applied - applied.mean(0))).max() < 0.01


def test_images_that_stay_in_the_videos_are_the_same_as_written_ones(filmed: Filmed, imported: Path, tmp_path) -> None:
    import_videos(settings_of(filmed, tmp_path / "written", frames=(0, 3), exposure=False))
    opened, written = open_recording(imported), open_recording(tmp_path / "written")
    assert opened.layout == "videos"
    assert not list(imported.rglob("*.png"))
    assert written.frames == (0, 3)
    for name in NAMES:
        for frame in (3, 0):
            assert (opened.image(name, frame) == written.image(name, frame)).all()
    some = select_frames(select_cameras(opened, ["03"]), opened.frames[:2])
    assert some.seconds(0, "03") == pytest.approx(written.seconds(0, "03"), abs=1e-4)


def test_the_commands_and_a_stopped_import_goes_on(filmed: Filmed, tmp_path: Path, answered, monkeypatch) -> None:
    folder = tmp_path / "c"
    words = ["import", str(filmed.videos), "--calibration", str(filmed.calibration), "--output", str(folder)]
    words += ["--scale", "0.5", "--times", "0,0.1", "--offsets", "sound"]
    said = answered(*words)
    assert "start in frames, by sound: 01 +0.00, 02 -7.5" in said
    assert "3 cameras, 3 frames at 24 per second, 160x90 pixels" in said
    said = answered("plan", str(folder), "--train-cameras", "all")
    assert "3 training cameras, " in said
    assert "images were taken up to 0." in said
    files = [folder / "import" / "clocks.json", folder / "cameras.json", *(folder / "images").rglob("*.png")]
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}
    (folder / "cameras.json").unlink()
    lost = folder / "images" / "02" / "00002.png"
    lost.unlink()
    for measured in ("clocks.read_sound", "importing.measured_exposures"):
        monkeypatch.setattr(f"d2_plugin.recordings.importing.{measured}", lambda *_: pytest.fail("found again"))
    assert main(words) == 0
    assert {path: path.read_bytes() for path in files} == {path: data for path, (data, _) in before.items()}
    assert [path for path in files if path.suffix == ".png" and path.stat().st_mtime_ns != before[path][1]] == [lost]


def test_crop_and_scale_move_the_camera_with_the_image(filmed: Filmed, imported: Path, tmp_path: Path) -> None:
    options = {"crop": ("160x120+80+30",), "scale": 0.5, "frames": (2, 4), "exposure": False, "offsets": ("none",)}
    import_videos(settings_of(filmed, tmp_path / "part", **options))
    part = open_recording(tmp_path / "part")
    whole = open_recording(imported).cameras["01"]
    camera = part.cameras["01"]
    assert (camera.width, camera.height) == (80, 60)
    assert part.frames == (2, 4)
    K = whole.K
    expected = [K[0, 0] / 2, K[1, 1] / 2, (K[0, 2] - 80) / 2, (K[1, 2] - 30) / 2]
    assert [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]] == pytest.approx(expected)


def test_margins_of_undistorted_images_are_not_valid() -> None:
    K = np.array([[90.0, 0, 50], [0, 90, 40], [0, 0, 1]])
    camera = CalibratedCamera("a", 100, 80, Lens(K, "opencv", (0.3,)), np.eye(4))
    valid = VideosSource({}, {}, {"a": camera}, {"a": Cut(0, 0, 100, 80, 0.5)}).recorded("a")
    assert valid.shape == (40, 50)
    assert valid[20, 25]
    assert not valid[0, 0]


@pytest.fixture
def pose2sim(shared_data: Callable[[str], Path], tmp_path: Path) -> Callable[[int], Filmed]:
    recording = open_recording(shared_data("pose2sim_single"))
    shootings = {name: Shooting() for name in recording.cameras}
    return lambda frames: video(select_frames(recording, recording.frames[:frames]), tmp_path / "filmed", shootings)


def words(filmed: Filmed, run: Path, *more: str) -> list[str]:
    given = ["train", str(filmed.videos), "--calibration", str(filmed.calibration), "--train-cameras", "all"]
    return [*given, "--output", str(run), "--import.scale", "0.2", *more]


def test_four_real_videos_become_a_scene(pose2sim, tmp_path: Path, capsys, answered, monkeypatch) -> None:
    run, filmed = tmp_path / "run", pose2sim(4)
    more = ("--import.offsets", "none", "--import.frames", "0:3:3", "--hooks", "none", "--iterations", "20")
    assert "8 images of 4 cameras" in answered(*words(filmed, run, *more))
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["test"] is None
    assert metrics["train"]["psnr"] > 8
    assert metrics["train_cameras"] == ["cam01", "cam02", "cam03", "cam04"]
    assert len(list((run / "images").glob("*.png"))) == 8
    recording = open_recording(tmp_path / "run-recording")
    assert {(camera.width, camera.height) for camera in recording.cameras.values()} == {(72, 128)}
    before = (run / "checkpoint.pt").read_bytes()
    monkeypatch.chdir(run)
    assert main(words(filmed, Path("."), *more)) == 0  # every step is there already
    assert "write images" not in capsys.readouterr().out
    assert (run / "checkpoint.pt").read_bytes() == before


@pytest.mark.slow
def test_with_the_whole_method_and_motion_as_the_only_clock(pose2sim: Callable[[int], Filmed], tmp_path: Path) -> None:
    assert main(words(pose2sim(20), tmp_path / "run", "--import.frames", "0:6:3", "--iterations", "60")) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["train"]["psnr"] > 12
    assert metrics["prior"] is not None
