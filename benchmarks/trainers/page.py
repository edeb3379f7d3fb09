"""The tables of docs/results/attach.md, from the rows of `python -m benchmarks trainers`."""

from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev

from benchmarks.rows import grouped
from benchmarks.trainers.trial_run import ATTACHED, BARE, NO_HOOKS
from d2_plugin.errors import D2Error
from d2_plugin.reading import parse_json, read_text
from d2_plugin.runs.rows import Row
from d2_plugin.runs.tables import Table, markdown

START, END = "<!-- rows -->", "<!-- end -->"
HEADER = (
    "repository",
    "recording",
    "iterations",
    "bare",
    "no hooks",
    "attached",
    "gain",
    "of what moves",
    "Gaussians",
    "D2 +/-",
    "CPU s",
    "MB",
    "worst",
)


def read_rows(path: Path) -> list[Row]:
    """The rows of a file; of the same run done twice the later one counts."""
    if not path.is_file():
        return []
    lines = read_text(path, "run `python -m benchmarks trainers`").splitlines()
    rows = [parse_json(line, f"{path}, line {i}", "run it again") for i, line in enumerate(lines, start=1) if line]
    return [same[-1] for same in grouped(rows, *_SAME).values()]


_CASE = ("repository", "recording", "frames", "downscale", "iterations", "own_schedules", "hold_out_instants")
_SAME = (*_CASE, "seed", "method")


def table(rows: Sequence[Row]) -> str:
    """Markdown: one line for each repository and recording, means over the seeds, and what did not run below."""
    cases = grouped(rows, *_CASE).items()
    lines = tuple(_line(case, found) for case, found in cases if any(row["psnr"] for row in found))
    failed = [
        f"- {row['repository']} on {row['recording']}, {row['method']}: {row['failed']}"
        for row in rows
        if row["failed"]
    ]
    return "\n".join([markdown(Table(HEADER, lines)), *(["", *failed] if failed else [])])


def _line(case: tuple, rows: list[Row]) -> tuple[str, ...]:
    finished = [row for row in rows if not row["failed"]]
    without = [row for row in finished if row["method"] == NO_HOOKS]
    bare, attached = ([row for row in finished if row["method"] == name and row["psnr"]] for name in (BARE, ATTACHED))
    gains = [last(other) - last(row) for row, other in pairs(bare, attached)]
    return (
        *(str(case[0]), str(case[1]), f"{case[4]}, its own schedules" if case[5] else str(case[4])),
        *(_spread([last(row) for row in bare]), same(bare, without), _spread([last(row) for row in attached])),
        *(_spread(gains, sign="+"), _moving(bare, attached)),
        " → ".join(_mean(some, "gaussians") for some in (bare, attached)),
        " / ".join(_mean(attached, name) for name in ("inserted", "removed")),
        *(" → ".join(_mean(some, name) for some in (bare, attached)) for name in ("cpu_seconds", "peak_mb")),
        worst(bare, attached),
    )


def _moving(bare: Sequence[Row], attached: Sequence[Row]) -> str:
    """PSNR of what moves, bare and attached, and the gain; rows from before it was scored have none."""
    both = [
        (row["psnr_moving"], other["psnr_moving"])
        for row, other in pairs(bare, attached)
        if row.get("psnr_moving") is not None and other.get("psnr_moving") is not None
    ]
    if not both:
        return "-"
    ends = " → ".join(f"{mean(values):.2f}" for values in zip(*both))
    return f"{ends}, {_spread([other - one for one, other in both], sign='+')}"


def _mean(rows: Sequence[Row], name: str) -> str:
    known = [row[name] for row in rows if name in row]
    return str(round(mean(known))) if known else "-"


def last(row: Row) -> float:
    """PSNR of the last report, dB."""
    return row["psnr"][max(row["psnr"], key=int)]


def pairs(first: Sequence[Row], second: Sequence[Row]) -> list[tuple[Row, Row]]:
    """Rows of the same seed."""
    return [(row, other) for row in first for other in second if row["seed"] == other["seed"]]


def same(bare: Sequence[Row], without: Sequence[Row]) -> str:
    """Whether every run without hooks ended with the trained numbers of the bare one, bit for bit."""
    found = [
        row["digest"] == other["digest"] and (not other["psnr"] or row["psnr"] == other["psnr"])
        for row, other in pairs(bare, without)
    ]
    return "-" if not found else "the same bits" if all(found) else "DIFFERS"


def worst(bare: Sequence[Row], attached: Sequence[Row]) -> str:
    """The least gain over all reports from the first tenth on, dB, and its iteration."""
    gains = [
        (other["psnr"][number] - row["psnr"][number], int(number))
        for row, other in pairs(bare, attached)
        for number in row["psnr"].keys() & other["psnr"].keys()
    ]
    if not gains:
        return "-"
    gain, number = min(gains)
    return f"{gain:+.2f} at {number}"


def _spread(values: Sequence[float], sign: str = "") -> str:
    """Mean and its standard error; of one value no error is known."""
    if not values:
        return "-"
    text = f"{mean(values):{sign}.2f}"
    return f"{text} ± {stdev(values) / len(values) ** 0.5:.2f}" if len(values) > 1 else text


def replaced(text: str, tables: str, where: str) -> str:
    """The page with its tables made anew."""
    if text.count(START) != 1 or text.count(END) != 1 or text.index(START) > text.index(END):
        raise D2Error(f"{where} needs one line {START} and, below it, one line {END}: the tables go between them")
    return f"{text[: text.index(START) + len(START)]}\n\n{tables}\n\n{text[text.index(END) :]}"
