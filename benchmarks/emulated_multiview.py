"""What a multi-view network might say of one instant, EMULATED from true depth: figures that rest on it are called so.

Exact depth in one common scale, bent slowly as a function of the place in the world (so all views share the bend),
bent a little more by each view for itself, with soft edges, a sky that is invented at a finite depth, and a confidence
of an arbitrary unit that falls where the map is wrong. The arrays are named as Depth Anything 3 exports them.
"""

import math
from collections.abc import Sequence

import numpy as np

from d2_plugin.priors.geometry import scaled_camera, viewing_rays
from d2_plugin.recordings.cameras.rotations import rotation_of_vector
from d2_plugin.recordings.recording import Camera
from d2_plugin.recordings.synthetic.room import EDGE_BLUR, blurred, smooth_field

SHARED_BEND, OWN_BEND = 0.03, 0.012
"""Standard deviations of log depth: of what all views share, and of what each view has of its own."""
SKY = 1.3
"""Where the invented sky stands, in units of the farthest depth of the view."""
SCALES = (0.2, 5.0)
"""Of an instant without given poses: its common scale, drawn evenly in its logarithm."""
POSE_NOISE = 0.01
"""Of predicted poses: relative to the span of the cameras, and in radians."""


def emulated_multiview(
    depths: Sequence[np.ndarray], cameras: Sequence[Camera], seed: int, posed: bool = True, shrink: int = 2
) -> dict[str, np.ndarray]:
    """The arrays depth, conf [V, h, w], extrinsics [V, 3, 4] and intrinsics [V, 3, 3] of one instant.

    Args:
        depths: true planar z [H, W] per view, 0 in the sky; NaN where nobody knows it: there confidence is 0.
        seed: the bends depend on it, and on nothing of the instant but its surfaces.
        posed: poses were given to the network and scale follows them; else both are its own, up to a similarity.
        shrink: how many times smaller than the images the maps are.
    """
    draw, own = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    far = max(float(np.nanmax(depth)) for depth in depths)
    waves, phases = draw.normal(0, 4 / far, (8, 3)), draw.uniform(0, 2 * math.pi, 8)
    maps, sure = [], []
    for depth, camera in zip(depths, cameras):
        known, sky = np.isfinite(depth), depth == 0
        solid = np.where(sky | ~known, SKY * np.nanmax(depth), depth).astype(np.float64)
        known = blurred(known.astype(np.float64), EDGE_BLUR * camera.width) > 0.99
        seen = viewing_rays(camera, np.float64) * solid[..., None]
        world = (seen - camera.T_camera_world[:3, 3]) @ camera.T_camera_world[:3, :3]
        bend = SHARED_BEND * np.cos(world @ waves.T + phases).sum(-1) / 2
        bend = bend + OWN_BEND * smooth_field(own, depth.shape)
        soft = 1 / blurred(1 / solid, EDGE_BLUR * camera.width)
        wrong = np.abs(np.log(soft / solid)) + 0.5 * np.abs(bend) + 0.01 + 0.3 * sky
        trust = 1 + 0.05 / wrong * np.exp(0.3 * own.normal(size=depth.shape))
        maps.append((soft * np.exp(bend))[shrink // 2 :: shrink, shrink // 2 :: shrink])
        sure.append(np.where(known, trust, 0)[shrink // 2 :: shrink, shrink // 2 :: shrink])
    poses = np.stack([np.asarray(camera.T_camera_world, float) for camera in cameras])
    scale = 1.0
    if not posed:
        scale = float(np.exp(own.uniform(*np.log(SCALES))))
        poses = _in_own_frame(poses, scale, own)
    shrunk = [scaled_camera(camera, *map_.shape[::-1]) for camera, map_ in zip(cameras, maps)]
    return {
        "depth": (scale * np.stack(maps)).astype(np.float32),
        "conf": np.round(np.stack(sure), 2).astype(np.float32),
        "extrinsics": poses[:, :3].astype(np.float32),
        "intrinsics": np.stack([camera.K for camera in shrunk]).astype(np.float32),
    }


def _in_own_frame(poses: np.ndarray, scale: float, own: np.random.Generator) -> np.ndarray:
    """World-to-camera poses [V, 4, 4] in a world that is turned, moved, scaled, and a little wrong."""
    turn, place = rotation_of_vector(own.normal(0, 1, 3)), own.normal(0, 10, 3)
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    span = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    result = poses.copy()
    for pose, centre in zip(result, centres):
        pose[:3, :3] = rotation_of_vector(own.normal(0, POSE_NOISE, 3)) @ pose[:3, :3] @ turn.T
        moved = scale * (turn @ (centre + own.normal(0, POSE_NOISE * span, 3)) + place)
        pose[:3, 3] = -pose[:3, :3] @ moved
    return result
