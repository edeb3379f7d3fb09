"""The files that trainers write: tensors, point clouds, and the options of a run. No code in them is run."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, read_bytes, read_text
from d2_plugin.values import checked_arguments

MOST_PLY = 1 << 33
"""Bytes of a point cloud, at most."""

KINDS = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}


def read_tensors(path: Path) -> Any:
    """Tensors and plain values of a file of `torch.save`.

    Raises:
        D2Error: another kind of file, or one with objects in it.
    """
    # scene.cameras_extent is a number of numpy's, which calls this module by another name since its version 2.
    scalar: Any = np.float32(0).__reduce__()[0]
    named = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    allowed: list[Any] = [*named, np.dtype, np.dtypes.Float32DType, np.dtypes.Float64DType]
    safely = torch.serialization.safe_globals(allowed)
    with parsing(f"{path} as a checkpoint of tensors", "give the trainer's .pth"), safely:
        return torch.load(path, map_location="cpu", weights_only=True)


def read_state(path: Path) -> dict[str, Tensor]:
    """The weights of a network by their names.

    Raises:
        D2Error: the file holds something else.
    """
    state = read_tensors(path)
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise D2Error(f"{path} holds no weights of a network: give the trainer's own file")
    return {name: value.detach().float() for name, value in state.items()}


def read_options(path: Path) -> dict[str, Any]:
    """The plain values among the options in a `cfg_args`, which is the text `Namespace(name=value, ...)`.

    Raises:
        D2Error: no such file, or another text.
    """
    text = read_text(path, "copy it along with the point cloud, it says how the trainer was set")
    with parsing(f"{path} as a list of options", "expected Namespace(name=value, ...), as the trainer writes it"):
        call: Any = ast.parse(text.strip(), mode="eval").body
        keywords = call.keywords
    found = {}
    for keyword in keywords:
        try:
            found[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except ValueError:  # an object: nothing that is asked for
            continue
    return found


@checked_arguments
def read_ply(path: Path) -> dict[str, Tensor]:
    """The float properties of the vertices of a binary PLY, [N] each.

    Raises:
        D2Error: no such file, or one cut short.
    """
    data = read_bytes(path, "export it again", MOST_PLY)
    with parsing(f"{path} as a point cloud", "export it again"):
        head, end = data.split(b"end_header\n", 1)[0].decode("ascii").splitlines(), data.index(b"end_header\n") + 11
        if head[0] != "ply" or "format binary_little_endian 1.0" not in head:
            raise ValueError("expected a binary little-endian PLY")
        count = next(int(line.split()[2]) for line in head if line.startswith("element vertex"))
        if count < 0:
            raise ValueError(f"it says {count} vertices")
        fields = [line.split()[1:] for line in head if line.startswith("property") and " list " not in line]
        table = np.frombuffer(data, np.dtype([(name, KINDS[kind]) for kind, name in fields]), count, end)
    return {name: torch.from_numpy(table[name].astype(np.float32)) for name in table.dtype.names or ()}


def columns(rows: dict[str, Tensor], name: str) -> Tensor:
    """The columns name_0, name_1, ... as [N, count]; x, y and z for xyz."""
    if name == "xyz":
        return torch.stack([rows[axis] for axis in "xyz"], 1)
    # By number: rot_r_0 is none of the rotations.
    count = sum(column.startswith(f"{name}_") and column[len(name) + 1 :].isdigit() for column in rows)
    found = [rows[f"{name}_{i}"] for i in range(count)]
    return torch.stack(found, 1) if found else rows["x"].new_zeros(len(rows["x"]), 0)
