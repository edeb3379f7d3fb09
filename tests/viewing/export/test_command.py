"""`d2 export` as a person meets it: every mistake is one sentence, and what was written is said."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import torch
from viewing.hostile import emptied, of_another_version, still_training

from d2_plugin.commands.cli import main
from d2_plugin.recordings.export.folder import save_recording
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.run import Run
from d2_plugin.viewing.export.export import FORMATS, Export
from d2_plugin.viewing.export.page import read_page


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps, and the same with a deformation field beside it."""
    folder = tmp_path_factory.mktemp("exported")
    recording = save_recording(
        synthetic_recording(cameras=3, held_out=1, frames=3, width=96, height=54), folder / "room"
    )
    words = ["train", str(recording), "--train-cameras", "train0,train1,train2", "--hooks", "none", "--iterations", "4"]
    for backbone in ("yang4d", "deform"):
        assert main([*words, "--backbone", backbone, "--output", str(folder / backbone)]) == 0
    return folder


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What `d2 export` says on stderr when it refuses."""
    capsys.readouterr()
    assert main(["export", *words]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("d2: ")
    assert "\n" not in said
    return said


@pytest.mark.parametrize("backbone", ["yang4d", "deform"])
def test_a_run_becomes_a_page_of_a_stated_size(
    trained: Path, backbone: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(trained / backbone)]) == 0
    path = trained / backbone / "export" / "scene.html"
    said = capsys.readouterr().out
    assert f"{path} ({path.stat().st_size / 1e6:.1f} MB)" in said
    assert "16-bit codes: off by median" in said
    header = read_page(path).header
    assert header["frames"] == [0, 1, 2]
    assert [camera["held_out"] for camera in header["cameras"]] == [False, False, False, True]
    assert "the learnt background, in every direction" in said
    background = Run.load(trained / backbone).trained().model.background
    assert header["background"] == torch.cat([background.constant, background.harmonics]).tolist()


def test_frames_are_chosen_by_number(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(trained / "yang4d"), "--format", "spz", "--frames", "0:2:2"]) == 0
    folder = trained / "yang4d" / "export" / "spz"
    assert sorted(path.name for path in folder.iterdir()) == ["frame_00000.spz", "frame_00002.spz"]
    said = capsys.readouterr().out
    assert f"2 files in {folder}" in said
    assert "the background behind the Gaussians is left out" in said


class TestOneSentence:
    def test_a_wrong_format(self, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "splatv" in complaint(capsys, str(trained / "yang4d"), "--format", "splat")

    def test_no_run(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert "holds no run" in complaint(capsys, str(tmp_path))

    def test_a_run_without_a_checkpoint(
        self, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        copy = Path(shutil.copytree(trained / "yang4d", tmp_path / "run"))
        (copy / "checkpoint.pt").unlink()
        assert "holds no checkpoint yet" in complaint(capsys, str(copy))

    def test_a_run_that_still_trains(self, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        copy = still_training(trained / "yang4d", tmp_path / "run", 3)
        assert "is at step 3 of 4: wait for `d2 train` to end, or add --unfinished" in complaint(capsys, str(copy))
        assert main(["export", str(copy), "--unfinished"]) == 0

    def test_a_damaged_checkpoint(self, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        copy = Path(shutil.copytree(trained / "yang4d", tmp_path / "run"))
        (copy / "checkpoint.pt").write_bytes((copy / "checkpoint.pt").read_bytes()[:1000])
        assert "is damaged" in complaint(capsys, str(copy))

    def test_a_run_of_another_version_and_one_without_gaussians(
        self, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert "version 99" in complaint(capsys, str(of_another_version(trained / "yang4d", tmp_path / "later")))
        said = complaint(capsys, str(emptied(trained / "yang4d", tmp_path / "empty")))
        assert "has no Gaussians: nothing is left to export" in said

    def test_a_run_without_a_prior_and_with_a_name_of_markup(self, trained: Path, tmp_path: Path) -> None:
        """No hook ran, so there is no prior; the page needs none."""
        copy = Path(shutil.copytree(trained / "yang4d", tmp_path / "<script>alert(1)<"))
        assert not (copy / "priors").exists()
        assert main(["export", str(copy)]) == 0
        assert (copy / "export" / "scene.html").is_file()

    def test_frames_that_are_not_there(self, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
        run = str(trained / "yang4d")
        assert "no frame 7: it has 0 to 2" in complaint(capsys, run, "--format", "ply", "--frames", "7")
        assert "--frames is for ply and spz" in complaint(capsys, run, "--frames", "1")

    def test_a_field_in_a_format_of_straight_lines(self, trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
        model = Run.load(trained / "deform").trained().model
        said = complaint(capsys, str(trained / "deform"), "--format", "ftgs") if model.deforms else "html or splatv"
        assert "html or splatv" in said


def test_the_formats_that_are_declared_are_those_that_are_written() -> None:
    assert set(get_args(get_type_hints(Export)["format"])) == set(FORMATS)
