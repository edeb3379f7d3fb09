"""What `d2 render` and `d2 view` open: our runs, and what other trainers save as far as their adapters can read it.

| file | from | shown as |
|---|---|---|
| chkpnt*.pth with 19 entries | fudan-zvg/4d-gaussian-splatting, 4C4D | 4D Gaussians, through the adapter `fudan` |
| chkpnt*.pth with 12 entries | 3D Gaussian Splatting | one instant |
| ckpt_*.pt with "splats" | gsplat's simple_trainer | one instant |
| *.ply with trbf_center | SpacetimeGaussians; of the full model without its decoder | moving |
| *.ply | 3D Gaussian Splatting and all that write its format | one instant |

Deformable-3D-Gaussians, 4DGaussians and Ex4DGS keep their motion in networks or tables that only their own code can
read: such a folder is refused, and `Viewer(d2)` shows it inside the trainer instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.captures import Capture, open_capture
from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings
from d2_plugin.reading import parsing, read_bytes, shown_path
from d2_plugin.values import checked_arguments
from d2_plugin.viewing.look import look
from d2_plugin.viewing.paths import pose_of
from d2_plugin.viewing.subject import Subject, subject_of_run

FUDAN = (
    *("active_sh_degree", "_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity"),
    *("max_radii2D", "xyz_gradient_accum", "t_gradient_accum", "denom", "optimizer", "spatial_lr_scale"),
    *("_t", "_scaling_t", "_rotation_r", "rot_4d", "env_map", "active_sh_degree_t"),
)
"""What `GaussianModel.capture()` of fudan returns, in its order."""
STATIC = FUDAN[:9] + FUDAN[10:13]
"""What that of 3D Gaussian Splatting returns."""

MOST_PLY = 1 << 33
"""Bytes of a point cloud, at most."""

ELSEWHERE = {
    "deform": "Deformable-3D-Gaussians",
    "deformation.pth": "4DGaussians",
    "deformation_table.pth": "4DGaussians",
}
"""Files that say that the motion of a point cloud lies in a network."""


@checked_arguments
def open_subject(
    path: Path, capture: Path | None = None, train_cameras: Sequence[str] | None = None, downscale: int = 1
) -> Subject:
    """A run folder, or a checkpoint of another trainer together with its recording.

    Raises:
        D2Error: one sentence for what cannot be opened, and why.
    """
    if path.is_dir():
        _refuse_networks(path)
        if capture is not None or train_cameras or downscale != 1:
            raise D2Error(f"{path} is a folder of a run, which knows its recording: leave out what is for checkpoints")
        return subject_of_run(path)
    if not path.is_file():
        raise D2Error(f"no run at {path}: give the --output folder of `d2 train`, or a trainer's checkpoint")
    if capture is None:
        raise D2Error(f"{path.name} does not say where its cameras stood: name its recording with --capture")
    opened = open_capture(capture, downscale=downscale)
    with parsing(f"checkpoint {shown_path(path)}", "give one of the trainers that docs/see.md names"):
        backbone, time_scale, note = _loaded(path, opened)
    names = tuple(opened.cameras)
    for name in train_cameras or ():
        opened.image(name, opened.frames[0])  # an unknown name is refused there
    trained = tuple(train_cameras) if train_cameras else names
    held_out = tuple(name for name in names if name not in trained)
    found = Subject(path.stem, opened, trained, held_out, backbone, note=note)
    if not len(backbone):
        raise D2Error(f"{path} has no Gaussian: nothing can be shown")
    found = replace(found, time_scale=time_scale)
    _try(found, path)
    return found


def _try(subject: Subject, path: Path) -> None:
    """Look once at what a file of somebody else's holds, so that what does not fit together is said now."""
    view = subject.view(pose_of(next(iter(subject.capture.cameras.values()))), 0.0, (16, 16))
    with parsing(f"checkpoint {shown_path(path)}", "give one whose tensors fit together"):
        shown = look(subject.backbone, view).splats
    if not all(bool(torch.isfinite(part).all()) for part in (shown.means, shown.covariances, shown.opacities)):
        raise D2Error(f"{path} has numbers that are not finite: its training diverged, give an earlier checkpoint")


def _loaded(path: Path, capture: Capture) -> tuple[Any, float, str]:
    """The adapter around what a file holds, its time units per second, and a note."""
    if path.suffix == ".ply":
        _refuse_networks(path.parent, *path.parents[1:4])
        return _of_ply(path, capture)
    stored = _torch_file(path)
    if isinstance(stored, dict) and "splats" in stored:
        return _gsplat(stored["splats"], RasterSettings(near=0.01)), 1.0, "gsplat's Gaussians stand still"
    if isinstance(stored, (tuple, list)) and len(stored) == 2 and isinstance(stored[0], (tuple, list)):
        return _of_inria(stored[0], path, capture)
    raise D2Error(
        f"{path} is no checkpoint that can be shown: have those of fudan, 4C4D, 3D Gaussian Splatting and gsplat, and "
        "point clouds (.ply); inside another trainer, Viewer(d2) shows the model as it trains"
    )


def _torch_file(path: Path) -> Any:
    """Tensors and plain values only: a checkpoint from elsewhere runs no code."""
    # scene.cameras_extent is a number of numpy's
    scalar = np.float32(0).__reduce__()[0]
    scalars: list[Any] = [scalar, np.dtype, np.dtypes.Float32DType, np.dtypes.Float64DType]
    try:
        with torch.serialization.safe_globals(scalars):
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise D2Error(f"{path} cannot be read as a checkpoint of tensors ({said}): give the trainer's .pth") from None


def _of_inria(stored: Sequence[Any], path: Path, capture: Capture) -> tuple[Any, float, str]:
    names = {len(FUDAN): FUDAN, len(STATIC): STATIC}.get(len(stored))
    if names is None:
        raise D2Error(f"{path} has {len(stored)} entries, expected {len(FUDAN)} (fudan) or {len(STATIC)} (3DGS)")
    model = _frozen(dict(zip(names, stored, strict=True)))
    model.gaussian_dim = 4 if names is FUDAN else 3
    model.time_duration = [0.0, max(capture.seconds(capture.frames[-1]), 1e-9)]
    still = names is STATIC
    note = "3D Gaussians stand still" if still else "times are taken to be seconds since the first frame"
    adapter: Any = registry.load(registry.ADAPTERS, "fudan")
    return adapter(model), 1.0, note


def _frozen(values: dict[str, Any]) -> SimpleNamespace:
    """The attributes of a trainer's model, without the trainer: it cannot grow or shrink."""

    def refuse(*_: Any, **__: Any) -> None:
        raise D2Error("a checkpoint that is looked at cannot be edited: train it in its own codebase")

    tensors = {name: value.detach() if isinstance(value, Tensor) else value for name, value in values.items()}
    return SimpleNamespace(**tensors, densification_postfix=refuse, prune_points=refuse)


def _gsplat(parameters: dict[str, Tensor], settings: RasterSettings) -> Any:
    adapter: Any = registry.load(registry.ADAPTERS, "gsplat")
    return adapter({name: value.detach() for name, value in parameters.items()}, {}, settings=settings)


def _of_ply(path: Path, capture: Capture) -> tuple[Any, float, str]:
    rows = read_ply(path)
    missing = [name for name in ("x", "opacity", "scale_0", "rot_0", "f_dc_0") if name not in rows]
    if missing:
        raise D2Error(f"{path} has no {', '.join(missing)}: it is no point cloud of Gaussians")
    if "trbf_center" in rows:
        return _of_spacetime(rows, capture)
    harmonics = _columns(rows, "f_rest")
    sh_rest = harmonics.view(len(harmonics), 3, -1).transpose(1, 2)  # all of one channel stand together
    parameters = {
        "means": _columns(rows, "xyz"),
        "scales": _columns(rows, "scale"),
        "quats": _columns(rows, "rot"),
        "opacities": rows["opacity"],
        "sh0": _columns(rows, "f_dc")[:, None],
        "shN": sh_rest.contiguous(),
    }
    return _gsplat(parameters, RasterSettings()), 1.0, "a point cloud shows one instant"


def _of_spacetime(rows: dict[str, Tensor], capture: Capture) -> tuple[Any, float, str]:
    named = {"_xyz": "xyz", "_features_dc": "f_dc", "_scaling": "scale", "_rotation": "rot", "_motion": "motion"}
    values: dict[str, Any] = {name: _columns(rows, column) for name, column in named.items()}
    values |= {"_omega": _columns(rows, "omega"), "_opacity": rows["opacity"][:, None]}
    values |= {f"_{name}": rows[name][:, None] for name in ("trbf_center", "trbf_scale")}
    adapter: Any = registry.load(registry.ADAPTERS, "spacetime")
    lite = values["_features_dc"].shape[1] == 3
    note = "" if lite else "colours are those before the full model's decoder, which only its own code can run"
    count = len(capture.frames)
    return adapter(_frozen(values), count), capture.fps / count, note


@checked_arguments
def read_ply(path: Path) -> dict[str, Tensor]:
    """The float properties of the vertices of a binary PLY, [N] each.

    Raises:
        D2Error: no such file, or one cut short.
    """
    kinds = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
    data = read_bytes(path, "export it again", MOST_PLY)
    try:
        head, end = data.split(b"end_header\n", 1)[0].decode("ascii").splitlines(), data.index(b"end_header\n") + 11
        if head[0] != "ply" or "format binary_little_endian 1.0" not in head:
            raise ValueError("expected a binary little-endian PLY")
        count = next(int(line.split()[2]) for line in head if line.startswith("element vertex"))
        if count < 0:
            raise ValueError(f"it says {count} vertices")
        fields = [line.split()[1:] for line in head if line.startswith("property") and " list " not in line]
        table = np.frombuffer(data, np.dtype([(name, kinds[kind]) for kind, name in fields]), count, end)
    except (ValueError, KeyError, IndexError, StopIteration, UnicodeDecodeError) as error:
        raise D2Error(f"{path} is no readable point cloud ({error}): export it again") from None
    return {name: torch.from_numpy(table[name].astype(np.float32)) for name in table.dtype.names or ()}


def _columns(rows: dict[str, Tensor], name: str) -> Tensor:
    """The columns name_0, name_1, ... as [N, count]; x, y and z for xyz."""
    if name == "xyz":
        return torch.stack([rows[axis] for axis in "xyz"], 1)
    count = sum(column.startswith(f"{name}_") for column in rows)
    found = [rows[f"{name}_{i}"] for i in range(count)]
    return torch.stack(found, 1) if found else rows["x"].new_zeros(len(rows["x"]), 0)


def _refuse_networks(*folders: Path) -> None:
    for folder in folders:
        for name, trainer in ELSEWHERE.items():
            if (folder / name).exists():
                raise D2Error(
                    f"{folder} is of {trainer}, whose motion lies in a network that only its own code can run: show it "
                    "from inside its train.py with Viewer(d2)"
                )
