"""The folder of an import: known by its settings, its videos and its calibration, it keeps what each step gave."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

from d2_plugin.durable import Kind, is_leftover, read_table, write_table
from d2_plugin.errors import D2Error
from d2_plugin.locks import only_writer
from d2_plugin.reading import json_text, opened, reaching, shown_path
from d2_plugin.recordings.cameras.camera import check_name
from d2_plugin.recordings.importing.settings import ImportSettings
from d2_plugin.recordings.importing.video import VIDEO_SUFFIXES, videos_below

STEPS = "import"  # folder of what each step gave

SOLVED = "calibration.json"  # of poses that were found from the videos

KIND = Kind("step of an import", 1, "delete it, it will be made again")

MOST_FILES = 1000  # of a calibration that is a folder
ENDS = 1 << 20  # bytes at either end of a file that stand for it


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
    by_name: dict[str, Path] = {}
    for path in paths:
        check_name(path.stem, str(path))
        if path.stem in by_name:
            raise D2Error(
                f"{by_name[path.stem]} and {path} are both called {path.stem}: name each video like its camera"
            )
        by_name[path.stem] = Path(os.path.realpath(path))
    return by_name


def identity(settings: ImportSettings, paths: Mapping[str, Path]) -> dict[str, Any]:
    """What makes two imports the same one, as plain values."""
    table = {name: value for name, value in asdict(settings).items() if name not in ("output", "videos")}
    given = {name: value for name, value in table.items() if isinstance(value, Path)}
    marks = {name: _fingerprint(path) for name, path in given.items()}
    videos = {name: _fingerprint(path) for name, path in paths.items()}
    return dict(json.loads(json_text({**table, **marks, "videos": videos}, "import.json")))


def refuse_another(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Raise where the folder holds something else than this import; steps of another one without images are removed."""
    if folder.exists() and not folder.is_dir():
        raise D2Error(f"{folder} is a file, and a recording needs a folder: give another --output")
    kept_settings = folder / STEPS / "import.json"
    if kept_settings.is_file():
        there = read_table(kept_settings, KIND)
        changed = sorted(key for key in {*there, *wanted} if there.get(key) != wanted.get(key))
        if changed and all(is_leftover(inside) or inside.name in (STEPS, SOLVED) for inside in folder.iterdir()):
            with only_writer(folder):
                shutil.rmtree(folder / STEPS)
                (folder / SOLVED).unlink(missing_ok=True)
        elif changed:
            raise D2Error(
                f"{folder} holds another import, made with other {', '.join(changed)}: give another --output, or "
                "remove that folder"
            )
    elif folder.is_dir() and not all(is_leftover(inside) or inside.name == STEPS for inside in folder.iterdir()):
        raise D2Error(f"{folder} is not empty and holds no import: give another --output")


def kept(folder: Path, step: str, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """What the step gave, now or when it was done before."""
    path = folder / STEPS / f"{step}.json"
    if not path.is_file():
        write_table(path, make(), KIND)
    return read_table(path, KIND)


def _fingerprint(path: Path) -> str:
    """SHA-256 of the size and both ends of a file, or of all files of a folder."""
    digest = hashlib.sha256()
    for file in _files_below(path) if path.is_dir() else [path]:
        with opened(file, "give the file that is there") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            digest.update(f"{file.name if path.is_dir() else ''} {size}".encode())
            digest.update(stream.read(ENDS))
            stream.seek(max(size - ENDS, 0))
            digest.update(stream.read(ENDS))
    return digest.hexdigest()


def _files_below(folder: Path) -> list[Path]:
    """All files of a calibration that is a folder; not those of a disk."""
    with reaching(folder, "give the calibration file itself"):
        files = list(islice((one for one in folder.rglob("*") if one.is_file()), MOST_FILES + 1))
    if len(files) > MOST_FILES:
        raise D2Error(
            f"{folder} holds more than {MOST_FILES} files, which is no calibration: give the calibration file itself"
        )
    return sorted(files)
