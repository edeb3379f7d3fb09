"""Arrays in .npy and .npz files that somebody else wrote, checked before memory is taken for them.

The header says how many numbers follow: it is held against the file, and a header that claims more, or anything but
numbers (text, records, objects), is one sentence. Nothing is ever unpickled.
"""

from __future__ import annotations

import math
import os
import warnings
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

from d2_plugin.reading import MOST_BYTES, RESTORE, Unreadable, opened, parsing, shown_path

NUMBERS = "biuf"
"""Kinds of dtype that are numbers: true or false, whole with and without sign, floating."""


def read_array(path: Path | str, remedy: str = RESTORE, *, key: str | None = None) -> np.ndarray:
    """The numbers of a .npy file, or of the member `key` of an .npz file.

    Args:
        remedy: what to do, the end of the sentence.
        key: name of a member of an .npz; None for a .npy.

    Raises:
        Unreadable: no such file, not such a file, no plain numbers, more or fewer bytes than its header says, or a
            member whose checksum is wrong.
    """
    name = shown_path(path)
    with opened(path, remedy) as file, parsing(name, remedy):
        if key is None:
            return _array(file, os.fstat(file.fileno()).st_size, name, remedy)
        with zipfile.ZipFile(file) as archive:
            if f"{key}.npy" not in archive.namelist():
                have = ", ".join(member.removesuffix(".npy") for member in archive.namelist()[:8])
                raise Unreadable(f"{name} has no array '{key}', it has {have or 'none'}: {remedy}")
            size = archive.getinfo(f"{key}.npy").file_size
            with archive.open(f"{key}.npy") as member:
                found = _array(member, size, f"{key} in {name}", remedy)
                member.read()  # the checksum of the member is compared at its end
            return found


def array_names(path: Path | str, remedy: str) -> set[str]:
    """The names of the arrays in a .npz file."""
    with opened(path, remedy) as file, parsing(shown_path(path), remedy), zipfile.ZipFile(file) as archive:
        return {member.removesuffix(".npy") for member in archive.namelist() if member.endswith(".npy")}


def _array(file: IO[bytes], size: int, name: str, remedy: str) -> np.ndarray:
    """The array that begins where `file` stands, whose file has `size` bytes."""
    shape, columns_first, dtype = _header(file, size, name, remedy)
    needed = math.prod(shape) * dtype.itemsize
    if needed > MOST_BYTES:
        most = f"more than {MOST_BYTES}, the most that is read"
        raise Unreadable(f"{name} has {needed} bytes of numbers, {most}: {remedy}")
    data = file.read(needed)
    if len(data) != needed:
        raise Unreadable(f"{name} ends after {len(data)} of {needed} bytes of numbers: {remedy}")
    flat = np.frombuffer(bytearray(data), dtype) if needed else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if columns_first else "C")


def _header(file: IO[bytes], size: int, name: str, remedy: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, whether the first axis runs fastest, dtype) of an array that fits the file exactly."""
    shape, columns_first, dtype = _read_header(file, name, remedy)
    if dtype.hasobject or dtype.kind not in NUMBERS or dtype.itemsize == 0:
        raise Unreadable(f"{name} holds {str(dtype)[:60]}, expected plain numbers: {remedy}")
    needed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if needed != there:
        raise Unreadable(f"{name} says {dtype} {_short(shape)}, {needed} bytes, but {there} follow: {remedy}")
    return shape, columns_first, dtype


def _read_header(file: IO[bytes], name: str, remedy: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    magic = file.read(np.lib.format.MAGIC_LEN)
    version = tuple(magic[6:8])
    if magic[:6] != b"\x93NUMPY" or version not in readers:
        raise Unreadable(f"{name} is no array of numpy's .npy format, version 1 or 2: {remedy}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers written by Python 2
        shape, columns_first, dtype = readers[version](file)
    if any(length < 0 for length in shape):
        raise Unreadable(f"{name} has shape {_short(shape)}, expected lengths of 0 or more: {remedy}")
    return tuple(int(length) for length in shape), columns_first, dtype


def _short(shape: tuple[int, ...]) -> str:
    text = str(shape) if sum(length.bit_length() for length in shape) < 400 else f"of {len(shape)} axes"
    return text if len(text) <= 80 else f"{text[:76]} ..."
