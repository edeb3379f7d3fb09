"""Arrays with a JSON record beside them, written so that a kill at any moment leaves either the old or the new one."""

from __future__ import annotations

import json
import logging
import secrets
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.errors import D2Error

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Entry:
    """One stored array and its record."""

    path: Path
    record: dict[str, Any]

    def array(self, dtype: np.dtype | None = None) -> np.ndarray:
        """The array, memory-mapped, after its checksum was compared.

        Raises:
            D2Error: it is damaged.
        """
        problem = self.problem(dtype) or self.checksum_problem()
        if problem:
            raise D2Error(f"{self.path} is damaged ({problem}): delete it and build again")
        return np.load(self.path, mmap_mode="r")

    def problem(self, dtype: np.dtype | None = None) -> str:
        """What is wrong with the file as far as its header tells, or an empty string; reads no pixels."""
        try:
            mapped = np.load(self.path, mmap_mode="r")
        except (OSError, ValueError, EOFError) as error:
            return f"cannot be read: {error}"
        expected = tuple(self.record.get("shape", ()))
        if mapped.shape != expected or (dtype is not None and mapped.dtype != dtype):
            return f"holds {mapped.dtype} {mapped.shape}, the record says {dtype or mapped.dtype} {expected}"
        return ""

    def checksum_problem(self) -> str:
        """Empty where the bytes match the record's checksum."""
        found = checksum(np.load(self.path, mmap_mode="r"))
        return "" if found == self.record.get("checksum") else "its checksum differs from the one recorded"


class EntryFolder:
    """Entries by camera and frame below one folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def location(self, camera: str, frame: int) -> Path:
        """Where the array of one view is or would be."""
        return self.path / camera / f"{frame:05d}.npy"

    def find(self, camera: str, frame: int) -> Entry | None:
        """The entry, or None where it was never finished; its array is not looked at.

        Raises:
            D2Error: its record is damaged.
        """
        path = self.location(camera, frame)
        try:
            return Entry(path, read_json(path.with_suffix(".json")))
        except FileNotFoundError:
            return None

    def find_current(self, camera: str, frame: int, key: str) -> Entry | None:
        """The entry where it is intact and was made from exactly the inputs that `key` stands for.

        A damaged one is named in the log and counts as absent, so that whoever builds makes it anew.
        """
        try:
            entry = self.find(camera, frame)
        except D2Error as error:
            logger.warning("%s", error)
            return None
        if entry is None or entry.record.get("key") != key:
            return None
        problem = entry.problem() or entry.checksum_problem()
        if problem:
            logger.warning("%s is damaged (%s) and is built again", entry.path, problem)
        return None if problem else entry

    def write(self, camera: str, frame: int, array: np.ndarray, record: dict[str, Any]) -> None:
        """Write the array and its record (see `write_entry`)."""
        write_entry(self.location(camera, frame), array, record)


def write_entry(path: Path, array: np.ndarray, record: dict[str, Any]) -> None:
    """Array first, record second, each under a temporary name: a record vouches for the array beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    with temporary.open("wb") as file:
        np.save(file, array)
    temporary.replace(path)
    write_json(path.with_suffix(".json"), {**record, "shape": list(array.shape), "checksum": checksum(array)})


def checksum(array: np.ndarray) -> int:
    """CRC-32 of an array's bytes."""
    return zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data)


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        FileNotFoundError: no such file.
        D2Error: the file is not valid JSON.
    """
    try:
        return json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise D2Error(f"{path} is damaged ({error}): delete it and build again") from None


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write under a temporary name and rename; NaN and infinity are refused, since JSON has neither."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = _temporary(path)
    temporary.write_text(json.dumps(values, indent=1, allow_nan=False, sort_keys=True))
    temporary.replace(path)


def _temporary(path: Path) -> Path:
    """A name that no other writer uses: several threads, processes and machines may write one folder."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}")
