"""Motion of the prior against truth: flow of a rendered room, and what lies between two instants.

The room is rendered at four times the rate that the prior is built for, so the image, the depth and the scene flow at
each quarter of the way are known exactly.
"""

import tempfile
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d2_plugin.priors.between import CameraMotion, build_between
from d2_plugin.priors.build import build_priors
from d2_plugin.priors.geometry import viewing_rays
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.protocol import Label
from d2_plugin.recordings.synthetic.raycast import directions_of, first_hits
from d2_plugin.recordings.synthetic.room import SyntheticSource, synthetic_recording
from d2_plugin.runs.start import triangulated_points
from d2_plugin.store.store import QUARTERS, PriorStore

INSTANTS, RATE = 5, 12.0
"""Of the prior: how many, and how many a second: the ball goes 8 pixels from one to the next in images 320 wide."""
STILL = 0.6
"""Pixels; what goes less far stands still."""
RIGHT = 1.0
"""Pixels; a flow that is less far off is right."""


class MotionErrors(NamedTuple):
    """How motion compares with the truth, where something moves; shares are of such pixels."""

    right: float
    """Share whose flow to the next instant is right."""
    flow_error: float
    """Median error of the flow, pixels."""
    known: float
    """Share between two instants that the prior says anything of."""
    psnr: float
    """Of the colours there, dB."""
    with_depth: float
    """Share between two instants that has a depth with a finite sigma."""
    within: float
    """Share of these whose |log(D / true)| is within sigma."""
    within_two: float
    """The same within 2 sigma."""
    sigma: float
    """Their median sigma."""
    error: float
    """Their median error."""

    def __str__(self) -> str:
        return (
            f"what moves: flow right at {self.right:.1%} (median error {self.flow_error:.2f} pixels); between instants "
            f"{self.known:.1%} known, {self.psnr:.2f} dB; depth at {self.with_depth:.1%}, {self.within:.1%} within "
            f"sigma, {self.within_two:.1%} within 2 sigma, median sigma {self.sigma:.4f}, error {self.error:.4f}"
        )


def motion_errors(views: int, width: int, arc_degrees: float, settings: PriorSettings) -> MotionErrors:
    """Build the prior of a room of so many cameras, and hold its motion against the truth."""
    height = round(width * 9 / 16)
    frames = 4 * (INSTANTS - 1) + 1
    room = synthetic_recording(views, 0, frames, width, height, fps=4 * RATE, arc_degrees=arc_degrees)
    trained = replace(room, frames=room.frames[::4])
    cameras = tuple(room.cameras)
    assert isinstance(room.source, SyntheticSource)
    with tempfile.TemporaryDirectory() as folder:
        points = triangulated_points(trained, cameras).positions
        build_priors(trained, cameras, folder, settings, sparse_points=points)
        store = PriorStore.open(folder)
        build_between(store)
        flow = np.concatenate([_flow_errors(CameraMotion(store, name), room.source) for name in cameras])
        between = np.concatenate(
            [
                _between(store, room.source, name, frame, quarter)
                for name in cameras
                for frame in store.frames[:-1]
                for quarter in QUARTERS
            ],
            axis=1,
        )
    known, square, error, sigma = between
    declared = np.isfinite(sigma)
    error, sigma = error[declared], sigma[declared]
    return MotionErrors(
        (flow < RIGHT).mean(),
        np.median(flow),
        known.mean(),
        -10 * np.log10(square[known > 0].mean()),
        declared.mean(),
        (error <= sigma).mean(),
        (error <= 2 * sigma).mean(),
        np.median(sigma),
        np.median(error),
    )


def _flow_errors(motion: CameraMotion, source: SyntheticSource) -> np.ndarray:
    """Errors of the flow, pixels [K], at all pixels that move from an instant to the next."""
    errors = []
    for index, (frame, later) in enumerate(zip(motion.store.frames, motion.store.frames[1:])):
        true = _true_flow(source, motion.name, frame, later)
        moves = np.hypot(*np.moveaxis(true, -1, 0)) > STILL
        errors.append(np.linalg.norm(motion.flow(index) - true, axis=-1)[moves])
    return np.concatenate(errors)


def _between(store: PriorStore, source: SyntheticSource, name: str, frame: int, quarter: int) -> np.ndarray:
    """What is known (0, 1), squared error of its colour, error and sigma of its depth, [4, K] where something moves."""
    found = store.underway(name, frame, quarter)
    assert found is not None
    prior = found[1]
    assert prior.colors is not None
    assert prior.sigma is not None
    moves = np.hypot(*np.moveaxis(_true_flow(source, name, frame + quarter, frame + quarter + 4), -1, 0)) > STILL
    difference = (prior.colors.numpy().astype(float) - source.image(name, frame + quarter)) / 255
    depth, sigma = prior.depth.numpy(), np.where(prior.depth.numpy() > 0, prior.sigma.numpy(), np.inf)
    error = np.abs(np.log(np.where(depth > 0, depth, 1) / source.depth(name, frame + quarter)))
    known = prior.labels.numpy() != Label.CONFLICT
    return np.stack([known[moves], (difference**2).mean(-1)[moves], error[moves], sigma[moves]])


def scene_flow(source: SyntheticSource, name: str, frame: int, later: int) -> np.ndarray:
    """Exact scene flow [H, W, 3] in world units: how far what each pixel shows goes from a frame to another."""
    camera, seconds, then = source.cameras[name], frame / source.fps, later / source.fps
    directions = directions_of(camera, (0.5, 0.5))
    distance, owner = first_hits(source.scene, camera, directions, seconds)
    points = camera.centre[:, None] + distance * directions
    flow = np.zeros_like(points)
    for index, solid in enumerate(source.scene.solids):
        rays = np.flatnonzero(owner == index)
        (rotation, centre), (turned, moved) = solid.motion(seconds), solid.motion(then)
        local = rotation.T @ (points[:, rays] - centre[:, None])
        flow[:, rays] = turned @ local + moved[:, None] - points[:, rays]
    return flow.T.reshape(camera.height, camera.width, 3)


def _true_flow(source: SyntheticSource, name: str, frame: int, later: int) -> np.ndarray:
    """How far each pixel [H, W, 2] goes in the image from a frame to another."""
    camera = source.cameras[name]
    points = viewing_rays(camera, np.float64) * source.depth(name, frame)[..., None]
    moved = points + scene_flow(source, name, frame, later) @ camera.T_camera_world[:3, :3].T
    begun, ended = (part @ camera.K.T for part in (points, moved))
    flow: np.ndarray = ended[..., :2] / ended[..., 2:] - begun[..., :2] / begun[..., 2:]
    return flow
