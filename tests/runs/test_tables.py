"""Tables of scores: every view, frame and camera; what stands out is bold, and no cell can break its table."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from d2_plugin.recordings.selection import select_cameras
from d2_plugin.recordings.synthetic.room import synthetic_recording
from d2_plugin.runs.evaluation import evaluate
from d2_plugin.runs.tables import Table, markdown, metrics_table, view_tables

NAMES = ["test0", "test1"]


@pytest.fixture(scope="module")
def metrics() -> dict[str, Any]:
    """Real scores of renders that get worse with time and flicker."""
    recording = select_cameras(synthetic_recording(cameras=3, frames=3, width=40, height=30), NAMES)

    def render(camera: str, frame: int) -> tuple[Tensor, None]:
        color = torch.from_numpy(recording.image(camera, frame).astype(np.float32) / 255)
        return color * (1 - 0.1 * (1 + frame)), None

    scores = evaluate(render, recording, NAMES, recording.frames)
    return scores | {"gaussians": 7, "seconds": {"priors": 1.0, "train": 2.0}, "backbone": "yang4d", "hooks": ["prune"]}


def run(gaussians: int = 1, **test: float | None) -> dict[str, Any]:
    return {"test": test, "gaussians": gaussians, "seconds": {"priors": 0.0, "train": 1.25}}


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_tables_hold_every_view_every_frame_and_every_camera(metrics: dict[str, Any]) -> None:
    text = view_tables(metrics)
    sections = {part.splitlines()[0]: part.splitlines()[2:] for part in text.split("## ")[1:]}
    assert list(sections) == ["Mean over test views", "Per camera", "Per frame", "Per view", "What is measured"]
    assert [cells(line)[0] for line in sections["Per camera"][2:4]] == NAMES
    assert [cells(line)[0] for line in sections["Per frame"][2:5]] == ["0", "1", "2"]
    assert [cells(line)[:2] for line in sections["Per view"][2:8]] == [[n, str(f)] for n in NAMES for f in range(3)]
    head = cells(sections["Per view"][0])
    frame2 = cells(sections["Per frame"][4])
    expected = np.mean([row["psnr"] for row in metrics["per_view"] if row["frame"] == 2])
    assert float(frame2[1]) == pytest.approx(expected, abs=0.01)
    assert "flicker" in head
    assert "LPIPS vgg" not in head  # nothing measured it
    assert "- flicker: mean |" in text
    assert cells(sections["Per view"][2])[head.index("flicker")] == "-"  # a first frame has none before it


def test_a_missing_score_is_a_dash_and_an_unmeasured_column_is_left_out() -> None:
    table = metrics_table({"a": run(5, psnr=20.0, lpips=None), "b": run(6, psnr=21.5, flicker=0.02)})
    head, _, first, second = (cells(line) for line in table.splitlines())
    assert head[:5] == ["run", "PSNR", "SSIM1", "SSIM2", "LPIPS"]
    assert "depth delta1" not in head
    assert first[head.index("LPIPS")] == "-"
    assert first[head.index("flicker")] == "-"
    assert second[head.index("flicker")] == "0.0200"
    assert second[-3:] == ["6", "0.0", "1.2"]
    assert len({len(line) for line in table.splitlines()}) == 1


TABLE = Table(("name", "dB"), (("a|b", "28.9 ± 0.5"), ("c", "3")), frozenset({(0, 1)}))


def test_markdown_keeps_bars_inside_their_cell_and_stresses_the_best() -> None:
    assert markdown(TABLE).splitlines() == ["| name | dB |", "| --- | --- |", r"| a\|b | **28.9 ± 0.5** |", "| c | 3 |"]
    best = Table(("a",), (("1|2",),), frozenset({(0, 0)}))
    assert markdown(best).splitlines()[-1] == r"| **1\|2** |"


def test_padded_columns_line_up() -> None:
    lines = markdown(TABLE, padded=True).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert [cell.strip() for cell in lines[3].strip("|").split("|")] == ["c", "3"]
