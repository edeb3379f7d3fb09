"""The folder of a run: it belongs to one set of settings, and its files are never half written."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error
from d2_plugin.runs.settings import RunSettings


def read_settings(folder: Path) -> RunSettings:
    """The settings of the run that lies in `folder`.

    Raises:
        D2Error: it holds no run.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise D2Error(f"{folder} holds no run: expected run.json; give the --output folder of `d2 train`")
    table: dict[str, Any] = json.loads(path.read_text())
    tuples: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    return RunSettings(**tuples)


def claim(folder: Path, settings: RunSettings) -> None:
    """Take the folder, or find this very run in it; anything else is refused and nothing is written."""
    identity = json.loads(json.dumps(asdict(settings)))
    path = folder / "run.json"
    if path.is_file():
        found = json.loads(path.read_text())
        changed = sorted(k for k in identity.keys() | found.keys() if identity.get(k) != found.get(k))
        if changed:
            raise D2Error(
                f"{folder} holds another run, made with other settings of {', '.join(changed)}: "
                "give another --output, or remove that folder"
            )
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no run of ours: give another --output")
    folder.mkdir(parents=True, exist_ok=True)
    write_json(path, identity)


def write_json(path: Path, table: Mapping[str, Any]) -> None:
    """Write a table; who reads the file meanwhile finds the old one or the new one, whole."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(table, indent=1))
    os.replace(temporary, path)
