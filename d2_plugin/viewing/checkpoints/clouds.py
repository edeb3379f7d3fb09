"""Point clouds of Gaussians, with the network that moves them where one lies beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from d2_plugin.errors import D2Error
from d2_plugin.protocol import RasterSettings
from d2_plugin.recordings import Recording
from d2_plugin.viewing.checkpoints.files import columns, read_options, read_ply, read_state
from d2_plugin.viewing.checkpoints.hexplanes import PlaneField
from d2_plugin.viewing.checkpoints.loaded import Loaded, frozen, gsplat_model, harmonics_of, planes_model, with_adapter
from d2_plugin.viewing.checkpoints.networks import MotionNetwork
from d2_plugin.viewing.checkpoints.tuples import of_values

CLOUD = "point_cloud.ply"
ELSEWHERE = {"dynamic_point_cloud.ply": "Ex4DGS or CEM-4DGS", "FDHash.pth": "Swift4D"}
"""Files beside a point cloud that say that it is a part of a model which is not read here."""


def newest_cloud(folder: Path) -> Path:
    """The point cloud of the last iteration in a trainer's output folder; a fine stage counts before a coarse one.

    Raises:
        D2Error: there is none.
    """
    found = []
    for path in (folder / "point_cloud").glob(f"*/{CLOUD}"):
        stage, _, iteration = path.parent.name.rpartition("_")
        if iteration.isdigit():
            found.append((not stage.startswith("coarse"), int(iteration), path))
    if not found:
        raise D2Error(f"{folder / 'point_cloud'} has no iteration_N/{CLOUD}: give the folder that train.py wrote")
    return max(found)[2]


def of_cloud(path: Path, recording: Recording) -> Loaded:
    """The Gaussians of a PLY; what moves them is found where its trainer puts it.

    Raises:
        D2Error: no Gaussians, or a network without what belongs to it.
    """
    _refuse_parts(path.parent)
    rows = read_ply(path)
    missing = [name for name in ("x", "opacity", "scale_0", "rot_0", "f_dc_0") if name not in rows]
    if missing:
        raise D2Error(f"{path} has no {', '.join(missing)}: it is no point cloud of Gaussians")
    if "trbf_center" in rows:
        return _of_spacetime(rows, recording)
    if "scale_t" in rows:
        return _of_4c4d(rows, recording)
    if (path.parent / "deformation.pth").is_file():
        return _of_planes(rows, path, recording)
    output = path.parent.parent.parent
    if path.parent.parent.name == "point_cloud" and (output / "deform").is_dir():
        return _of_network(rows, output / "deform" / path.parent.name / "deform.pth", recording)
    return _of_one_instant(rows)


def _refuse_parts(folder: Path) -> None:
    for name, trainer in ELSEWHERE.items():
        if (folder / name).exists():
            raise D2Error(
                f"{folder} is of {trainer}, whose motion lies in {name}, which is not read here: show it from inside "
                "its train.py with Viewer(d2)"
            )


def _harmonics(rows: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """The constant [N, 1, 3] and the other [N, C - 1, 3] coefficients; in a PLY those of a channel stand together."""
    rest = columns(rows, "f_rest")
    return columns(rows, "f_dc")[:, None], rest.view(len(rest), 3, -1).transpose(1, 2).contiguous()


def _of_one_instant(rows: dict[str, Tensor]) -> Loaded:
    constant, rest = _harmonics(rows)
    parameters = {
        "means": columns(rows, "xyz"),
        "scales": columns(rows, "scale"),
        "quats": columns(rows, "rot"),
        "opacities": rows["opacity"],
        "sh0": constant,
        "shN": rest,
    }
    return gsplat_model(parameters, RasterSettings(), "a point cloud shows one instant")


def _inria_values(rows: dict[str, Tensor]) -> dict[str, Any]:
    constant, rest = _harmonics(rows)
    return {
        "_xyz": columns(rows, "xyz"),
        "_scaling": columns(rows, "scale"),
        "_rotation": columns(rows, "rot"),
        "_opacity": rows["opacity"][:, None],
        "_features_dc": constant,
        "_features_rest": rest,
        "active_sh_degree": round((1 + rest.shape[1]) ** 0.5) - 1,
    }


def _of_4c4d(rows: dict[str, Tensor], recording: Recording) -> Loaded:
    """4C4D writes time beside the columns of 3D Gaussian Splatting, and its harmonics without those of time."""
    values = _inria_values(rows) | {"_t": rows["t"][:, None], "_scaling_t": rows["scale_t"][:, None]}
    values |= {"_rotation_r": columns(rows, "rot_r"), "rot_4d": True, "active_sh_degree_t": 0}
    return of_values(values, recording, timed=True)


def _of_planes(rows: dict[str, Tensor], path: Path, recording: Recording) -> Loaded:
    values = _inria_values(rows)
    if path.parent.name.startswith("coarse"):
        return planes_model(values, None, "coarse", recording)
    weights = path.parent / "deformation.pth"
    options = read_options(path.parent.parent.parent / "cfg_args")
    return planes_model(values, PlaneField(read_state(weights), options, weights), "fine", recording)


def _of_network(rows: dict[str, Tensor], weights: Path, recording: Recording) -> Loaded:
    if not weights.is_file():
        raise D2Error(f"{weights} is not there: a point cloud of Deformable-3D-Gaussians moves by it, copy both")
    values = _inria_values(rows)
    adapter = with_adapter("deformable3d", frozen(values), MotionNetwork(read_state(weights), weights), warm_up=0)
    note = "the first frame is taken to be at time 0 and the last one at 1"
    return Loaded(adapter, 1 / max(recording.seconds(recording.frames[-1]), 1e-9), note, harmonics_of(values))


def _of_spacetime(rows: dict[str, Tensor], recording: Recording) -> Loaded:
    named = {"_xyz": "xyz", "_features_dc": "f_dc", "_scaling": "scale", "_rotation": "rot", "_motion": "motion"}
    values: dict[str, Any] = {name: columns(rows, column) for name, column in named.items()}
    values |= {"_omega": columns(rows, "omega"), "_opacity": rows["opacity"][:, None]}
    values |= {f"_{name}": rows[name][:, None] for name in ("trbf_center", "trbf_scale")}
    lite = values["_features_dc"].shape[1] == 3
    note = "" if lite else "colours are those before the full model's decoder, which only its own code can run"
    count = len(recording.frames)
    return Loaded(with_adapter("spacetime", frozen(values), count), recording.fps / count, note)
