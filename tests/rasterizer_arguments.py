"""What the rasterizers of the Inria family are called with, for a small scene."""

import torch
from splat_scenes import random_scene
from torch import Tensor

from d2_plugin.protocol import View


def inria_camera(view: View) -> dict:
    """The two matrices as the repositories make them (utils/graphics_utils.py), acting on row vectors."""
    near, far = 0.01, 100.0
    K, width, height = view.K.double(), view.width, view.height
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1] = 2 * K[0, 0] / width, 2 * K[1, 1] / height
    projection[0, 2], projection[1, 2] = 2 * K[0, 2] / width - 1, 2 * K[1, 2] / height - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = far / (far - near), -far * near / (far - near), 1
    world_view = view.T_camera_world.double().T
    return {
        "image_height": height,
        "image_width": width,
        "tanfovx": float(width / (2 * K[0, 0])),
        "tanfovy": float(height / (2 * K[1, 1])),
        "bg": torch.tensor([0.1, 0.2, 0.3]),
        "scale_modifier": 1.0,
        "viewmatrix": world_view,
        "projmatrix": world_view @ projection.T,
        "sh_degree": 3,
        "campos": world_view.inverse()[3, :3],
    }


def gaussians(count: int = 6, seed: int = 0, coefficients: int = 16) -> dict[str, Tensor]:
    """Arguments of a rasterizer, float64 leaves."""
    scene, g = random_scene(seed, count, 24, 16), torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    values = {
        "means3D": scene.means,
        "means2D": torch.zeros(count, 3, dtype=torch.float64),
        "opacities": scene.opacities[:, None],
        "shs": 0.3 * normal(count, coefficients, 3),
        "scales": torch.exp(0.3 * normal(count, 3)) * 0.15,
        "rotations": normal(count, 4),
    }
    return {name: value.clone().requires_grad_() for name, value in values.items()}


def view_24x16() -> View:
    return random_scene(0, 1, 24, 16).view
