"""Arrays with a JSON record beside them, written so that a kill at any moment leaves either the old or the new one.

The record is sealed (`d2_plugin.durable`) and holds the checksum of the array: what is read is what was written.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.durable import Kind, read_table, refuse_no_file, write, write_table
from d2_plugin.errors import D2Error

logger = logging.getLogger(__name__)

RECORD = Kind("record", 2, "delete it and build again")
"""The tables beside the arrays."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One stored array and its record."""

    path: Path
    record: dict[str, Any]

    def array(self, dtype: np.dtype | None = None, intact: bool = False) -> np.ndarray:
        """The array, memory-mapped, after its checksum was compared, unless it is known to be `intact`.

        Raises:
            D2Error: it is damaged.
        """
        problem = self.problem(dtype) or ("" if intact else self.checksum_problem())
        if problem:
            raise D2Error(f"{self.path} is damaged ({problem}): delete it and build again")
        return _mapped(self.path)

    def problem(self, dtype: np.dtype | None = None) -> str:
        """What is wrong with the file as far as its header tells, or an empty string; reads no pixels."""
        try:
            mapped = _mapped(self.path)
        except Exception as error:  # numpy raises anything for a header that is none, or claims more than the file
            return f"cannot be read: {error}"
        expected, kind = tuple(self.record.get("shape", ())), str(dtype or self.record.get("dtype"))
        if mapped.shape != expected or str(mapped.dtype) != kind:
            return f"holds {mapped.dtype} {mapped.shape}, the record says {kind} {expected}"
        return ""

    def checksum_problem(self) -> str:
        """Empty where the bytes match the record's checksum."""
        pixels = np.ascontiguousarray(_mapped(self.path)).view(np.uint8)
        intact = zlib.crc32(pixels.data) == self.record.get("checksum")
        return "" if intact else "its checksum differs from the one recorded"


class EntryFolder:
    """Entries by camera and frame below one folder; `synced` ones outlive a power cut (`d2_plugin.durable.write`)."""

    def __init__(self, path: Path, synced: bool = True) -> None:
        self.path, self.synced = path, synced

    def location(self, camera: str, frame: int) -> Path:
        """Where the array of one view is or would be."""
        return self.path / camera / f"{frame:05d}.npy"

    def find(self, camera: str, frame: int) -> Entry | None:
        """The entry, or None where it was never finished; its array is not looked at.

        Raises:
            D2Error: its record is damaged, or that of another version.
        """
        path = self.location(camera, frame)
        try:
            return Entry(path, read_table(path.with_suffix(".json"), RECORD))
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

    def drop_damaged(self, camera: str, frame: int) -> None:
        """Forget an entry whose record or header is damaged, and name it in the log: who reads while it is built again
        finds none."""
        path = self.location(camera, frame)
        try:
            entry = self.find(camera, frame)
            problem = "" if entry is None else entry.problem()
        except D2Error as error:
            problem = str(error)
        if problem:
            logger.warning("%s is damaged (%s) and is built again", path, problem)
            path.with_suffix(".json").unlink(missing_ok=True)

    def write(self, camera: str, frame: int, array: np.ndarray, record: dict[str, Any]) -> dict[str, Any]:
        """Array first, record second, each written whole: a record vouches for the array beside it.

        What is not `synced` may be damaged after a power cut, which its checksums show: for what can be made again.

        Returns:
            The record as it was written.

        Raises:
            CannotWrite: the disk is full, broken or not ours.
        """
        path = self.location(camera, frame)
        plain = np.ascontiguousarray(array)
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(plain))
        pixels = plain.reshape(-1).view(np.uint8)
        write(path, header.getvalue(), pixels.data, synced=self.synced)
        described = {"shape": list(array.shape), "dtype": str(array.dtype), "checksum": zlib.crc32(pixels.data)}
        written = {**record, **described}
        write_table(path.with_suffix(".json"), written, RECORD, self.synced)
        return written


def _mapped(path: Path) -> np.ndarray:
    """The array of an .npy file, memory-mapped; unlike `np.load` it takes the file for nothing else."""
    refuse_no_file(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the names of types in a damaged header
        return np.lib.format.open_memmap(path, mode="r")


def hash_of(*parts: Any) -> str:
    """Hash of plain values, in an order that does not depend on dictionaries."""
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=16).hexdigest()
