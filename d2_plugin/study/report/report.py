"""`d2 report`: everything that was measured as one page, with plots, tables and pictures, from rows and run folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.durable import make_folder, remove_leftovers, write_text
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.reading import parsing
from d2_plugin.runs.tables import read_metrics
from d2_plugin.settings import Positional, Settings
from d2_plugin.study.never_worse.section import never_worse
from d2_plugin.study.rows import Row, read_rows, told_apart
from d2_plugin.study.training_rows import method_of, picture_of, training_rows

from .ablation import ablation
from .limits import gpu, plan, scaling, stability, step
from .page import Picture, html, markdown
from .precision import alignment, raster, stereo
from .priors import priors
from .quality import quality
from .sections import Section
from .training import training
from .versions import versions

BUILDERS: dict[str, Callable[[Sequence[Row]], Section]] = {
    build.__name__: build
    for build in (
        *(training, quality, never_worse, ablation),
        *(alignment, stereo, priors, raster, step, gpu, stability, plan, scaling),
    )
}
"""The function that makes a section from the rows of a kind, in the order of the page."""

LEAD = (
    "Every figure here was measured by a command of this package and is shown with the machine, the commit and the "
    "command that made it. Errors are on the vertical axis, run time on the horizontal one."
)


@dataclass(frozen=True)
class ReportSettings(Settings):
    """Settings of `d2 report`."""

    sources: Annotated[tuple[Path, ...], Positional()]
    """Files of rows (runs.jsonl) and output folders of `d2 train`, in any number."""
    output: Path = Path("report")
    """Folder of the report."""
    no_pictures: bool = False
    """Leave the pictures of the runs out of the page."""


def run(settings: ReportSettings) -> str:
    """Make the report; how many rows it holds, and which files it is."""
    rows, pictures = collect(settings.sources)
    page, markdown_file, *plots = make_report(rows, settings.output, () if settings.no_pictures else pictures)
    return f"{len(rows)} rows; open {page}, or read {markdown_file} with its {len(plots)} plots"


def make_report(rows: Sequence[Row], output: Path, pictures: Sequence[Picture] = ()) -> list[Path]:
    """Write report.html, report.md and one SVG per plot into `output`.

    Args:
        rows: of any kinds, see `d2_plugin.study.rows`.
        output: folder, created where absent; files of the same names are replaced.
        pictures: for the page; the Markdown has none.

    Returns:
        The files that were written.

    Raises:
        D2Error: there is no row.
    """
    if not rows:
        raise D2Error("there is nothing to report: give a runs.jsonl with rows in it, or the folder of a finished run")
    rows = told_apart(rows)
    by_kind = {kind: [row for row in rows if row["kind"] == kind] for kind in BUILDERS}
    sections = [_built(kind, mine) for kind, mine in by_kind.items() if mine]
    compared = versions(rows)
    sections += [] if compared is None else [compared]
    texts = {"report.html": html(sections, pictures, LEAD), "report.md": markdown(sections, LEAD)}
    texts |= {f"{name}.svg": svg for section in sections for name, svg in section.figures.items()}
    with only_writer(make_folder(output)):
        remove_leftovers(output, below=False)  # of a report that was killed
        for name, content in texts.items():
            write_text(output / name, content)
    return [output / name for name in texts]


def _built(kind: str, rows: Sequence[Row]) -> Section:
    """The section of one kind of row; each reads what else its rows hold, which only it knows."""
    with parsing(f"the rows of kind {kind}", "measure them again, their form is not that of this version"):
        return BUILDERS[kind](rows)


def collect(sources: Sequence[Path]) -> tuple[list[Row], list[Picture]]:
    """Rows of all files and run folders, and a picture of each method; a folder of runs stands for every run in it.

    Raises:
        D2Error: a folder that holds no finished run, or a file that holds no rows.
    """
    folders = [folder for source in sources if source.is_dir() for folder in _runs(source)]
    rows = read_rows([source for source in sources if not source.is_dir()]) + training_rows(folders)
    first: dict[tuple[str, str], Picture] = {}
    for folder in folders:
        metrics = read_metrics(folder)
        key = (metrics["capture"], method_of(metrics))
        if key not in first and (picture := _picture(folder, *key)) is not None:
            first[key] = picture
    return rows, [first[key] for key in sorted(first)]


def _runs(folder: Path) -> list[Path]:
    found = sorted(path.parent for path in folder.rglob("metrics.json"))
    if not found:
        raise D2Error(f"no finished run lies in {folder}: expected metrics.json, as `d2 train` writes it")
    return found


def _picture(folder: Path, capture: str, method: str) -> Picture | None:
    found = picture_of(folder)
    return None if found is None else Picture(f"{capture}, {method}: {found[0]} of run {folder.name}", found[1])
