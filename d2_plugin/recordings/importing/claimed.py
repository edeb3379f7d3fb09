"""Whose folder it is: an import is known by its settings, its videos and its calibration, and its steps are kept."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

from d2_plugin.durable import Kind, is_leftover, read_table, write_table
from d2_plugin.errors import D2Error
from d2_plugin.reading import opened, reaching, shown_path
from d2_plugin.recordings.cameras.calibration import check_name
from d2_plugin.recordings.importing.files import VIDEO_SUFFIXES, videos_below
from d2_plugin.recordings.importing.settings import OF_A_SOLVED_RIG, ImportSettings

STEPS = "import"
"""Folder of what each step found."""

KIND = Kind("step of an import", 1, "delete it, it will be made again")

MOST_FILES = 1000
"""Of a calibration that is a folder."""

ENDS = 1 << 20
"""Bytes at either end of a file that stand for it."""


def paths_of(settings: ImportSettings) -> dict[str, Path]:
    """The video of each camera, which is called like its file.

    Raises:
        D2Error: no video, a folder without any, or two of one name.
    """
    paths: list[Path] = []
    for path in settings.videos:
        paths += videos_below(path) if path.is_dir() else [path]
    if not paths:
        where = ", ".join(map(shown_path, settings.videos)) or "nothing"
        raise D2Error(f"{where} holds no video: give videos, or a folder with {', '.join(VIDEO_SUFFIXES[:4])} files")
    found: dict[str, Path] = {}
    for path in paths:
        check_name(path.stem, str(path))
        if path.stem in found:
            raise D2Error(f"{found[path.stem]} and {path} are both called {path.stem}: name each video like its camera")
        found[path.stem] = path.resolve()
    return found


def identity(settings: ImportSettings, paths: Mapping[str, Path]) -> dict[str, Any]:
    """What makes two imports the same one."""
    table = {name: _plain(value) for name, value in asdict(settings).items()}
    del table["output"], table["videos"]
    for name, nothing in {"calibration": None, **OF_A_SOLVED_RIG}.items():
        value = getattr(settings, name)
        if value == nothing:
            del table[name]  # so that recordings of versions without these settings stay the same import
        elif isinstance(value, Path):
            table[name] = _fingerprint(value)
    return {**table, "videos": {name: _fingerprint(path) for name, path in paths.items()}}


def _plain(value: Any) -> Any:
    """As JSON has it: lists for tuples, text for what it does not know."""
    if isinstance(value, dict):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def refuse_another(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Raise where the folder holds something else than this import; nothing is written."""
    if folder.exists() and not folder.is_dir():
        raise D2Error(f"{folder} is a file, and a recording needs a folder: give another --output")
    told = folder / STEPS / "import.json"
    if told.is_file():
        found = read_table(told, KIND)
        changed = sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        if changed:
            raise D2Error(
                f"{folder} holds another import, made with other {', '.join(changed)}: give another --output, or "
                "remove that folder"
            )
    elif folder.is_dir() and not all(is_leftover(inside) or inside.name == STEPS for inside in folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no import: give another --output")


def claim(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Take the folder, which nobody else writes now."""
    refuse_another(folder, wanted)
    if not (folder / STEPS / "import.json").is_file():
        write_table(folder / STEPS / "import.json", wanted, KIND)


def kept(folder: Path, step: str, find: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What the step found, now or when it was done before."""
    path = folder / STEPS / f"{step}.json"
    if not path.is_file():
        write_table(path, find(), KIND)
    return read_table(path, KIND)


def _files_below(folder: Path) -> list[Path]:
    """All files of a calibration that is a folder; not those of a disk."""
    with reaching(folder, "give the calibration file itself"):
        found = list(islice((one for one in folder.rglob("*") if one.is_file()), MOST_FILES + 1))
    if len(found) > MOST_FILES:
        raise D2Error(
            f"{folder} holds more than {MOST_FILES} files, which is no calibration: give the calibration file itself"
        )
    return sorted(found)


def _fingerprint(path: Path) -> str:
    """SHA-256 of the size and both ends of a file, or of all files of a folder."""
    digest = hashlib.sha256()
    files = _files_below(path) if path.is_dir() else [path]
    for file in files:
        with opened(file, "give the file that is there") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            digest.update(f"{file.name if path.is_dir() else ''} {size}".encode())
            digest.update(stream.read(ENDS))
            stream.seek(max(size - ENDS, 0))
            digest.update(stream.read(ENDS))
    return digest.hexdigest()
