"""The `d2` command as a person uses it: from recording to score, the demo, and one sentence for every mistake."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from oracles.export_files import ReadPage
from prior_cases import contents
from refusals import refuses

from d2_plugin.commands.cli import main
from d2_plugin.config import D2Config
from d2_plugin.extras import imported
from d2_plugin.recordings import open_recording
from d2_plugin.recordings.export import folder as folder_layout
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.images import read_image, write_png
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing import demo
from d2_plugin.viewing.viewed import viewed_run

pytest.importorskip("pycolmap", reason="pycolmap is in the `stereo` extra")
pytest.importorskip("cv2", reason="opencv is in the `image` extra")

Refused = Callable[..., str]

CAMERAS = "train0,train1,train2"


@pytest.fixture(scope="module")
def finished(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run with all hooks."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert train(recording, Path("full")) == 0
    return folder / "full"


def words(recording: Path, output: Path, *more: str) -> list[str]:
    fixed = ["--train-cameras", CAMERAS, "--iterations", "40", "--output", str(output)]
    return ["train", str(recording), *fixed, *more]


def train(recording: Path, output: Path, *more: str) -> int:
    return main(words(recording, output, *more))


def test_a_run_leaves_scores_images_configuration_and_checkpoint(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert set(metrics["test"]) >= {"psnr", "ssim1", "ssim2", "lpips", "depth_absrel"}
    assert metrics["test"]["psnr"] > 10
    assert 0 < metrics["test"]["depth_absrel"] < 1
    assert metrics["test"]["lpips"] is None
    said = {"train_cameras": CAMERAS.split(","), "test_cameras": ["test0"], "iterations": 40, "mono_emulated": True}
    said["hooks"] = ["prior", "densify", "prune", "depth_loss", "motion", "parallax"]
    assert said.items() <= metrics.items()
    assert metrics["gaussians"] > 100
    assert set(metrics["seconds"]) == {"priors", "train", "eval"}
    assert metrics["plan"]["temporal"]["use"] is True
    assert len(metrics["per_view"]) == len(list((finished / "images").glob("test0_*.png"))) == 2
    assert (finished / "checkpoint.pt").is_file()
    PriorStore.open(D2Config.from_toml(finished / "d2.toml").prior)  # of use to any trainer as it is


def test_evaluating_again_gives_the_same_scores(finished: Path) -> None:
    before = json.loads((finished / "metrics.json").read_text())
    assert main(["eval", str(finished), "--no-images"]) == 0
    after = json.loads((finished / "metrics.json").read_text())
    assert (after["test"], after["per_view"]) == (before["test"], before["per_view"])


def test_a_run_finds_its_recording_where_that_was_moved(finished, recording, tmp_path, answered, refused) -> None:
    run, place = shutil.copytree(finished, tmp_path / "a run"), shutil.copytree(recording, tmp_path / "here")
    scores = json.loads((finished / "metrics.json").read_text())["per_view"]

    def evaluated(*more: str) -> object:
        answered("eval", str(run), "--no-images", *more)
        return json.loads((run / "metrics.json").read_text())["per_view"]

    assert evaluated("--recording", str(place)) == scores
    moved = place.rename(tmp_path / "there")
    remedy = f"if it was moved, `d2 eval '{run}' --recording PATH` says where to"
    assert f"{place}, the recording of {run}, is not there: {remedy}" in refused("eval", str(run))
    refused("eval", str(run), "--recording", str(tmp_path))
    assert remedy in refused("render", str(run)), "what is no recording was not kept"
    assert evaluated("--recording", str(moved)) == scores
    assert evaluated() == scores


def test_another_recording_of_the_same_rig_does_not_take_the_place_of_a_runs_own(
    finished, recording, tmp_path, refused
) -> None:
    run, other = shutil.copytree(finished, tmp_path / "full"), shutil.copytree(recording, tmp_path / "other")
    for image in (other / "images").glob("*/*.png"):
        write_png(image, read_image(image)[:, ::-1])
    kept = {name: (run / name).read_bytes() for name in ("run.json", "metrics.json")}
    said = refused("eval", str(run), "--no-images", "--recording", str(other))
    assert f"{other} is not the recording of {run}, its images of camera train0 are others" in said
    assert {name: (run / name).read_bytes() for name in kept} == kept


@pytest.mark.parametrize("camera", ["train0", "test0"])
def test_scores_of_images_that_were_changed_in_place_say_so(
    finished, recording, tmp_path, answered, caplog, camera
) -> None:
    run, place = shutil.copytree(finished, tmp_path / "full"), shutil.copytree(recording, tmp_path / "here")
    answered("eval", str(run), "--no-images", "--recording", str(place))
    assert "were changed" not in caplog.text
    for image in (place / "images" / camera).glob("*.png"):
        write_png(image, read_image(image)[:, ::-1])
    answered("eval", str(run), "--no-images")
    assert f"images of camera {camera} were changed since this run was scored" in caplog.text


def test_a_run_in_the_current_folder_has_its_name(finished: Path, tmp_path, answered, monkeypatch) -> None:
    monkeypatch.chdir(shutil.copytree(finished, tmp_path / "full"))
    assert "\n| full | " in answered("eval", ".", "--no-images")
    answered("report", ".", "--output", "page", "--no-images")
    assert "--output full" in (tmp_path / "full" / "page" / "report.md").read_text()
    assert viewed_run(Path()).name == "full"


def test_priors_are_built_in_parts_and_shown_on_a_sheet(
    recording, finished, tmp_path, capsys, answered, monkeypatch
) -> None:
    monkeypatch.setattr("d2_plugin.runs.prior.trials.STEPS", 10)
    copy, tmp_path = shutil.copytree(recording, tmp_path / recording.name), tmp_path / "priors"
    shutil.rmtree(copy / "images" / "test0")  # it does not train: no image of it is needed
    build = ["priors", str(copy), "--train-cameras", CAMERAS, "--output", str(tmp_path)]
    assert main([*build, "--shard", "2/2"]) == 0
    assert not (tmp_path / "contact_sheet.png").exists()
    told = capsys.readouterr().out
    assert "held against" not in told, "a part is not the whole"
    assert "here monocular depth" not in told, "and is not tried out"
    told = answered(*build)
    assert "verified" in told
    assert "held against the true depth of" in told
    assert "here monocular depth " in told, "what left-out cameras showed, for every trainer that reads this prior"
    assert PriorStore.open(tmp_path).tried()["text"] in told
    assert (tmp_path / "contact_sheet.png").is_file()
    whole, joined = PriorStore.open(finished / "priors"), PriorStore.open(tmp_path)
    for camera in CAMERAS.split(","):
        assert np.array_equal(whole.prior(camera, 1).depth, joined.prior(camera, 1).depth)


def test_workers_build_into_a_folder_named_from_here(finished: Path, recording: Path, answered, monkeypatch) -> None:
    pytest.importorskip("distributed", reason="dask.distributed is in the `cluster` extra")
    monkeypatch.chdir(finished)
    monkeypatch.setattr("d2_plugin.runs.prior.trials.can_decide", lambda *_: False)
    told = answered("priors", recording, "--train-cameras", CAMERAS, "--output", "priors", "--workers", "1")
    assert "of other cameras" not in told


def test_a_hook_that_changes_nothing_retires_and_the_scores_say_so(recording, finished, tmp_path, capsys) -> None:
    config = tmp_path / "config.toml"
    config.write_text("[d2]\nretire_after = 2\n[densify]\nmax_gaussians = 0\n")
    hooks = ["--hooks", "densify", "--priors", str(finished / "priors"), "--config", str(config)]
    assert train(recording, tmp_path / "idle", *hooks) == 0
    told = capsys.readouterr().out
    assert "densify retired at step 6: it changed next to nothing" in told
    assert "found sky" not in told, "the background is on whatever the prior found"
    assert json.loads((tmp_path / "idle" / "metrics.json").read_text())["retired"] == {"densify": 6}


@pytest.mark.parametrize(
    ("shard", "says"), [("1/2 --workers 2", "leave it out"), ("3/2", "parts are 1 to 2"), ("half", "give I/N")]
)
def test_a_part_that_cannot_be_built_is_refused(recording: Path, tmp_path, refused, shard: str, says: str) -> None:
    build = ["priors", recording, "--train-cameras", CAMERAS, "--output", tmp_path / "priors", "--shard"]
    assert says in refused(*build, *shard.split())


@pytest.mark.parametrize("command", [("priors", "nowhere", "--train-cameras", "a"), ("bench", "training", "nowhere@a")])
@pytest.mark.parametrize(
    ("at", "why"),
    [
        ("there", "missing port"),
        ("tcp://nohost.invalid:8786", "[Errno"),
        ("tcp://127.0.0.1:99999", "ports are 1 to 65535"),
        ("tls://127.0.0.1:1", "TLS"),
        ("tcp://127.0.0.1:1", "Timed out"),
    ],
)
def test_a_cluster_that_is_not_there_is_refused_before_anything_is_read(refused, monkeypatch, command, at, why) -> None:
    distributed = pytest.importorskip("distributed", reason="dask.distributed is in the `cluster` extra")
    connect = Mock(side_effect=lambda at, **more: client(at, **(more | {"timeout": "0.2s"})))
    client, _ = distributed.Client, monkeypatch.setattr(distributed, "Client", connect)
    said = refused(*command, "--scheduler", at, "--output", "here")
    assert f"no dask scheduler answers at {at} ({why}" in said
    assert connect.called == (why == "Timed out"), "a client without an address waits 20 s when it is forgotten"


def test_compare_tabulates_what_was_measured_and_keeps_runs_of_one_name_apart(finished, tmp_path, answered) -> None:
    other = shutil.copytree(finished, tmp_path / finished.name)
    lines = answered("compare", str(finished), str(other)).splitlines()
    header, _, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    metrics = json.loads((finished / "metrics.json").read_text())
    for row, run in zip(rows, (finished, other), strict=True):
        cells = dict(zip(header, row, strict=True))
        assert cells["run"] == str(run)
        assert cells["PSNR"] == f"{metrics['test']['psnr']:.2f}"
        assert cells["LPIPS"] == "-"


def test_compare_says_that_runs_were_not_scored_on_the_same_images(recording, tmp_path, answered) -> None:
    runs = [tmp_path / name for name in ("whole", "again", "one_frame", "small")]
    for run, more in zip(runs, ((), ("--seed", "3"), ("--frames", "0"), ("--downscale", "2")), strict=True):
        assert train(recording, run, "--hooks", "none", "--iterations", "2", *more) == 0
    for run, said in zip(runs[1:], (False, True, True), strict=True):
        assert ("such rows do not compare" in answered("compare", str(runs[0]), str(run))) == said


def test_plan_names_each_decision_with_its_measurement(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", str(recording), "--train-cameras", CAMERAS]) == 0
    notes, lines = [], []
    first, *rest = capsys.readouterr().out.splitlines()
    cameras = "4 cameras (train0, train1, train2, test0)"
    assert first == f"recording  room: layout folder, {cameras}, frames 0 to 1 (2) at 12 per second, 96x54 pixels"
    for line in rest:
        (notes if line.split()[0] == "note" else lines).append(line)
    assert notes, "what is known about the recording is said"
    assert [line.split()[1] for line in lines] == ["temporal", "stereo", "monocular", "verification"]
    assert "% of a camera's pixels change" in lines[0]
    assert "(emulated)" in lines[2]


def test_plan_says_the_rate_of_the_chosen_frames_and_that_no_clock_is_known(tmp_path: Path, answered) -> None:
    room = save_recording(synthetic_recording(cameras=2, held_out=0, frames=5, width=96, height=54), tmp_path / "room")
    said = answered("plan", str(room), "--train-cameras", "all", "--frames", "0:4:2")
    assert "frames 0 to 4 (3) at 6 per second" in said
    assert "nothing says how the cameras were synchronised" in said


def test_the_doctor_of_a_recording_names_the_plan(recording: Path, refused: Refused) -> None:
    assert f"d2 plan {recording}" in refused("doctor", recording)


def test_a_folder_named_like_a_missing_package_is_none(tmp_path: Path, monkeypatch, answered) -> None:
    (tmp_path / "nobodys").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("d2_plugin.commands.doctor.OPTIONAL", {"nobodys": ("view", "x"), "refusals": ("view", "y")})
    assert "nobodys     missing, needed for x" in (report := answered("doctor"))
    assert "refusals    of unknown version (y)" in report
    refuses("x needs N", imported, "nobodys", "N", "view", "x")


def test_one_instant_leaves_the_temporal_dimension_out_and_all_cameras_may_train(recording: Path, tmp_path) -> None:
    run = tmp_path / "still"
    assert train(recording, run, "--frames", "1:1", "--hooks", "none", "--train-cameras", f"{CAMERAS},test0") == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["plan"]["temporal"] == {"use": False, "reason": "one instant"}
    assert metrics["test"] is None
    assert metrics["test_cameras"] == []
    assert metrics["train"]["psnr"] > 10
    assert main(["export", str(run), "--format", "ply"]) == 0
    assert [path.name for path in (run / "export" / "ply").iterdir()] == ["frame_00001.ply"]


def test_an_output_folder_of_another_run_or_with_other_files_is_left_alone(
    recording, finished, tmp_path, refused
) -> None:
    before = contents(finished)
    assert "holds another run, made with other settings of seed" in refused(*words(recording, finished, "--seed", "5"))
    assert contents(finished) == before
    (tmp_path / "notes.txt").write_text("mine")
    assert "is not empty and holds no run" in refused(*words(recording, tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_instants_between_the_trained_ones_have_their_own_score(tmp_path: Path, capsys) -> None:
    room = synthetic_recording(cameras=3, held_out=1, frames=5, width=48, height=27)
    folder = save_recording(room, tmp_path / "longer")
    assert train(folder, tmp_path / "run", "--hold-out-instants", "2", "--hooks", "none") == 0
    assert "PSNR between" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["test"]["psnr_between"] > 0
    assert len(metrics["per_frame"]) == 5


def test_a_demo_cut_off_while_it_writes_its_recording_goes_on(tmp_path: Path, monkeypatch, answered) -> None:
    tiny = synthetic_recording(cameras=3, held_out=1, frames=2, width=96, height=54)
    monkeypatch.setattr(demo, "synthetic_recording", lambda: tiny)
    command = ["demo", "--output", str(tmp_path / "demo"), "--iterations", "4"]
    write, written = folder_layout.write_png, []

    def cut_off(*arguments: object) -> None:
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(write(*arguments))  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(folder_layout, "write_png", cut_off)
        assert main(command) == 130
    assert len(written) == 3
    out = answered(*command)
    assert all(f"| {name}" in out for name in demo.VARIANTS)
    assert (tmp_path / "demo" / "comparison.png").is_file()
    assert f"Player: {tmp_path / 'demo' / 'player.html'}" in out
    assert ReadPage(tmp_path / "demo" / "player.html").header["name"] == "recording"
    assert len(open_recording(tmp_path / "demo" / "recording").frames) == 2
    assert not list((tmp_path / "demo").glob("*unfinished*"))
