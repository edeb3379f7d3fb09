"""What a multi-view network says of the views of one instant, as its own export functions name the arrays.

| writer | depth | confidence | poses | intrinsics | mask |
|---|---|---|---|---|---|
| Depth Anything 3 (`export_to_npz`, `export_to_mini_npz`) | depth | conf | extrinsics, world to camera | intrinsics | |
| VGGT (`demo_gradio.py`) | depth [V, h, w, 1] | depth_conf | extrinsic, world to camera | intrinsic | |
| MapAnything (`gradio_app.py`) | depth [V, h, w, 1] | conf | extrinsic, CAMERA TO WORLD | intrinsic | final_mask |

Depth alone is required. The mask tells MapAnything, whose poses are turned around. Beside the files multiview.json may
say which cameras the network saw, in its order, and that its maps are emulated: {"cameras": [...], "emulated": true}.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d2_plugin.arrays import array_names, read_array
from d2_plugin.errors import D2Error
from d2_plugin.reading import read_json
from d2_plugin.recordings.files import FrameFiles, frame_number, numbered_files

NAMES = {
    "depth": ("depth", "predicted_depth", "depth_z"),
    "confidence": ("conf", "depth_conf", "confidence"),
    "poses": ("extrinsics", "extrinsic"),
    "intrinsics": ("intrinsics", "intrinsic"),
    "mask": ("final_mask",),
}
"""What each array may be called."""
RESULTS = ("results.npz", "predictions.npz")
"""What the networks' own scripts call their file, somewhere below the folder of an instant."""
REMEDY = "export the prediction again"


class Predicted(NamedTuple):
    """One instant as the network gave it; `V` views."""

    depth: np.ndarray
    """float32 [V, h, w], NaN where there is none."""
    confidence: np.ndarray
    """float32 [V, h, w] in a unit of the network's own, 0 where it knows nothing; 1 where it says nothing of it."""
    poses: np.ndarray | None
    """World to camera [V, 3, 4], in a world that is the calibration's up to a similarity."""
    intrinsics: np.ndarray | None
    """[V, 3, 3], pixels of these maps."""


def declared(folder: Path) -> dict[str, Any]:
    """What multiview.json beside the files declares: `cameras`, whether maps are `emulated`; nothing without it."""
    path = folder / "multiview.json"
    return read_json(path, "list the cameras in the order in which the network saw them") if path.is_file() else {}


def prediction_files(folder: Path) -> FrameFiles:
    """Frame number -> file: FRAME.npz, or what a network's script wrote below a folder FRAME/.

    Raises:
        D2Error: no such folder, or nothing in it.
    """
    if not folder.is_dir():
        raise D2Error(f"no multi-view maps at {folder}: give a folder with FRAME.npz, or an ONNX file")
    files = numbered_files(folder, (".npz",))
    for below in sorted(path for path in folder.iterdir() if path.is_dir() and path.name.isdigit()):
        found = sorted(path for name in RESULTS for path in below.rglob(name))
        if found:
            files[frame_number(below.name, below)] = found[0]
    if not files:
        raise D2Error(f"{folder} has neither FRAME.npz nor FRAME/.../{RESULTS[0]}: export each instant of all views")
    return files


def read_prediction(path: Path, views: tuple[int, ...]) -> Predicted:
    """The arrays of one file, which must hold one of these numbers of views."""
    there = array_names(path, REMEDY)
    arrays = {name: read_array(path, REMEDY, key=name) for names in NAMES.values() for name in names if name in there}
    return understood(arrays, str(path), views)


def understood(arrays: Mapping[str, np.ndarray], where: str, views: tuple[int, ...]) -> Predicted:
    """Arrays as a network names them; `where` names their origin in errors.

    Raises:
        D2Error: no depth, another number of views, or arrays that do not fit each other.
    """
    found = {role: next((arrays[n] for n in names if n in arrays), None) for role, names in NAMES.items()}
    depth = found["depth"]
    if depth is None:
        have = ", ".join(sorted(arrays)) or "none of the names that are known"
        raise D2Error(f"{where} has no array 'depth' (it has {have}): export it as the network's own script does")
    shape = depth.shape[:-1] if depth.ndim > 3 and depth.shape[-1] == 1 else depth.shape
    count = int(np.prod(shape[:-2])) if len(shape) >= 3 else 0
    if count not in views or min(shape[-2:]) < 2:
        wanted = " or ".join(str(number) for number in views)
        raise D2Error(
            f"{where} has depth {depth.shape}, expected [V, height, width] of {wanted} views: run the network on "
            "exactly these cameras, or name those it saw in multiview.json"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # numbers beyond float32 are no depth
        maps = depth.reshape(count, *shape[-2:]).astype(np.float32)
        known = np.isfinite(maps) & (maps > 0)
    sure = np.ones_like(maps)
    for name in ("mask", "confidence"):
        if (values := found[name]) is not None:
            sure = _shaped(values, maps.shape, name, where).astype(np.float32)
            known &= np.isfinite(sure) & (sure > 0)
    poses, intrinsics = found["poses"], found["intrinsics"]
    if poses is not None:
        rows = 4 if poses.shape[-2:] == (4, 4) else 3
        poses = _shaped(poses, (count, rows, 4), "poses", where).astype(np.float64)[:, :3]
        if found["mask"] is not None:  # MapAnything has them from the camera to the world
            turned = poses[:, :, :3].transpose(0, 2, 1)
            poses = np.concatenate([turned, -turned @ poses[:, :, 3:]], axis=2)
    if intrinsics is not None:
        intrinsics = _shaped(intrinsics, (count, 3, 3), "intrinsics", where).astype(np.float64)
    maps = np.where(known, maps, np.float32(np.nan))
    return Predicted(maps, np.where(known, sure, np.float32(0)), poses, intrinsics)


def _shaped(values: np.ndarray, shape: tuple[int, ...], name: str, where: str) -> np.ndarray:
    if values.size != np.prod(shape):
        raise D2Error(f"{where} has {name} {values.shape}, expected {list(shape)} as its depth has it: {REMEDY}")
    return values.reshape(shape)
