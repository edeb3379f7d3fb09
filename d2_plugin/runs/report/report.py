"""`d2 report`: everything that was measured as one page, with plots, tables and images, from rows and run folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from d2_plugin.durable import make_folder, refuse_foreign, remove_leftovers, write_text
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.reading import parsing
from d2_plugin.runs.report.page import TITLE, Image, Section, html, markdown
from d2_plugin.runs.report.quality import QUALITY, section
from d2_plugin.runs.report.run_folders import image_of, method_of, training_row
from d2_plugin.runs.rows import Row, read_rows, told_apart
from d2_plugin.runs.saved import read_metrics
from d2_plugin.settings import Positional, Settings

Builder = Callable[[Sequence[Row]], Section]
"""Makes a section from the rows of one kind."""

BUILDERS: dict[str, Builder] = {name: partial(section, name) for name in QUALITY}
"""By the kind of row, in the order of the page."""

LEAD = (
    "Every figure here was measured by a command of this package and is shown with the machine, the commit and the "
    "command that made it."
)


@dataclass(frozen=True)
class ReportSettings(Settings):
    """Settings of `d2 report`."""

    sources: Annotated[tuple[Path, ...], Positional()]
    """Files of rows (runs.jsonl) and output folders of `d2 train`, in any number."""
    output: Path = Path("report")
    """Folder of the report."""
    no_images: bool = False
    """Leave the images of the runs out of the page."""


def run(settings: ReportSettings, builders: Mapping[str, Builder] = BUILDERS) -> str:
    """Make the report; how many rows it holds, and which files it is."""
    rows, images = collect(settings.sources)
    page, markdown_file, *plots = make_report(rows, settings.output, [] if settings.no_images else images, builders)
    return f"open {page}, or read {markdown_file}; rows: {len(rows)}, plots: {len(plots)}"


def make_report(
    rows: Sequence[Row], output: Path, images: Sequence[Image] = (), builders: Mapping[str, Builder] = BUILDERS
) -> list[Path]:
    """Write report.html, report.md and one SVG per plot into `output`.

    An earlier report in the folder is replaced. `images` are for the page; `builders` make a section of each kind of
    row. Returns the files that were written.

    Raises:
        D2Error: there is no row, or one that no builder knows, or a file of somebody else stands where one of the
            report would; nothing is written.
    """
    if not rows:
        raise D2Error("there is nothing to report: give a runs.jsonl with rows in it, or the folder of a finished run")
    rows = told_apart(rows)
    for row in rows:
        if row["kind"] not in builders:
            raise D2Error(
                f"rows of kind '{row['kind']}' are drawn from a checkout alone: `python -m benchmarks report` there, "
                f"or give rows of {', '.join(builders)}"
            )
    sections = []
    for kind, build in builders.items():
        if mine := [row for row in rows if row["kind"] == kind]:
            with parsing(f"the rows of kind {kind}", "measure them again, their form is not that of this version"):
                sections.append(build(mine))
    texts = {"report.html": html(sections, images, LEAD), "report.md": markdown(sections, LEAD)}
    texts |= {f"{name}.svg": svg for section in sections for name, svg in section.figures.items()}
    with only_writer(make_folder(output)):
        remove_leftovers(output, below=False)  # of a report that was killed
        for name in texts:
            refuse_foreign(output / name, '<svg class="plot"' if name.endswith(".svg") else TITLE, "d2 report")
        for name, content in texts.items():
            write_text(output / name, content)
    return [output / name for name in texts]


def collect(sources: Sequence[Path]) -> tuple[list[Row], list[Image]]:
    """Rows of all files and run folders, and an image of each method; a folder of runs stands for every run in it.

    Raises:
        D2Error: a folder that holds no finished run, or a file that holds no rows.
    """
    folders: list[Path] = []
    for source in (source for source in sources if source.is_dir()):
        runs = sorted(path.parent for path in source.rglob("metrics.json"))
        if not runs:
            raise D2Error(f"no finished run lies in {source}: expected metrics.json, as `d2 train` writes it")
        folders += runs
    rows = read_rows([source for source in sources if not source.is_dir()])
    rows += [training_row(folder) for folder in folders]
    first: dict[tuple[str, str], Image] = {}
    for folder in folders:
        metrics = read_metrics(folder)
        key = (metrics["recording"], method_of(metrics))
        if key not in first and (image := image_of(folder)) is not None:
            first[key] = Image(f"{', '.join(key)}: {image[0]} of run {folder.resolve().name}", image[1])
    return rows, [first[key] for key in sorted(first)]
