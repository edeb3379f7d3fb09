"""The rows of `runs.jsonl`: every measurement of the study in one form, one JSON object a line, only ever appended.

Whatever was measured, a row says what (`kind`, `case`), how (`method`, `setting`), how well (`error`, lower is better;
`seconds`), or why not (`failed`), and where from (device, threads, versions, commit, command). What else a kind knows
stands beside these under names of its own; `d2 report` makes tables and plots of all of them.
"""

from __future__ import annotations

import functools
import math
import platform
import shlex
import subprocess
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from d2_plugin import __version__
from d2_plugin.durable import append
from d2_plugin.errors import D2Error
from d2_plugin.reading import field, json_text, opened, parse_json, read_text
from d2_plugin.settings import Settings, declared
from d2_plugin.values import counted

if TYPE_CHECKING:
    from d2_plugin.runs.settings import RunSettings

Row = dict[str, Any]

TRY = "try"
"""`target` of a training that only looked for the number of steps of a time: such a row is in no table."""

FORM = {
    **dict.fromkeys(("kind", "case", "method", "setting"), str),
    **dict.fromkeys(("error", "seconds"), float | None),
    **dict.fromkeys(("failed", "device"), str | None),
    "threads": int | None,
    **dict.fromkeys(("version", "commit", "torch"), str | None),
    "command": str,
}
"""What every row holds, and what each of it is."""


def make_row(
    kind: str,
    case: str,
    method: str,
    setting: str = "default",
    *,
    error: float | None,
    seconds: float | None,
    failed: str | None = None,
    command: str = "",
    device: torch.device | str = "cpu",
    **details: Any,
) -> Row:
    """One measurement with its circumstances.

    Args:
        kind: what was measured: training, quality, ablation, or a benchmark of the checkout.
        case: scene, rig, recording or sweep that was measured.
        method, setting: what was measured, and what was varied about it.
        error: lower is better; None where it was not measured. Not finite is a failure and is recorded as one.
        seconds: of the work as the kind defines it; None where it was not measured.
        failed: why there is no result, in the method's own words.
        details: whatever else the kind knows, as JSON can hold it.
    """
    if error is not None and not math.isfinite(error):
        error, failed = None, failed or f"the error is {error}"
    row: Row = {"kind": kind, "case": case, "method": method, "setting": setting}
    row |= {"error": error, "seconds": seconds, "failed": failed}
    return row | details | circumstances(device) | {"command": command}


def rms_error(scores: Mapping[str, float | None]) -> float | None:
    """The root mean square error of colour, 0..1, that a PSNR stands for: 10^(-PSNR / 20)."""
    psnr = scores.get("psnr")
    return None if psnr is None else 10 ** (-psnr / 20)


def case_name(recording: str, settings: RunSettings) -> str:
    """The recording, how many cameras trained, what of it was used where that is not all, and the protocol."""
    parts = [recording, counted(len(settings.train_cameras), "view")]
    parts += [f"1/{settings.downscale} size"] if settings.downscale > 1 else []
    parts += [f"1/{settings.hold_out_instants} of the instants"] if settings.hold_out_instants > 1 else []
    return ", ".join([*parts, *([settings.protocol] if settings.protocol else [])])


def told_apart(rows: Sequence[Row]) -> list[Row]:
    """The rows, with the cameras behind the case where some of one case trained with other ones, and those that scored,
    the frames and a hash of an image where rows of runs say them: their means are not to be mixed."""
    told = list(rows)
    for name, front in (("cameras", ""), ("test_cameras", "scored "), ("frames", "frames "), ("images", "images ")):
        said = [_listed(row[name]) if name in row and (not front or "test_cameras" in row) else "" for row in told]
        known = {(row["kind"], row["case"], text) for row, text in zip(told, said) if text}
        several = Counter(case[:2] for case in known)
        told = [
            {**row, "case": f"{row['case']}, {front}{text}"} if text and several[row["kind"], row["case"]] > 1 else row
            for row, text in zip(told, said)
        ]
    return told


def _listed(names: Sequence[Any] | None) -> str:
    names = ["all"] if names is None else names
    return " ".join(map(str, names)) if len(names) < 9 else f"{names[0]} to {names[-1]}, {len(names)} of them"


def append_rows(path: Path, rows: Iterable[Row]) -> None:
    """Add rows to the end of a file, which is created where absent.

    Raises:
        D2Error: the file holds something else; nothing is written.
    """
    if path.exists():
        with opened(path, "give another --output") as file:
            begin = file.read(1).strip()
        if begin not in (b"", b"{"):
            raise D2Error(f"{path} is no file of rows, one JSON object a line: give another --output")
    append(path, "".join(json_text(_plain(row), "the row") + "\n" for row in rows))


def read_rows(paths: Sequence[Path]) -> list[Row]:
    """The rows of all files, in order.

    Raises:
        D2Error: an absent file, a line that is not JSON, or a row that lacks what every row has.
    """
    rows = []
    for path in paths:
        lines = read_text(path, "give a file that a `d2` command wrote").splitlines()
        rows += [_checked(line, f"{path}, line {i}") for i, line in enumerate(lines, start=1) if line.strip()]
    return rows


def _checked(line: str, where: str) -> Row:
    row = parse_json(line, where, "restore the file, or remove that line")
    for name, kind in FORM.items():
        known = row if isinstance(row, dict) else {}
        field(known, name, kind, where, "measure it again, its form is not that of this version")
    return row


def _plain(value: Any) -> Any:
    """The same without numbers that JSON does not have: they become null."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def command_line(command: str, settings: Settings) -> str:
    """The command with every setting that is not the default; of an absolute path the last part alone, since the rest
    says nothing about the measurement."""
    words = command.split()
    for setting in declared(type(settings)):
        value = getattr(settings, setting.name)
        if value == setting.default:
            continue
        texts = [_typed(item) for item in value] if isinstance(value, tuple) else [_typed(value)]
        if setting.positional:
            words += texts
        else:
            words += [f"--{setting.name.replace('_', '-')}", *([] if value is True else [",".join(texts)])]
    return shlex.join(words)


def _typed(value: object) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return Path(text).name if text.startswith("/") else text


def circumstances(device: torch.device | str = "cpu") -> dict[str, str | int | None]:
    """Device, threads, versions and commit, for a row of results."""
    device = torch.device(device)
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name(),
        "threads": torch.get_num_threads(),
        "version": __version__,
        "commit": commit(),
        "torch": torch.__version__,
    }


def cpu_name() -> str:
    """What the processor calls itself."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else ():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def commit() -> str | None:
    """The commit of the checkout when first asked, with + where files differ; None for an installed package."""
    try:
        revision, changed = _git("rev-parse", "--short", "HEAD"), _git("status", "--porcelain", "--", "..")
    except (OSError, subprocess.CalledProcessError):
        return None
    return revision.strip() + ("+" if changed else "")


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True).stdout
