"""`d2 report`: made from rows and run folders alone, the same every time, and it says where its figures come from."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses

from benchmarks.rows import begin_rows
from d2_plugin.durable import write_table
from d2_plugin.errors import D2Error
from d2_plugin.recordings.images import write_png
from d2_plugin.runs.report.page import Image
from d2_plugin.runs.report.quality import groups_of, scores_table
from d2_plugin.runs.report.report import BUILDERS, ReportSettings, collect, make_report, run
from d2_plugin.runs.report.run_folders import training_row
from d2_plugin.runs.report.svg import Axis
from d2_plugin.runs.rows import Row, append_rows, make_row, read_rows, told_apart
from d2_plugin.runs.saved import METRICS, RUN
from d2_plugin.runs.settings import RunSettings
from d2_plugin.runs.tables import Table, markdown

RUNS = Path(__file__).parents[1] / "data" / "runs.jsonl"


def committed() -> list[Row]:
    """Rows of the kinds that every installation draws; the others are in tests/benchmarks."""
    return [row for row in read_rows([RUNS]) if row["kind"] in BUILDERS]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    rows = folder / "rows.jsonl"
    append_rows(rows, committed())
    told = run(ReportSettings((rows,), folder / "out"))
    assert str(folder / "out" / "report.html") in told
    assert f"rows: {len(committed())}, plots: " in told
    return folder / "out"


def write_run(folder: Path, psnr: float | None = 25.0, **more: object) -> Path:
    """A run folder with what the report reads of it."""
    (folder / "images").mkdir(parents=True)
    write_png(folder / "images" / "cam0_00001.png", np.full((6, 8, 3), 90, np.uint8))
    metrics = {
        "test": None if psnr is None else {"psnr": psnr, "ssim1": 0.8},
        "seconds": {"priors": 60.0, "train": 30.0},
        **{"gaussians": 1234, "iterations": 500, "recording": "den", "train_cameras": ["a", "b"], "backbone": "yang4d"},
        "hooks": ["prior", "densify", "prune", "depth_loss", "motion", "parallax"],
        "made": {"device": "a CPU", "threads": 2, "version": "1", "commit": "abc", "torch": "2"},
        **more,
    }
    write_table(folder / "metrics.json", metrics, METRICS)
    settings = RunSettings("/data/den", ("a", "b"), iterations=500, hooks=tuple(metrics["hooks"]), seed=7)
    write_table(folder / "run.json", settings.as_table(), RUN)
    return folder


def scored(method: str, seed: int, target: str = "10 s", **scores: float) -> Row:
    """A run of `d2 bench training` as a row."""
    about = {"prior_seconds": 0.0, "gaussians": 1, "iterations": 5, "scores": scores, "target": target, "seed": seed}
    return make_row("quality", "room, 4 views", method, f"seed {seed}", error=0.1, seconds=1.0, **about)


def test_every_kind_becomes_a_section_with_device_commit_and_command(report: Path) -> None:
    page, text = (report / "report.html").read_text(), (report / "report.md").read_text()
    sections = text.split("\n## ")[1:]
    assert len(sections) == len(BUILDERS)
    for kind, section in zip(BUILDERS, sections, strict=True):
        assert f'<section id="{kind}">' in page
        assert f'href="#{kind}"' in page
        assert re.search(r"threads, torch .*, commit .*, `d2 .*`\.", section), section[:40]


def test_the_same_rows_make_the_same_bytes_and_nothing_is_typed_in(report: Path, tmp_path: Path) -> None:
    again = make_report(committed(), tmp_path)
    assert sorted(path.name for path in again) == sorted(path.name for path in report.iterdir())
    assert all(path.read_bytes() == (report / path.name).read_bytes() for path in again)
    row = next(row for row in committed() if row["kind"] == "training")
    shown = f"{row['scores']['psnr']:.2f}"
    assert shown in (report / "report.md").read_text()
    text = make_report([{**row, "scores": {**row["scores"], "psnr": 11.11}}], tmp_path / "changed")[1].read_text()
    assert "11.11" in text
    assert shown not in text


def test_plots_are_well_formed_and_the_page_needs_nothing_from_outside(report: Path) -> None:
    for path in report.glob("*.svg"):
        assert ET.fromstring(path.read_text())[0].tag.endswith("title"), "a screen reader says what it is"
        assert "prefers-color-scheme:dark" in path.read_text()
        assert f"]({path.name})" in (report / "report.md").read_text()
    page = (report / "report.html").read_text()
    assert not re.search(r"<script|<link|src=\"(?!data:)|@import|url\(", page)
    assert set(re.findall(r"https?://[^\"]+", page)) == {"http://www.w3.org/2000/svg"}
    assert page.count("<style>") == 1


class TestGroups:
    def test_names_say_what_ran_and_d2_stands_first_of_each_length(self) -> None:
        yang = (f"yang4d{rest}" for rest in (" pearson", "", " full", " mvs_only", " full, x", ", x"))
        names = [*yang, "deform full"]
        rows = [scored(name, 0, target, psnr=20.0) for target in ("30 s", "10 s") for name in names]
        groups = groups_of([*rows, scored("yang4d full", 0, "try", psnr=1.0)])
        order = ["D²", "D² (deform)", "D², x", "stereo alone", "backbone alone", "backbone alone, x", "pearson"]
        assert [(group.length, group.method) for group in groups] == [(n, m) for n in ("10 s", "30 s") for m in order]

    def test_d2_is_compared_with_methods_of_its_own_backbone_alone(self, tmp_path: Path) -> None:
        names = ("yang4d full", "yang4d mvs_only", "yang4d backbone", "deform full", "deform full, x", "other backbone")
        text = make_report([scored(name, 0, psnr=20.0) for name in names], tmp_path)[1].read_text()
        lines = [line.strip("| ").split(" | ") for line in text.splitlines() if "no verdict" in line]
        assert [line[1] for line in lines] == ["stereo alone", "backbone alone", "D² (deform), x", "D² (deform)"]

    def test_a_prior_of_unknown_time_is_not_drawn_as_none(self, tmp_path: Path) -> None:
        rows = [scored("yang4d full", 0, psnr=20.0) | {"prior_seconds": None}, scored("yang4d backbone", 0, psnr=19.0)]
        page = make_report(rows, tmp_path)[0].read_text()
        assert "no known time of its prior is not drawn" in page
        assert ("19.00 dB in 0.02 minutes" in page, "20.00 dB in" in page) == (True, False)

    def test_a_repeated_seed_is_no_further_one(self) -> None:
        row = scored("yang4d full", 0, psnr=28.0)
        assert scores_table(groups_of([row, row])).rows[0][3:5] == ("one seed", "28.00")

    def test_the_best_and_the_verdict_are_those_of_each_metric(self, tmp_path: Path) -> None:
        better, best = {"psnr": 28.0, "ssim1": 0.80, "lpips": 0.3}, {"psnr": 27.0, "ssim1": 0.85, "lpips": 0.2}
        rows = [scored("yang4d full", seed, **better) for seed in range(3)]
        rows += [scored("yang4d mvs_only", seed, **best) for seed in range(2)]
        rows += [scored("yang4d backbone", seed, psnr=20.0, ssim1=0.5, lpips=0.5) for seed in range(3)]
        assert scores_table(groups_of(rows)).best == {(0, 4), (1, 5), (1, 6)}
        lines = make_report(rows, tmp_path)[1].read_text().splitlines()
        cells = [line.strip("|").split("|") for line in lines if line.startswith("| room, 4 views, 10 s ")]
        verdicts = {line[1].strip(): [cell.strip(" *") for cell in line[2:]] for line in cells}
        assert [cell.split(" (")[0] for cell in verdicts["backbone alone"]] == ["holds"] * 3
        assert [cell.split(" (")[0] for cell in verdicts["stereo alone"]] == ["two seeds: no verdict"] * 3


def test_what_cannot_be_reported_is_one_sentence(tmp_path: Path) -> None:
    refuses("there is nothing to report", make_report, [], tmp_path)
    with pytest.raises(D2Error, match="rows of kind 'raster' are drawn from a checkout alone"):
        make_report([make_row("raster", "a", "b", error=None, seconds=None)], tmp_path)


@pytest.mark.parametrize("name", ["report.md", "report.html", "quality.svg"])
def test_a_file_that_no_report_wrote_is_kept(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    refuses(f"{name} was not written by `d2 report` and is kept: choose another", make_report, committed(), tmp_path)
    assert (tmp_path / name).read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_names_hold_is_text_and_never_markup(tmp_path: Path) -> None:
    row = scored("yang4d a&b", 0, psnr=20.0) | {"case": "<b>room</b>"}
    page, *_ = make_report([row], tmp_path, [Image("<i>x</i>", "data:image/png;base64,")])
    assert "&lt;b&gt;room&lt;/b&gt;" in page.read_text()
    assert "<i>x" not in page.read_text()


def test_rows_are_appended_and_read_back_with_what_is_not_a_number_as_null(tmp_path: Path) -> None:
    path = tmp_path / "new" / "runs.jsonl"
    begin_rows(path)
    assert not list(path.parent.iterdir()), "nothing is written before something was measured"
    for error in (0.5, float("nan")):
        append_rows(path, [make_row("scaling", "room", "stereo", error=error, seconds=1.0, peak_mb=float("nan"))])
    first, second = read_rows([path])
    assert (first["error"], first["failed"], first["peak_mb"]) == (0.5, None, None)
    assert (second["error"], second["failed"]) == (None, "the error is nan")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 2 as JSON"),
        ('{"kind": "raster"}', "line 2 has no case"),
        ("[]", "line 2 has no kind"),
    ],
)
def test_a_line_that_is_no_row_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "runs.jsonl"
    append_rows(path, [make_row("scaling", "room", "stereo", error=None, seconds=None)])
    path.write_text(path.read_text() + line + "\n")
    refuses(message, read_rows, [path])
    refuses("cannot read .*there is no such file", read_rows, [tmp_path / "absent.jsonl"])


def test_other_cameras_or_frames_of_one_recording_are_another_case() -> None:
    def row(cameras: list[str] | None, kind: str = "quality") -> dict:
        more = {} if cameras is None else {"cameras": cameras}
        return {"kind": kind, "case": "plaza, 2 views", **more}

    pairs = told_apart([row(["00", "07"]), row(["01", "03"]), row(None), row(["01", "03"], "training")])
    names = ["plaza, 2 views, 00 07", "plaza, 2 views, 01 03", "plaza, 2 views", "plaza, 2 views"]
    assert [each["case"] for each in pairs] == names
    assert [each["case"] for each in told_apart([row(["00", "07"]), row(["00", "07"])])] == ["plaza, 2 views"] * 2
    frames = [row(["00"]) | {"test_cameras": ["01"], "frames": frames} for frames in (None, [0, 2], list(range(20)))]
    ends = ["all", "0 2", "0 to 19, 20 of them"]
    assert [each["case"] for each in told_apart(frames)] == [f"plaza, 2 views, frames {end}" for end in ends]
    of_one_name = told_apart([frames[0] | {"images": images} for images in (["3f0c"], ["a771"], [])])
    assert [each["case"][14:] for each in of_one_name] == [", images 3f0c", ", images a771", ""]


def test_a_run_folder_becomes_a_row_with_the_priors_time_beside(tmp_path: Path) -> None:
    row = training_row(write_run(tmp_path / "run"))
    assert (row["case"], row["method"], row["setting"]) == ("den, 2 views", "yang4d + D2", "500 steps, seed 7")
    assert (row["seconds"], row["prior_seconds"], row["gaussians"]) == (30.0, 60.0, 1234)
    assert row["error"] == pytest.approx(10 ** (-25 / 20))
    assert (row["device"], row["commit"]) == ("a CPU", "abc")
    row = training_row(write_run(tmp_path / "all", psnr=None, hooks=["prior", "densify"]))
    assert (row["method"], row["error"], row["failed"]) == ("yang4d + densify", None, "no camera was held out")
    command = "d2 train den --train-cameras a,b --iterations 500 --hooks prior,densify --seed 7"
    assert row["command"] == f"{command} --output all"


def test_folders_of_runs_are_searched_and_an_image_of_each_method_is_kept(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / "runs" / name)
    write_run(tmp_path / "runs" / "bare", psnr=20.0, hooks=[])
    rows, images = collect([tmp_path / "runs"])
    assert len(rows) == 3
    assert [image.caption.split(":")[0] for image in images] == ["den, yang4d", "den, yang4d + D2"]
    assert make_report(rows, tmp_path / "report", images)[0].read_text().count("<img ") == 2
    refuses("no finished run lies in", collect, [tmp_path / "report"])


@given(st.lists(st.floats(1e-16, 1e16), min_size=1, max_size=8), st.booleans())
def test_any_range_of_values_has_an_axis_with_its_ticks_inside(values: list[float], log: bool) -> None:
    axis = Axis.around("x", values, log)
    assert all(0 < axis.place(value) < 1 for value in values)
    assert 1 <= len(axis.ticks()) <= 20
    assert all(axis.low <= value <= axis.high for value, _ in axis.ticks())


def test_markdown_keeps_bars_inside_their_cell_and_stresses_the_best() -> None:
    table = Table(("name", "dB"), (("a|b", "28.9 ± 0.5"), ("c", "3")), frozenset({(0, 1)}))
    assert markdown(table).splitlines() == ["| name | dB |", "| --- | --- |", r"| a\|b | **28.9 ± 0.5** |", "| c | 3 |"]
    assert markdown(Table(("a",), (("1|2",),), frozenset({(0, 0)}))).splitlines()[-1] == r"| **1\|2** |"
