"""The models in checkpoints and point clouds of other trainers, each behind its adapter.

Checkpoints of Inria's heirs hold what `GaussianModel.capture()` returns, saved as (tuple, iteration) in chkpnt*.pth. A
point cloud of Gaussians may have the network that moves them beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from d2_plugin import registry
from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import Harmonics, MovingGaussians, moving_gaussians
from d2_plugin.gaussians.spherical_harmonics import channel_count
from d2_plugin.recordings import Recording
from d2_plugin.viewing.checkpoints.files import columns, read_options, read_ply, read_state
from d2_plugin.viewing.checkpoints.networks import MotionNetwork, PlaneField

FUDAN = (
    *("active_sh_degree", "_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity"),
    *("max_radii2D", "xyz_gradient_accum", "t_gradient_accum", "denom", "optimizer", "spatial_lr_scale"),
    *("_t", "_scaling_t", "_rotation_r", "rot_4d", "env_map", "active_sh_degree_t"),
)
"""The entries of fudan, in its order."""
FOUR_C = (*FUDAN[:12], "coef_optimizer", *FUDAN[12:], "coefficient")
"""Of 4C4D: its network for the decay of opacities, which are stored decayed, with its optimizer."""
STATIC = FUDAN[:9] + FUDAN[10:13]
"""Of 3D Gaussian Splatting, and of fudan without time."""
FOUR_C_STATIC = (*STATIC[:11], "coef_optimizer", STATIC[11], "coefficient")
PLANES = (
    *("active_sh_degree", "_xyz", "deformation", "_deformation_table", *FUDAN[2:9], "denom"),
    *("optimizer", "spatial_lr_scale"),
)
"""Of 4DGaussians."""
LAYOUTS = {len(names): names for names in (FUDAN, FOUR_C, STATIC, FOUR_C_STATIC)}

CLOUD = "point_cloud.ply"
ELSEWHERE = {"dynamic_point_cloud.ply": "Ex4DGS or CEM-4DGS", "FDHash.pth": "Swift4D"}
"""Files beside a point cloud that say that it is a part of a model which is not read here."""


class Checkpoint(NamedTuple):
    """What a file holds, ready to be shown."""

    backbone: Any
    """An adapter around the Gaussians."""
    time_scale: float
    """The trainer's unit of time, per second."""
    note: str = ""
    """What a person should know, in one sentence."""
    harmonics: Harmonics | None = None
    """Colours; None where only the adapter knows them, for one direction after the other."""
    moving: MovingGaussians | None = None
    """The same Gaussians as straight lines that fade, in seconds since the first frame, where they are of that form."""


def of_tuple(stored: Sequence[Any], path: Path, recording: Recording) -> Checkpoint:
    """The Gaussians of a chkpnt*.pth.

    Raises:
        D2Error: as many entries as no trainer here saves, or none of the options that it takes.
    """
    if len(stored) == len(PLANES) and isinstance(stored[2], dict):
        values = dict(zip(PLANES, stored, strict=True))
        state = {name: value.detach().float() for name, value in values.pop("deformation").items()}
        if "coarse" in path.name:
            return _with_planes(values, None, recording)
        return _with_planes(values, PlaneField(state, read_options(path.parent / "cfg_args"), path), recording)
    names = LAYOUTS.get(len(stored))
    if names is None:
        raise D2Error(
            f"{path} has {len(stored)} entries, expected {len(FUDAN)} (fudan), {len(FOUR_C)} (4C4D), {len(PLANES)} "
            f"(4DGaussians) or {len(STATIC)} (3DGS): show another trainer's model from inside it, with Viewer(d2)"
        )
    return _with_lines(dict(zip(names, stored, strict=True)), recording, timed=names in (FUDAN, FOUR_C))


def newest_cloud(folder: Path) -> Path:
    """The point cloud of the last iteration in a trainer's output folder; a fine stage counts before a coarse one.

    Raises:
        D2Error: there is none.
    """
    known = []
    for path in (folder / "point_cloud").glob(f"*/{CLOUD}"):
        stage, _, iteration = path.parent.name.rpartition("_")
        known += [(not stage.startswith("coarse"), int(iteration), path)] if iteration.isdigit() else []
    if not known:
        raise D2Error(f"{folder / 'point_cloud'} has no iteration_N/{CLOUD}: give the folder that train.py wrote")
    return max(known)[2]


def of_cloud(path: Path, recording: Recording) -> Checkpoint:
    """The Gaussians of a PLY; what moves them is found where its trainer puts it.

    Raises:
        D2Error: no Gaussians, or a network without what belongs to it.
    """
    for name, trainer in ELSEWHERE.items():
        if (path.parent / name).exists():
            raise D2Error(
                f"{path.parent} is of {trainer}, whose motion lies in {name}, which is not read here: show it from "
                "inside its train.py with Viewer(d2)"
            )
    rows = read_ply(path)
    missing = [name for name in ("x", "opacity", "scale_0", "rot_0", "f_dc_0") if name not in rows]
    if missing:
        raise D2Error(f"{path} has no {', '.join(missing)}: it is no point cloud of Gaussians")
    output, weights = path.parent.parent.parent, path.parent / "deformation.pth"
    if "trbf_center" in rows:
        return _of_spacetime(rows, recording)
    values = _inria_values(rows)
    if "scale_t" in rows:  # 4C4D writes time beside the columns of 3DGS, and its harmonics without those of time
        values |= {"_t": rows["t"][:, None], "_scaling_t": rows["scale_t"][:, None]}
        values |= {"_rotation_r": columns(rows, "rot_r"), "rot_4d": True, "active_sh_degree_t": 0}
        return _with_lines(values, recording, timed=True)
    if weights.is_file():
        if path.parent.name.startswith("coarse"):
            return _with_planes(values, None, recording)
        field = PlaneField(read_state(weights), read_options(output / "cfg_args"), weights)
        return _with_planes(values, field, recording)
    if path.parent.parent.name == "point_cloud" and (output / "deform").is_dir():
        return _with_network(values, output / "deform" / path.parent.name / "deform.pth", recording)
    return _with_lines(values, recording, timed=False)


def _inria_values(rows: dict[str, Tensor]) -> dict[str, Any]:
    rest = columns(rows, "f_rest")  # those of a channel stand together
    rest = rest.view(len(rest), 3, -1).transpose(1, 2).contiguous()
    return {
        "_xyz": columns(rows, "xyz"),
        "_scaling": columns(rows, "scale"),
        "_rotation": columns(rows, "rot"),
        "_opacity": rows["opacity"][:, None],
        "_features_dc": columns(rows, "f_dc")[:, None],
        "_features_rest": rest,
        "active_sh_degree": round((1 + rest.shape[1]) ** 0.5) - 1,
    }


def _frozen(values: dict[str, Any]) -> SimpleNamespace:
    """The attributes of a trainer's model, without the trainer: it cannot grow or shrink."""

    def refuse(*_: Any, **__: Any) -> None:
        raise D2Error("a checkpoint that is shown cannot be edited: train it in its own codebase")

    tensors = {name: value.detach() if isinstance(value, Tensor) else value for name, value in values.items()}
    return SimpleNamespace(**tensors, densification_postfix=refuse, prune_points=refuse)


def _adapter(name: str, *arguments: Any, **options: Any) -> Any:
    adapter: Any = registry.load(registry.ADAPTERS, name)
    return adapter(*arguments, **options)


def _with_lines(values: dict[str, Any], recording: Recording, timed: bool) -> Checkpoint:
    """Gaussians by the names of fudan's model, of 4D or standing still; as straight lines too, where they are such."""
    model = _frozen(values)
    model.gaussian_dim = 4 if timed else 3
    model.time_duration = [0.0, max(recording.seconds(recording.frames[-1]), 1e-9)]
    note = "times are taken to be seconds since the first frame" if timed else "3D Gaussians stand still"
    backbone = _adapter("fudan", model)
    harmonics = _harmonics(values, int(values["active_sh_degree_t"]) if timed else 0)
    if timed and not values["rot_4d"]:  # another meaning of `_scaling_t`: sampled through the adapter
        return Checkpoint(backbone, 1.0, note, None if harmonics.time_degree else harmonics)
    raw = {"positions": values["_xyz"], "log_scales": values["_scaling"], "left": values["_rotation"]}
    raw |= {"opacity_logits": values["_opacity"].squeeze(-1)}
    if timed:
        raw |= {"times": values["_t"].squeeze(-1), "log_time_scales": values["_scaling_t"].squeeze(-1)}
        raw |= {"right": values["_rotation_r"]}
    moving = moving_gaussians(raw, harmonics)
    return Checkpoint(backbone, 1.0, note, moving.harmonics, moving)


def _with_planes(values: dict[str, Any], field: PlaneField | None, recording: Recording) -> Checkpoint:
    """Gaussians of 4DGaussians with their field; in the coarse stage there is none."""
    stage = "coarse" if field is None else "fine"
    backbone = _adapter("hust4d", _frozen(values | {"_deformation": field}), None, stage)
    if field is None:
        return Checkpoint(backbone, 1.0, "the coarse stage of 4DGaussians stands still", _harmonics(values))
    note = "a frame's time is taken to be its number / the number of frames, as the trainer reads several cameras"
    return Checkpoint(backbone, recording.fps / max(len(recording.frames), 1), note, _harmonics(values))


def _with_network(values: dict[str, Any], weights: Path, recording: Recording) -> Checkpoint:
    if not weights.is_file():
        raise D2Error(f"{weights} is not there: a point cloud of Deformable-3D-Gaussians moves by it, copy both")
    adapter = _adapter("deformable3d", _frozen(values), MotionNetwork(read_state(weights), weights), warm_up=0)
    note = "the first frame is taken to be at time 0 and the last one at 1"
    return Checkpoint(adapter, 1 / max(recording.seconds(recording.frames[-1]), 1e-9), note, _harmonics(values))


def _of_spacetime(rows: dict[str, Tensor], recording: Recording) -> Checkpoint:
    named = {"_xyz": "xyz", "_features_dc": "f_dc", "_scaling": "scale", "_rotation": "rot", "_motion": "motion"}
    values: dict[str, Any] = {name: columns(rows, column) for name, column in named.items()}
    values |= {"_omega": columns(rows, "omega"), "_opacity": rows["opacity"][:, None]}
    values |= {f"_{name}": rows[name][:, None] for name in ("trbf_center", "trbf_scale")}
    lite = values["_features_dc"].shape[1] == 3
    note = "" if lite else "colours are those before the full model's decoder, which only its own code can run"
    count = len(recording.frames)
    return Checkpoint(_adapter("spacetime", _frozen(values), count), recording.fps / count, note)


def _harmonics(values: Mapping[str, Any], time_degree: int = 0) -> Harmonics:
    """The colours of a model of Inria's heirs, up to the degree that it uses so far."""
    degree = int(values["active_sh_degree"])
    coefficients = torch.cat([values["_features_dc"], values["_features_rest"]], 1).detach()
    used = coefficients[:, : channel_count(degree, time_degree)]
    return Harmonics(used.double().cpu(), degree, time_degree)
