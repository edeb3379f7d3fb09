"""What official trainers write, in small: names, shapes and places as in their repositories at the commits named.

Weights are numbers that any program can make again (`filled`). The repositories' own networks were given them once, on
the points below at time 0.3, and `DEFORMED` and `BENT` are what those returned.
"""

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


DEFORMED = {
    "plain": (
        [[-0.543764, 0.436766, 2.94327], [0.037459, 0.004838, 2.698005], [-0.449101, 1.337725, 2.289841]],
        [
            [-0.728967, 3.000457, -1.206934, 2.211166],
            [-1.133678, 2.529248, -2.311579, 3.08947],
            [-0.847255, 2.428134, -1.452236, 2.781018],
        ],
        [[-2.052929, 0.281324, -0.009913], [-1.793282, -0.602386, 0.396552], [-2.72425, -0.528372, 0.513826]],
    ),
    "is_blender": (
        [[-2.094213, -0.79133, -2.019229], [-1.490694, -0.879545, -1.021783], [-1.743634, -0.497432, -1.940479]],
        [
            [-0.996176, -1.026999, 0.189162, 5.295567],
            [-1.85109, -1.85721, -1.046852, 6.026737],
            [-1.506703, -0.463198, -0.66357, 4.174744],
        ],
        [[-0.621892, 2.199433, 0.224791], [0.061136, 2.25501, 0.096603], [-0.039021, 2.178505, 0.127017]],
    ),
}
"""Centres (or motions, 4x4), quaternions and scales that the network of Deformable-3D-Gaussians returns."""

RAW = (
    torch.linspace(-3, -2, 9).view(3, 3),
    torch.tensor([[1.0, 0.1, 0.2, 0.3], [0.5, -0.5, 0.4, 0.0], [0.2, 0.9, -0.1, 0.3]]),
    torch.tensor([[0.5], [-1.0], [2.0]]),
    torch.linspace(-1, 1, 144).view(3, 16, 3),
)
"""Log scales, quaternions, opacity logits and harmonics that went into the field of 4DGaussians with `POINTS`."""

BENT = {
    "as by default": (
        {},
        [[-0.660367, 0.032413, -0.088314], [-1.524825, 0.900558, 0.653872], [-0.220273, 1.213976, -0.854246]],
        [[-2.259947, -1.336177, -6.675432], [-1.735494, -0.769793, -6.237619], [-2.00292, -1.555503, -5.418191]],
        [
            [2.60367, 0.428917, -0.08145, 0.660606],
            [2.405681, -0.323159, -0.072876, 0.18679],
            [1.259599, 1.178043, 0.193696, 0.99217],
        ],
        [[0.5], [-1.0], [2.0]],
        [
            [-1.0, -0.986014, -0.972028, -0.370629, -0.356643, -0.342657],
            [-0.328671, -0.314685, -0.300699, 0.300699, 0.314685, 0.328671],
            [0.342657, 0.356643, 0.370629, 0.972028, 0.986014, 1.0],
        ],
    ),
    "opacity and colour too, scales not, two layers": (
        {"no_do": False, "no_dshs": False, "no_ds": True, "defor_depth": 2},
        [[0.730261, -0.207177, 0.222091], [-0.008937, 0.484171, 1.172406], [1.547674, 1.290352, -1.152745]],
        [[-3.0, -2.875, -2.75], [-2.625, -2.5, -2.375], [-2.25, -2.125, -2.0]],
        [
            [1.072952, 1.356243, 0.455275, 1.335922],
            [0.537575, 0.903878, 0.729838, 1.109258],
            [0.760669, 2.726957, -0.380186, 1.641516],
        ],
        [[1.167535], [-0.221053], [2.552386]],
        [
            [-1.605649, -0.781337, -0.781836, -1.616043, 0.408047, 0.091792],
            [-1.199105, -0.021111, 0.092255, -1.209748, 1.200374, 0.802821],
            [-0.118379, 0.652716, 0.256761, 0.425229, 1.769342, 1.605811],
        ],
    ),
}
"""Options, and what the field of 4DGaussians returns of `RAW`; of the harmonics the first and the last of 16."""
