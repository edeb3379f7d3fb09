"""The bench of the official trainers: its table, what moves and what lies between, and each official script."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.trainers import between
from benchmarks.trainers.bench import TrainersBench, run
from benchmarks.trainers.moving import Moving, save_truth
from benchmarks.trainers.page import read_rows, replaced, table
from benchmarks.trainers.trials import TRIALS
from d2_plugin.protocol import View
from d2_plugin.recordings import open_recording
from d2_plugin.viewing.rendering import RenderedView


def test_the_rows_of_the_page_are_read_and_its_tables_made_of_them() -> None:
    page = Path(__file__).parents[2] / "docs" / "results" / "attach.md"
    text = page.read_text()
    assert replaced(text, table(read_rows(page.with_suffix("") / "rows.jsonl")), "") == text


def true_images(folder: Path) -> Path:
    """A trained view, and a held-out one whose left half moves."""
    images = np.stack([np.full((4, 6, 3), 50, np.uint8), np.full((4, 6, 3), 150, np.uint8)])
    moves = np.zeros((2, 4, 6), bool)
    moves[:, :, :3] = True
    np.savez(
        folder / "truth.npz", images=images, moving=moves, held_out=np.array([False, True]), frames=[0], recording=""
    )
    return folder / "truth.npz"


def test_what_moves_is_scored_in_held_out_views_alone_and_the_last_comparison_counts(tmp_path: Path) -> None:
    moving = Moving(true_images(tmp_path))
    trained, held_out = (torch.full((3, 4, 6), value / 255) for value in (50, 150))
    moving.see(trained, trained)
    assert moving.score() is None
    drawn = held_out.clone()
    drawn[:, :, :3] += 0.1
    for image in (torch.zeros(3, 4, 6), drawn):
        moving.see(image, held_out)
    moving.see(torch.zeros(3, 4, 6), torch.ones(3, 4, 6))  # an image that the recording does not have
    assert moving.score() == pytest.approx(20.0, abs=1e-3), "the still half is exact and does not count"


@pytest.mark.parametrize("repository", ["spacetime", "fudan"])
def test_instants_between_are_asked_for_in_the_trainers_own_time(
    repository: str, shared_data: Callable[[str], Path], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A model that shows the true image of the time it is asked for has no error, at trained instants and between."""
    studio = open_recording(shared_data("studio"), downscale=4)
    truth = save_truth(shared_data("studio"), [0, 2, 4], 4, tmp_path / "truth.npz")
    unit = 1 / studio.fps if repository == "fudan" else 1 / 6  # three instants, two frames apart

    def drawn(backbone: object, view: View) -> RenderedView:
        image = studio.image(view.camera, round(view.time / unit))
        found = torch.from_numpy(image).float() / 255
        return RenderedView(found + 0.01, found[..., 0], found[..., 0], None)

    monkeypatch.setattr(between, "render_view", drawn)
    found = between.scores(lambda: SimpleNamespace(view=lambda view: view), repository, truth)
    assert found == pytest.approx({"psnr_moving": 40, "psnr_moving_between": 40}, abs=0.3)  # all but what is white
    assert between.scores(None, repository, save_truth(shared_data("studio"), [0, 1], 4, tmp_path / "all.npz")) == {}


CHECKOUTS = os.environ.get("D2_CHECKOUTS")
ITERATIONS = int(os.environ.get("D2_CHECKOUT_ITERATIONS", "60"))


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIALS)
def test_the_official_trainer_bare_without_hooks_and_attached(name: str, tmp_path, shared_data, capsys) -> None:
    """D2_CHECKOUTS is a folder with a checkout of each repository; D2_CHECKOUT_ITERATIONS how long each run is."""
    if CHECKOUTS is None:
        pytest.skip("D2_CHECKOUTS is not set: give a folder with one checkout per repository")
    if not (Path(CHECKOUTS) / TRIALS[name].folder).is_dir():
        pytest.skip(f"no {TRIALS[name].folder} in {CHECKOUTS}")
    scale = 1 if name == "fudan" else 2  # its report measures MS-SSIM, which needs images more than 160 pixels high
    settings = TrainersBench(
        Path(CHECKOUTS), (shared_data("studio"),), (name,), iterations=ITERATIONS, frames=3, downscale=scale,
        work=tmp_path / "work", output=tmp_path / "rows.jsonl",
    )  # fmt: skip
    text = run(settings)
    with capsys.disabled():
        sys.stdout.write(f"\n{text}\n")
    bare, without, attached = read_rows(settings.output)
    assert [row["failed"] for row in (bare, without, attached)] == [None] * 3
    assert bare["psnr"].keys() == attached["psnr"].keys() != set()
    assert (bare["digest"], bare["psnr"]) == (without["digest"], without["psnr"])
    assert bare["digest"] != attached["digest"]
    assert attached["inserted"] > 0
