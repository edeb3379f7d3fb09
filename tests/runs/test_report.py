"""`d2 report`: made from rows and run folders alone, the same every time, and it says where its figures come from."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from d2_plugin.errors import D2Error
from d2_plugin.recordings.images import write_png
from d2_plugin.runs.markup import Table, markdown
from d2_plugin.runs.report.page import Image
from d2_plugin.runs.report.plots import Axis, Plot, Point, Series, number
from d2_plugin.runs.report.report import BUILDERS, ReportSettings, collect, make_report, run
from d2_plugin.runs.report.svg import bars, figure
from d2_plugin.runs.report.work_precision import means, pareto_front, work_precision
from d2_plugin.runs.rows import KINDS, Row, append_rows, make_row, read_rows, told_apart
from d2_plugin.runs.training_rows import training_rows

RUNS = Path(__file__).parents[1] / "data" / "runs.jsonl"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    told = run(ReportSettings((RUNS,), folder))
    assert str(folder / "report.html") in told
    assert told.startswith(f"{len(read_rows([RUNS]))} rows")
    return folder


def write_run(folder: Path, psnr: float | None = 25.0, **more: object) -> Path:
    """A run folder with what the report reads of it."""
    (folder / "images").mkdir(parents=True)
    write_png(folder / "images" / "cam0_00001.png", np.full((6, 8, 3), 90, np.uint8))
    metrics = {
        "test": None if psnr is None else {"psnr": psnr, "ssim1": 0.8},
        "seconds": {"priors": 60.0, "train": 30.0},
        **{"gaussians": 1234, "iterations": 500, "recording": "den", "train_cameras": ["a", "b"], "backbone": "yang4d"},
        "hooks": ["prior", "densify", "prune", "depth_loss"],
        "made": {"device": "a CPU", "threads": 2, "version": "1", "commit": "abc", "torch": "2"},
        **more,
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "run.json").write_text(json.dumps({"seed": 7}))
    return folder


# ---------------------------------------------------------------- the report


def test_the_committed_rows_hold_every_kind_and_each_becomes_a_section(report: Path) -> None:
    assert {row["kind"] for row in read_rows([RUNS])} == set(KINDS) == set(BUILDERS)
    page, text = (report / "report.html").read_text(), (report / "report.md").read_text()
    for kind in KINDS:
        assert f'<section id="{kind}">' in page
        assert f'href="#{kind}"' in page
    assert text.count("\n## ") == len(KINDS)


def test_the_same_rows_make_the_same_bytes(report: Path, tmp_path: Path) -> None:
    again = make_report(read_rows([RUNS]), tmp_path)
    assert sorted(path.name for path in again) == sorted(path.name for path in report.iterdir())
    for path in again:
        assert path.read_bytes() == (report / path.name).read_bytes()


def test_every_plot_is_small_well_formed_and_named_in_the_markdown(report: Path) -> None:
    text = (report / "report.md").read_text()
    plots = sorted(report.glob("*.svg"))
    assert len(plots) >= 7
    for path in plots:
        root = ET.fromstring(path.read_text())
        assert root[0].tag.endswith("title"), "a screen reader says what it is"
        assert "prefers-color-scheme:dark" in path.read_text()
        assert path.stat().st_size < 60_000
        assert f"]({path.name})" in text


def test_the_page_needs_nothing_from_outside_and_runs_no_script(report: Path) -> None:
    page = (report / "report.html").read_text()
    assert not re.search(r"<script|<link|src=\"(?!data:)|@import|url\(", page)
    assert set(re.findall(r"https?://[^\"]+", page)) == {"http://www.w3.org/2000/svg"}
    assert page.count("<style>") == 1


def test_device_commit_and_command_stand_under_every_section(report: Path) -> None:
    sections = (report / "report.md").read_text().split("\n## ")[1:]
    for section in sections:
        assert re.search(r"threads, torch .*, commit .*, `d2 .*`\.", section), section[:40]


def test_the_papers_figures_are_hollow_and_named_as_the_papers(report: Path) -> None:
    for name in ("training", "ablation"):
        plot = (report / f"{name}.svg").read_text()
        assert re.search(r'class="s\d hollow"[^>]*><title>[^<]*as published, not measured here', plot)
    text = (report / "report.md").read_text()
    assert "27.23" not in text, "tables hold what was measured here"


def test_no_number_of_a_table_is_typed_in(report: Path) -> None:
    """The PSNR of one committed row is changed, and the tables with it."""
    rows = read_rows([RUNS])
    row = next(row for row in rows if row["kind"] == "training" and "n3dv" in row["case"])
    shown = f"{row['scores']['psnr']:.2f}"
    assert shown in (report / "report.md").read_text()
    mine = {**row, "scores": {**row["scores"], "psnr": 11.11}}
    make_report([mine], report / "changed")
    text = (report / "changed" / "report.md").read_text()
    assert "11.11" in text
    assert shown not in text


def test_the_top_of_the_page_tells_what_the_sections_found(report: Path) -> None:
    top, _, _ = (report / "report.md").read_text().partition("\n## ")
    assert "- Training: " in top
    assert "yang4d + D2" in top
    rows = [row for row in read_rows([RUNS]) if row["kind"] == "stability"]
    assert f"{sum(row['verdict'] == 'ok' for row in rows)} of {len(rows)} points ok" in top
    assert "world offset in float32" in top


def ablated(method: str, seed: int, **scores: float) -> Row:
    """A run of an ablation as a row."""
    about = {"seconds": 1.0, "prior_seconds": 0.0, "gaussians": 1, "iterations": 5, "scores": scores}
    return make_row("ablation", "room, 4 cameras", method, f"seed {seed}", error=0.1, **about)


def test_a_gain_without_its_backbone_is_not_drawn_and_the_page_says_so(tmp_path: Path) -> None:
    rows = [ablated(name, 0, psnr=psnr) for name, psnr in (("yang4d full", 28.0), ("yang4d no_pruning", 27.0))]
    _, text, *plots = make_report(rows, tmp_path / "alone")
    assert "No gain is drawn for yang4d on room, 4 cameras: the backbone alone was not run there." in text.read_text()
    assert not any("dB</title>" in plot.read_text() for plot in plots)
    rows += [ablated("yang4d backbone", 0, psnr=25.0), ablated("deform full", 0, psnr=21.0)]
    _, text, plot = make_report(rows, tmp_path / "with")
    assert "No gain is drawn for deform on room, 4 cameras" in text.read_text()
    assert "yang4d full, seed 0: +3.00 dB" in plot.read_text()
    assert "deform full" not in plot.read_text()


def test_which_variant_is_best_is_said_metric_by_metric(tmp_path: Path) -> None:
    better, best = {"psnr": 28.0, "ssim1": 0.80, "lpips": 0.3}, {"psnr": 27.0, "ssim1": 0.85, "lpips": 0.2}
    worst = {"psnr": 20.0, "ssim1": 0.5, "lpips": 0.5}
    rows = [ablated("yang4d full", seed, **better) for seed in range(3)]
    rows += [ablated("yang4d mvs_only", seed, **best) for seed in range(2)]
    rows += [ablated("yang4d backbone", seed, **worst) for seed in range(3)]
    text = make_report(rows, tmp_path)[1].read_text()
    top, _, _ = text.partition("\n## ")
    assert "room, 4 cameras: best mean PSNR: yang4d full; SSIM1, LPIPS: yang4d mvs_only" in top
    found = {line.split(" | ")[1]: line.split(" | ")[2:] for line in text.splitlines() if line.count("(") == 3}
    assert [cell.split(" (")[0] for cell in found["yang4d backbone"]] == ["holds"] * 3
    assert [cell.split(" (")[0] for cell in found["yang4d mvs_only"]] == ["two seeds: no verdict"] * 3
    assert found["yang4d mvs_only"][2].startswith("two seeds: no verdict (-0.1")


def trained(seed: int, psnr: float, commit: str = "aaa", **more: object) -> Row:
    """A run of `d2 train` as a row."""
    about = {"prior_seconds": 0.0, "gaussians": 1, "iterations": 2000, "seed": seed, "run": f"run{psnr}", **more}
    row = make_row(
        *("training", "room, 4 views", "yang4d + D2", f"2000 steps, seed {seed}"),
        error=10 ** (-psnr / 20),
        seconds=1.0,
        scores={"psnr": psnr},
        **about,
    )
    return {**row, "commit": commit}


def cells(text: str, start: str) -> list[str]:
    """The cells of the first table line that begins so."""
    line = next(line for line in text.splitlines() if line.startswith(start))
    return [cell.strip(" *") for cell in line.strip("|").split("|")]


class TestSeeds:
    def table(self, rows: list[Row], folder: Path) -> str:
        return make_report(rows, folder)[1].read_text()

    def test_a_mean_has_its_standard_error_and_one_seed_says_so(self, tmp_path: Path) -> None:
        text = self.table([trained(seed, psnr) for seed, psnr in enumerate((28.0, 29.0, 30.0))], tmp_path / "a")
        assert cells(text, "| room, 4 views | yang4d + D2, 2000 steps")[2:4] == ["3", "29.00 ± 0.58"]
        text = self.table([trained(0, 28.0)], tmp_path / "b")
        assert cells(text, "| room, 4 views | yang4d + D2, 2000 steps")[2:4] == ["one seed", "28.00"]

    def test_a_seed_that_was_run_again_is_no_further_seed(self, tmp_path: Path) -> None:
        text = self.table([trained(0, 28.0), trained(1, 30.0), trained(0, 28.0)], tmp_path)
        assert cells(text, "| room, 4 views | yang4d + D2, 2000 steps")[2:4] == ["two seeds", "29.00 ± 1.00"]

    def test_one_seed_with_two_scores_is_two_runs_that_differ_by_more(self, tmp_path: Path) -> None:
        text = self.table([trained(0, 28.0), trained(0, 22.0)], tmp_path)
        assert cells(text, "| room, 4 views | yang4d + D2, 2000 steps, run28.0")[2:4] == ["one seed", "28.00"]
        assert cells(text, "| room, 4 views | yang4d + D2, 2000 steps, run22.0")[2:4] == ["one seed", "22.00"]


class TestVersions:
    def test_commits_that_measured_the_same_run_are_compared_across_commands(self, tmp_path: Path) -> None:
        rows = [trained(seed, 28.0 + 0.1 * seed) for seed in range(3)]
        older = [ablated("yang4d full", seed, psnr=27.0 + 0.1 * seed) for seed in range(3)]
        rows += [{**row, "iterations": 2000, "commit": "bbb"} for row in older]
        text = make_report(rows, tmp_path)[1].read_text().partition("## Versions")[2]
        assert cells(text, "| room, 4 views, yang4d + D2, 2000 steps | aaa | bbb")[3] == "holds (+1.00 ± 0.08 dB)"

    def test_fewer_than_three_seeds_or_another_length_are_not_compared(self, tmp_path: Path) -> None:
        rows = [trained(seed, 28.0) for seed in range(3)]
        rows += [trained(seed, 27.0, "bbb") for seed in range(2)]
        rows += [trained(seed, 27.0, "ccc", iterations=1000) for seed in range(3)]
        assert "## Versions" not in make_report(rows, tmp_path)[1].read_text()


def test_a_headline_of_too_few_seeds_has_no_verdict(report: Path) -> None:
    top, _, _ = (report / "report.md").read_text().partition("\n## ")
    assert re.search(r"yang4d \+ D2 PSNR [\d.]+ dB in [\d.]+ min \(2 seeds: no verdict\)", top)


def test_what_a_killed_report_left_is_removed_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".0123456789abcdef.part").write_text("half a page")
    make_report(read_rows([RUNS]), tmp_path)
    assert (tmp_path / "report.html").is_file()
    assert not list(tmp_path.glob(".*"))


def test_nothing_to_report_is_told(tmp_path: Path) -> None:
    (tmp_path / "empty.jsonl").write_text("")
    with pytest.raises(D2Error, match="there is nothing to report"):
        make_report(read_rows([tmp_path / "empty.jsonl"]), tmp_path)


# ---------------------------------------------------------------- rows


def test_rows_are_appended_and_read_back_with_what_is_not_a_number_as_null(tmp_path: Path) -> None:
    path = tmp_path / "runs.jsonl"
    for error in (0.5, float("nan")):
        append_rows(path, [make_row("plan", "room", "stereo", error=error, seconds=1.0, peak_mb=float("nan"))])
    first, second = read_rows([path])
    assert (first["error"], first["failed"], first["peak_mb"]) == (0.5, None, None)
    assert (second["error"], second["failed"]) == (None, "the error is nan")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 2 is not JSON"),
        ('{"kind": "raster"}', "line 2 has no case, method"),
        ("[]", "line 2 has no kind"),
    ],
)
def test_a_line_that_is_no_row_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "runs.jsonl"
    append_rows(path, [make_row("plan", "room", "stereo", error=None, seconds=None)])
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(D2Error, match=message):
        read_rows([path])


def test_an_unknown_kind_and_an_absent_file_are_told(tmp_path: Path) -> None:
    with pytest.raises(D2Error, match="unknown kind of row 'rastr'.*did you mean 'raster'"):
        make_row("rastr", "room", "d2", error=None, seconds=None)
    with pytest.raises(D2Error, match="cannot read .*there is no such file"):
        read_rows([tmp_path / "absent.jsonl"])


# ---------------------------------------------------------------- run folders


def test_a_run_folder_becomes_a_row_with_the_priors_time_beside(tmp_path: Path) -> None:
    (row,) = training_rows([write_run(tmp_path / "run")])
    assert (row["case"], row["method"], row["setting"]) == ("den, 2 views", "yang4d + D2", "500 steps, seed 7")
    assert (row["seconds"], row["prior_seconds"], row["gaussians"]) == (30.0, 60.0, 1234)
    assert row["error"] == pytest.approx(10 ** (-25 / 20))
    assert (row["device"], row["commit"]) == ("a CPU", "abc")


def test_a_run_without_held_out_cameras_or_circumstances_says_so(tmp_path: Path) -> None:
    write_run(tmp_path / "run", psnr=None, made=None, hooks=["prior", "densify"])
    (row,) = training_rows([tmp_path / "run"])
    assert (row["error"], row["failed"]) == (None, "no camera was held out")
    assert (row["device"], row["commit"]) == (None, None)
    text = make_report([row], tmp_path / "report")[1].read_text()
    command = "d2 train den --train-cameras a,b --backbone yang4d --iterations 500 --hooks prior,densify --seed 7"
    assert f"`{command} --output run`, which recorded neither machine nor commit." in text
    assert row["method"] == "yang4d + densify"


def test_folders_of_runs_are_searched_and_a_image_of_each_method_is_kept(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / "runs" / name)
    write_run(tmp_path / "runs" / "bare", psnr=20.0, hooks=[])
    rows, images = collect([RUNS, tmp_path / "runs"])
    assert sum(row["case"] == "den, 2 views" for row in rows) == 3
    assert [image.caption.split(":")[0] for image in images] == ["den, yang4d", "den, yang4d + D2"]
    assert all(image.uri.startswith("data:image/") for image in images)
    page = make_report(rows, tmp_path / "report", images)[0].read_text()
    assert page.count("<img ") == 2
    with pytest.raises(D2Error, match="no finished run lies in"):
        collect([tmp_path / "report"])


@pytest.mark.parametrize("kind", KINDS)
def test_rows_of_which_none_has_a_result_still_make_a_report(tmp_path: Path, kind: str) -> None:
    rows = [row for row in read_rows([RUNS]) if row["kind"] == kind][:2]
    for row in rows:
        row |= {"error": None, "failed": "refused: no such thing", "verdict": "failure", "scores": {}, "cost": None}
        row |= {"depth_error": None, "peak_mb": None}
    page = make_report(rows, tmp_path)[0].read_text()
    assert f'<section id="{kind}">' in page


def test_what_names_hold_is_text_and_never_markup(tmp_path: Path) -> None:
    row = make_row("plan", "<b>room</b>", "a & b", error=0.0, seconds=1.0, planned="used: x", cost=None, unit="dB")
    page, *_ = make_report([row], tmp_path, [Image("<i>x</i>", "data:image/png;base64,")])
    assert "&lt;b&gt;room&lt;/b&gt;" in page.read_text()
    assert "<i>x" not in page.read_text()


# ---------------------------------------------------------------- fronts and plots


def measured(method: str, setting: str, error: float | None, seconds: float | None, failed: str | None = None) -> Row:
    return make_row("stereo", "rig", method, setting, error=error, seconds=seconds, failed=failed)


def test_the_front_is_what_nothing_beats_in_both() -> None:
    points = [(1, 5), (2, 3), (3, 4), (4, 1), (2, 3), (1, 6)]
    assert pareto_front(points) == [0, 1, 3]
    assert pareto_front([]) == []


@given(st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1e9)), max_size=30))
def test_every_point_off_the_front_is_beaten_by_one_on_it_and_none_of_the_front_is(points: list) -> None:
    front = [points[i] for i in pareto_front(points)]
    assert all(any(x <= p[0] and y <= p[1] for x, y in front) for p in points)
    assert not any(a != b and a[0] <= b[0] and a[1] <= b[1] for a in front for b in front)


@given(st.lists(st.floats(1e-16, 1e16), min_size=1, max_size=8), st.booleans())
def test_any_range_of_values_has_an_axis_with_its_ticks_inside(values: list[float], log: bool) -> None:
    axis = Axis.around("x", values, log)
    assert all(0 < axis.place(value) < 1 for value in values)
    assert 1 <= len(axis.ticks()) <= 20


def test_means_over_cases_are_geometric_and_failures_keep_a_setting_off_the_front() -> None:
    rows = [measured("a", "x", 0.01, 1.0), measured("a", "x", 0.04, 4.0), measured("b", "y", 0.5, 9.0)]
    rows += [measured("c", "z", 1e-9, 1e-9), measured("c", "z", None, None, "gave up")]
    first, _, third = means(rows)
    assert (first.error, first.seconds) == pytest.approx((0.02, 2.0))
    assert (third.cases, third.failures) == (2, 1)
    plot = work_precision(rows, "title", "error", "seconds")
    faded = {series.name: series.points[0].faded for series in plot.series}
    assert faded == {"a": False, "b": True, "c": True}


def test_axes_hold_their_values_and_ticks_are_round() -> None:
    axis = Axis.around("x", [3e-7, 20.0], log=True)
    assert axis.low < 3e-7 < 20 < axis.high
    assert 0 < axis.place(3e-7) < axis.place(20.0) < 1
    assert all(re.fullmatch(r"1?0?⁻?.*", text) and axis.low <= value <= axis.high for value, text in axis.ticks())
    assert [text for _, text in Axis("y", 0, 10).ticks(5)] == ["0", "2", "4", "6", "8", "10"]
    for single in (0.0, 5.0):
        assert Axis.around("x", [single]).low < single < Axis.around("x", [single]).high
    assert [number(v) for v in (0.0, 0.5, 1e-6, 2.5e-7, 1e5)] == ["0", "0.5", "10⁻⁶", "2.5·10⁻⁷", "10⁵"]


def test_marks_lie_inside_the_image_and_carry_their_numbers() -> None:
    points = (Point(1.0, 2.0, "the first"), Point(3.0, 4.0, "the <second>", "label"))
    series = Series("one", points, ((1.0, 2.0), (3.0, 4.0)))
    plot = Plot("title", Axis.around("x", [1, 3]), Axis.around("y", [2, 4]), (series,))
    root = ET.fromstring(figure([plot, plot], "two plots", columns=2, size=(340, 300)))
    width, height = float(root.attrib["width"]), float(root.attrib["height"])
    circles = [e for e in root.iter() if e.tag.endswith("circle") and len(e)]
    assert len(circles) == 4
    assert all(0 < float(c.attrib["cx"]) < width and 0 < float(c.attrib["cy"]) < height for c in circles)
    assert {c[0].text for c in circles} == {"the first", "the <second>"}


def test_a_list_of_names_is_as_high_as_it_is_long_and_a_bare_line_is_a_line_in_the_legend() -> None:
    def height(count: int) -> float:
        names = [str(i) for i in range(count)]
        marks = Series("here", tuple(Point(0.0, i) for i in range(count)))
        limit = Series("limit", (), ((0.0, 0.0), (0.0, 1.0)), color=1, hollow=True)
        drawn = figure([Plot("gains", Axis("dB", -1, 1), Axis.listing("", names), (marks, limit))], "gains")
        assert drawn.count("stroke-dasharray") == 2, "in the plot and in the legend"
        assert "s1 hollow" not in drawn
        return float(ET.fromstring(drawn).attrib["height"])

    assert height(12) - height(2) == pytest.approx(10 * 24)


def test_stacked_bars_are_as_long_as_their_sums() -> None:
    root = ET.fromstring(bars([("a", (1.0, 3.0)), ("b", (2.0, 0.0))], ("prior", "training"), "min", "time"))
    long = [float(e.attrib["width"]) for e in root.iter() if e.tag.endswith("rect") and e.attrib.get("rx")]
    assert long[0] + long[1] + 4 == pytest.approx(2 * (long[2] + 2))


def test_a_table_in_markdown_keeps_its_bars_and_stresses_the_best() -> None:
    text = markdown(Table(("a", "b"), (("1|2", "3"),), frozenset({(0, 1)})))
    assert text.splitlines()[-1] == "| 1\\|2 | **3** |"


def test_other_cameras_of_one_recording_are_another_case() -> None:
    def row(cameras: list[str] | None, kind: str = "quality") -> dict:
        more = {} if cameras is None else {"cameras": cameras}
        return {"kind": kind, "case": "plaza, 2 views", **more}

    pairs = told_apart([row(["00", "07"]), row(["01", "03"]), row(None), row(["01", "03"], "training")])
    names = ["plaza, 2 views, 00 07", "plaza, 2 views, 01 03", "plaza, 2 views", "plaza, 2 views"]
    assert [each["case"] for each in pairs] == names
    assert [each["case"] for each in told_apart([row(["00", "07"]), row(["00", "07"])])] == ["plaza, 2 views"] * 2
