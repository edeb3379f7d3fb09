"""A run folder holds one run: that of its run.json."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from d2_plugin.durable import is_leftover, make_folder, write_table
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.runs.saved.kinds import RUN, read_run
from d2_plugin.runs.settings import RunSettings


def claim(folder: Path, identity: Mapping[str, Any]) -> None:
    """Take the folder, or find this very run in it; anything else is refused and nothing is written."""
    if folder.exists() and not folder.is_dir():
        raise D2Error(f"{folder} is a file, and a run needs a folder: give another --output")
    if (folder / "run.json").exists():
        _refuse_another(folder, identity)
        return
    if folder.is_dir() and not all(is_leftover(inside) for inside in folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no run of ours: give another --output")
    with only_writer(make_folder(folder)):
        if (folder / "run.json").exists():  # somebody was quicker
            _refuse_another(folder, identity)
        else:
            write_table(folder / "run.json", dict(identity), RUN)


def _refuse_another(folder: Path, identity: Mapping[str, Any]) -> None:
    table = read_run(folder)
    guidance = table.pop("guidance", None)
    kept = RunSettings.from_table(table, str(folder / "run.json")).as_table()
    kept |= {} if guidance is None else {"guidance": guidance}
    changed = sorted(k for k in identity.keys() | kept.keys() if identity.get(k) != kept.get(k))
    if changed:
        raise D2Error(
            f"{folder} holds another run, made with other settings of {', '.join(changed)}: "
            "give another --output, or remove that folder"
        )
