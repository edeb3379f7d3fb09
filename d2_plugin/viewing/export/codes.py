"""Numbers as 16-bit codes (or 8-bit and coarser ones) between the least and the largest of their block, and back.

Rows are coded in blocks of 256, each column with its own range in each block. Neighbours in space stand in one block
(`morton_order`), so that the step is small, and a Gaussian far out costs precision in its own block only.

An array is stored as ranges float32 [blocks, columns, 2], then per column the high bytes of all rows and then the low
bytes: bytes of one kind beside each other are what a general compressor makes smaller.
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d2_plugin.reading import json_text

BLOCK = 256
COMPRESSION = 6


@dataclass(frozen=True)
class Coded:
    """One array in its stored form."""

    name: str
    data: bytes
    rows: int
    columns: int
    bits: int


def encode(name: str, values: np.ndarray, bits: int = 16) -> Coded:
    """Code `values` [N, C] (or [N]); all finite. Codes have 16 bits, or at most 8."""
    values = np.asarray(values, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    rows, columns = values.shape
    blocks = -(-rows // BLOCK)
    padded = np.concatenate([values, np.repeat(values[-1:], blocks * BLOCK - rows, axis=0)])
    padded = padded.reshape(blocks, BLOCK, columns)
    ranges = np.stack([padded.min(1), padded.max(1)], -1).astype("<f4") if blocks else np.zeros((0, columns, 2), "<f4")
    low, high = (ranges[..., i].astype(np.float64)[:, None] for i in (0, 1))
    steps = (1 << bits) - 1
    share = (padded - low) / np.where(high > low, high - low, 1)
    codes = np.clip(np.rint(share * steps), 0, steps).astype(np.uint16)
    planes = codes.reshape(blocks * BLOCK, columns)[:rows].T
    parts = [planes >> 8, planes & 255] if bits > 8 else [planes]
    body = np.stack(parts, axis=1).astype(np.uint8).tobytes()
    return Coded(name, ranges.tobytes() + body, rows, columns, bits)


def decode(coded: Coded) -> np.ndarray:
    """The values [N, C] float64 that a reader of `coded` finds."""
    blocks = -(-coded.rows // BLOCK)
    size = blocks * coded.columns * 8
    ranges = np.frombuffer(coded.data[:size], "<f4").reshape(blocks, coded.columns, 2).astype(np.float64)
    kinds = planes_of(coded.bits)
    planes = np.frombuffer(coded.data[size:], np.uint8).reshape(coded.columns, kinds, coded.rows).astype(np.float64)
    codes = planes[:, 0] * 256 + planes[:, 1] if kinds == 2 else planes[:, 0]
    block = np.arange(coded.rows) // BLOCK
    low, high = ranges[block, :, 0], ranges[block, :, 1]
    return low + codes.T * (high - low) / ((1 << coded.bits) - 1)


def planes_of(bits: int) -> int:
    """How many bytes a code takes; one of fewer than 8 bits takes a whole one, which then compresses well."""
    return 2 if bits > 8 else 1


def packed(arrays: Sequence[Coded]) -> tuple[list[dict[str, Any]], bytes]:
    """A table of contents, and all arrays behind each other, compressed."""
    contents, offset = [], 0
    for array in arrays:
        entry = {"name": array.name, "rows": array.rows, "columns": array.columns, "bits": array.bits}
        contents.append(entry | {"offset": offset})
        offset += len(array.data)
    return contents, gzip.compress(b"".join(array.data for array in arrays), COMPRESSION, mtime=0)


def unpacked(contents: Sequence[Mapping[str, Any]], data: bytes, without: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """The values of every array by its name, from what `packed` made; those named in `without` are left out."""
    raw, found = gzip.decompress(data), {}
    for entry in contents:
        if entry["name"] in without:
            continue
        rows, columns, bits = entry["rows"], entry["columns"], entry["bits"]
        size = -(-rows // BLOCK) * columns * 8 + rows * columns * planes_of(bits)
        body = raw[entry["offset"] : entry["offset"] + size]
        found[entry["name"]] = decode(Coded(entry["name"], body, rows, columns, bits))
    return found


def morton_order(positions: np.ndarray) -> np.ndarray:
    """An order of rows [N] in which neighbours in space stand beside each other (Morton's curve, 10 bits an axis)."""
    if not len(positions):
        return np.zeros(0, np.int64)
    low, high = np.quantile(positions, [0.005, 0.995], axis=0)
    cells = np.clip((positions - low) / np.maximum(high - low, 1e-30), 0, 1) * 1023
    key = np.zeros(len(positions), np.int64)
    for axis in range(3):
        cell = cells[:, axis].astype(np.int64)
        for bit in range(10):
            key |= ((cell >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def to_json(table: Any) -> str:
    """JSON that may stand inside an HTML <script>: no '<', so no name in it can close the element or open one."""
    text = json_text(table, "the page", separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
