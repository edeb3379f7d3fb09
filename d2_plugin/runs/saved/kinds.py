"""The tables of a run folder: what each is called, its version, and what to do about a damaged one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from d2_plugin.durable import Damaged, Kind, read_table
from d2_plugin.errors import D2Error

RUN = Kind("table of settings", 1, "run `d2 train` with another --output, or remove that folder")
"""run.json."""

METRICS = Kind("table of scores", 1, "run `d2 eval` on that folder")
"""metrics.json."""

SHAPE: dict[str, tuple[type, ...]] = {
    "test": (dict, type(None)),
    "seconds": (dict,),
    "gaussians": (int,),
    "iterations": (int,),
    "recording": (str,),
    "train_cameras": (list,),
    "backbone": (str,),
    "hooks": (list,),
}
"""What every table of scores holds."""


def read_run(folder: Path) -> dict[str, Any]:
    """The run.json of a run folder.

    Raises:
        D2Error: there is none, it is damaged, or that of another version.
    """
    try:
        return read_table(folder / "run.json", RUN)
    except FileNotFoundError:
        raise D2Error(f"{folder} holds no run: expected run.json; give the --output folder of `d2 train`") from None


def read_metrics(folder: Path) -> dict[str, Any]:
    """The metrics.json of a run folder.

    Raises:
        D2Error: there is none, it is damaged, or that of another version.
    """
    path = folder / "metrics.json"
    try:
        table = read_table(path, METRICS)
    except FileNotFoundError:
        raise D2Error(f"{folder} has no metrics.json: finish `d2 train` there, or run `d2 eval`") from None
    missing = [name for name, kinds in SHAPE.items() if name not in table or not isinstance(table[name], kinds)]
    if missing:
        raise Damaged(f"the {METRICS.name} {path} is damaged (no {', '.join(missing)} in it): {METRICS.remedy}")
    return table
