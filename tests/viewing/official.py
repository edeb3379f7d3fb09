"""What official trainers write, in small: names, shapes and places as in their repositories at the commits named.

Weights are numbers that any program can make again (`filled`). The repositories' own networks were given them once, on
the points below at time 0.3, and `DEFORMED` and `BENT` are what those returned.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

Shapes = Mapping[str, tuple[int, ...]]

POINTS = torch.tensor([[0.1, -0.2, 0.3], [-0.7, 0.5, 1.2], [0.9, 1.4, -0.8]])
TIME = 0.3


def filled(shapes: Shapes) -> dict[str, Tensor]:
    """Weights of these names and shapes, none like the other."""
    found = {}
    for place, (name, shape) in enumerate(shapes.items()):
        count = torch.arange(torch.Size(shape).numel(), dtype=torch.float64)
        noise = ((torch.sin(12.9898 * count + 78.233 * place) * 43758.5453) % 1 - 0.5).view(shape)
        spread = (24 / (shape[-1] if len(shape) > 1 else 10)) ** 0.5
        found[name] = (1 + 0.6 * noise if "grids" in name else spread * noise).float()
    return found


def _layers(names: Mapping[str, tuple[int, int]]) -> dict[str, tuple[int, ...]]:
    """Weight and bias of linear layers (out, in)."""
    found: dict[str, tuple[int, ...]] = {}
    for name, size in names.items():
        found |= {f"{name}.weight": size, f"{name}.bias": size[:1]}
    return found


def motion_network(variant: str = "plain") -> dict[str, Tensor]:
    """`DeformNetwork.state_dict()` of Deformable-3D-Gaussians (ac42372), utils/time_utils.py; "plain" or
    "is_blender"."""
    blender = variant == "is_blender"
    seen = 93 if blender else 84
    names = {"timenet.0": (256, 13), "timenet.2": (30, 256)} if blender else {}
    names |= {f"linear.{i}": (256, {0: seen, 5: 256 + seen}.get(i, 256)) for i in range(8)}
    heads = {"gaussian_warp": (3, 256), "gaussian_rotation": (4, 256), "gaussian_scaling": (3, 256)}
    return filled(_layers(names | heads))


def plane_field(depth: int = 1) -> dict[str, Tensor]:
    """`deform_network.state_dict()` of 4DGaussians (843d5ac), scene/deformation.py: net_width 8, defor_depth `depth`,
    timenet_width 4, timenet_output 3, planes of 4 x 5 x 6 x 3 with 2 features, multires [1, 2]."""
    shapes: dict[str, tuple[int, ...]] = {"time_poc": (4,), "pos_poc": (10,), "rotation_scaling_poc": (2,)}
    shapes |= {"opacity_poc": (2,), **_layers({"timenet.0": (4, 9), "timenet.2": (3, 4)})}
    shapes["deformation_net.grid.aabb"] = (2, 3)
    for level in range(2):
        sides = [side * (level + 1) for side in (4, 5, 6)] + [3]
        pairs = [(a, b) for a in range(4) for b in range(a + 1, 4)]
        for i, (a, b) in enumerate(pairs):
            shapes[f"deformation_net.grid.grids.{level}.{i}"] = (1, 2, sides[b], sides[a])
    layers = {f"feature_out.{2 * i}": (8, 8 if i else 4) for i in range(depth)}
    for head, size in {"pos": 3, "scales": 3, "rotations": 4, "opacity": 1, "shs": 48}.items():
        layers |= {f"{head}_deform.1": (8, 8), f"{head}_deform.3": (size, 8)}
    shapes |= {f"deformation_net.{name}": size for name, size in _layers(layers).items()}
    state = filled(shapes)
    state["deformation_net.grid.aabb"] = torch.tensor([[1.5, 1.6, 1.7], [-1.1, -1.2, -1.3]])
    return state


OPTIONS = {
    "sh_degree": 3,
    "net_width": 8,
    "kplanes_config": {"grid_dimensions": 2, "resolution": [4, 5, 6, 3]},
    **dict.fromkeys(("no_dx", "no_ds", "no_dr", "no_grid", "static_mlp", "empty_voxel", "apply_rotation"), False),
    **dict.fromkeys(("no_do", "no_dshs"), True),
    "grid_pe": 0,
}
"""Those of arguments/__init__.py that are on or off, and two more."""


def options_text(**changed: Any) -> str:
    """A `cfg_args`, as str(Namespace(**vars(args))) writes it."""
    return f"Namespace({', '.join(f'{name}={value!r}' for name, value in (OPTIONS | changed).items())})"


def inria_columns(count: int, seed: int = 5) -> dict[str, Tensor]:
    """Raw Gaussians in front of the cameras by the names of a GaussianModel with sh_degree 3."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    positions = noise(count, 3) * 0.5
    positions[: len(POINTS)] = POINTS
    return {
        "_xyz": positions,
        "_features_dc": noise(count, 1, 3),
        "_features_rest": 0.1 * noise(count, 15, 3),
        "_scaling": -2 + 0.3 * noise(count, 3),
        "_rotation": noise(count, 4),
        "_opacity": 2 + noise(count, 1),
    }


def columns_of(**values: Tensor) -> dict[str, Tensor]:
    """The columns of a PLY by name: of several of one name each has its number behind it."""
    found = {}
    for name, value in values.items():
        several = {f"{name}_{i}": value[:, i] for i in range(value.shape[1])}
        found |= several if value.shape[1] > 1 else {name: value[:, 0]}
    return found


def places(positions: Tensor) -> dict[str, Tensor]:
    return {axis: positions[:, i] for i, axis in enumerate("xyz")}


def write_inria_ply(path: Path, model: Mapping[str, Tensor]) -> None:
    """As `save_ply` of Inria's heirs: normals of zero, harmonics with all of one channel together."""
    normals = {f"n{axis}": torch.zeros(len(model["_xyz"])) for axis in "xyz"}
    colors = {"f_dc": model["_features_dc"].transpose(1, 2).flatten(1)}
    colors |= {"f_rest": model["_features_rest"].transpose(1, 2).flatten(1)}
    shape = columns_of(scale=model["_scaling"], rot=model["_rotation"], opacity=model["_opacity"])
    write_ply(path, places(model["_xyz"]) | normals | columns_of(**colors) | shape)


def write_ply(path: Path, columns: Mapping[str, Tensor]) -> None:
    """Float columns as a binary PLY."""
    rows = torch.stack([value.detach() for value in columns.values()], 1).numpy().astype("<f4")
    begin = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head = [*begin, *(f"property float {name}" for name in columns), "end_header\n"]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(head).encode() + rows.tobytes())


GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "official_networks.json").read_text())
DEFORMED = GOLDEN["deformed"]
"""Centres (or motions, 4x4), quaternions and scales that the network of Deformable-3D-Gaussians returns."""

RAW = (
    torch.linspace(-3, -2, 9).view(3, 3),
    torch.tensor([[1.0, 0.1, 0.2, 0.3], [0.5, -0.5, 0.4, 0.0], [0.2, 0.9, -0.1, 0.3]]),
    torch.tensor([[0.5], [-1.0], [2.0]]),
    torch.linspace(-1, 1, 144).view(3, 16, 3),
)
"""Log scales, quaternions, opacity logits and harmonics that went into the field of 4DGaussians with `POINTS`."""

BENT = GOLDEN["bent"]
"""Options, and what the field of 4DGaussians returns of `RAW`; of the harmonics the first and the last of 16."""
