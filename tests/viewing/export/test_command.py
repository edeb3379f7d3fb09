"""`d2 export` as a person meets it: every mistake is one sentence, and what was written is said."""

import re
from pathlib import Path

import pytest
import torch
from oracles.export_files import ReadPage

from d2_plugin.commands.cli import main
from d2_plugin.runs.run import Run
from d2_plugin.viewing.export import compact


@pytest.fixture(scope="module")
def trained(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps, and the same with a deformation field beside it."""
    folder = tmp_path_factory.mktemp("exported")
    words = ["train", str(room), "--train-cameras", "train0,train1,train2", "--hooks", "none", "--iterations", "4"]
    for backbone in ("yang4d", "deform"):
        assert main([*words, "--backbone", backbone, "--output", str(folder / backbone)]) == 0
    return folder


@pytest.mark.parametrize("backbone", ["yang4d", "deform"])
def test_a_run_becomes_a_page_of_a_stated_size(trained: Path, backbone: str, answered) -> None:
    said = answered("export", trained / backbone)
    path = trained / backbone / "export" / "scene.html"
    assert f"{path} ({path.stat().st_size / 1e6:.1f} MB)" in said
    header = ReadPage(path).header
    assert header["frames"] == [0, 1, 2, 3]
    assert [camera["held_out"] for camera in header["cameras"]] == [False, False, False, True]
    assert "the learnt background, in every direction" in said
    background = Run.load(trained / backbone).trained().model.background
    assert header["models"][0]["background"] == torch.cat([background.constant, background.harmonics]).tolist()


def test_a_format_and_frames_are_chosen(trained: Path, answered, refused) -> None:
    run, folder = trained / "yang4d", trained / "yang4d" / "export" / "ply"
    said = answered("export", run, "--format", "ply", "--frames", "0:2:2")
    assert sorted(path.name for path in folder.iterdir()) == ["frame_00000.ply", "frame_00002.ply"]
    assert f"2 files in {folder}" in said
    assert "the background behind the Gaussians is left out" in said
    assert "no frame 7: it has 0 to 3" in refused("export", run, "--format", "ply", "--frames", "7")
    assert "--frames is for ply, sog, spz, glb" in refused("export", run, "--frames", "1")
    assert "--frames" in refused("export", run, "--format", "ply", "--frames", "")
    assert "4dgs" in refused("export", run, "--format", "splatv")


def test_a_share_of_the_gaussians_is_kept_and_its_cost_said(trained, tmp_path, capsys, refused, monkeypatch) -> None:
    monkeypatch.setattr(compact, "STEPS", 20)
    run, sizes = str(trained / "yang4d"), []
    for keep in ("1", "0.25"):
        assert main(["export", run, "--keep", keep, "--output", str(tmp_path)]) == 0
        sizes.append(ReadPage(tmp_path / "scene.html").model)
    said = capsys.readouterr().out
    assert sizes[1]["count"] <= sizes[0]["count"] / 3
    form = r"Gaussians: (.*) dB at the training cameras, (.*) with all; (.*) dB held out, (.*) with all"
    after, before, kept, whole = re.search(form, said).groups()
    assert float(after) > float(before), "20 steps more of a run of four"
    assert [f"{model['scores']['']:.2f}" for model in sizes] == [whole, kept]
    assert "keep must be above 0" in refused("export", run, "--keep", "0")


def test_two_runs_become_one_page_by_export_and_by_compare(trained: Path, tmp_path: Path, answered, refused) -> None:
    runs = [str(trained / name) for name in ("yang4d", "deform")]
    assert main(["export", *runs, "--output", str(tmp_path)]) == 0
    assert f"Page: {tmp_path / 'compared.html'}" in answered("compare", *runs, "--page", tmp_path / "compared.html")
    for name in ("scene.html", "compared.html"):
        header = ReadPage(tmp_path / name).header
        assert [model["name"] for model in header["models"]] == ["yang4d", "deform"]
        assert header["models"][0]["scores"].keys() == {"", "test0"}
        assert list(header["recorded"]) == ["test0"]
    assert "give one, or for a page" in refused("export", *runs, "--format", "ply")
