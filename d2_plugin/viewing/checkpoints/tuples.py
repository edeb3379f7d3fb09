"""What `GaussianModel.recording()` of Inria's heirs returns, saved as (tuple, iteration) in chkpnt*.pth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error
from d2_plugin.gaussians.moving import moving_gaussians
from d2_plugin.recordings import Recording
from d2_plugin.viewing.checkpoints.files import read_options
from d2_plugin.viewing.checkpoints.hexplanes import PlaneField
from d2_plugin.viewing.checkpoints.loaded import Loaded, frozen, harmonics_of, planes_model, with_adapter

FUDAN = (
    *("active_sh_degree", "_xyz", "_features_dc", "_features_rest", "_scaling", "_rotation", "_opacity"),
    *("max_radii2D", "xyz_gradient_accum", "t_gradient_accum", "denom", "optimizer", "spatial_lr_scale"),
    *("_t", "_scaling_t", "_rotation_r", "rot_4d", "env_map", "active_sh_degree_t"),
)
"""Of fudan, in its order."""
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
WITH_TIME = (FUDAN, FOUR_C)
LAYOUTS = {len(names): names for names in (FUDAN, FOUR_C, STATIC, FOUR_C_STATIC)}


def of_tuple(stored: Sequence[Any], path: Path, recording: Recording) -> Loaded:
    """The Gaussians of a checkpoint.

    Raises:
        D2Error: as many entries as no trainer here saves, or none of the options that it takes.
    """
    if len(stored) == len(PLANES) and isinstance(stored[2], dict):
        return _of_planes(dict(zip(PLANES, stored, strict=True)), path, recording)
    names = LAYOUTS.get(len(stored))
    if names is None:
        raise D2Error(
            f"{path} has {len(stored)} entries, expected {len(FUDAN)} (fudan), {len(FOUR_C)} (4C4D), {len(PLANES)} "
            f"(4DGaussians) or {len(STATIC)} (3DGS): show another trainer's model from inside it, with Viewer(d2)"
        )
    return of_values(dict(zip(names, stored, strict=True)), recording, timed=names in WITH_TIME)


def of_values(values: dict[str, Any], recording: Recording, timed: bool) -> Loaded:
    """Gaussians by the names of fudan's model, of 4D or standing still."""
    model = frozen(values)
    model.gaussian_dim = 4 if timed else 3
    model.time_duration = [0.0, max(recording.seconds(recording.frames[-1]), 1e-9)]
    note = "times are taken to be seconds since the first frame" if timed else "3D Gaussians stand still"
    loaded = Loaded(with_adapter("fudan", model), 1.0, note)
    return _with_lines(loaded, values, timed)


def _with_lines(loaded: Loaded, values: Mapping[str, Any], timed: bool) -> Loaded:
    """The same as straight lines: what a 4D Gaussian is exactly, if its rotation is one of 4D."""
    harmonics = harmonics_of(values, int(values["active_sh_degree_t"]) if timed else 0)
    raw = {"positions": values["_xyz"], "log_scales": values["_scaling"], "left": values["_rotation"]}
    raw |= {"opacity_logits": values["_opacity"].squeeze(-1)}
    if timed:
        if not values["rot_4d"]:  # another reading of `_scaling_t`: sampled through the adapter
            return loaded if harmonics.time_degree else loaded._replace(harmonics=harmonics)
        raw |= {"times": values["_t"].squeeze(-1), "log_time_scales": values["_scaling_t"].squeeze(-1)}
        raw |= {"right": values["_rotation_r"]}
    moving = moving_gaussians(raw, harmonics)
    return loaded._replace(harmonics=moving.harmonics, moving=moving)


def _of_planes(values: dict[str, Any], path: Path, recording: Recording) -> Loaded:
    """Saved in the trainer's output folder, where its options are."""
    state = {name: value.detach().float() for name, value in values.pop("deformation").items()}
    if "coarse" in path.name:
        return planes_model(values, None, "coarse", recording)
    return planes_model(values, PlaneField(state, read_options(path.parent / "cfg_args"), path), "fine", recording)
