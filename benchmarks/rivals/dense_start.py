"""A dense multi-view start without guidance, in the way of GC-4DGS.

Li, Cao, Ruan, Saxena, Zhu and Cao, "Geometry-Consistent 4D Gaussian Splatting for Sparse-Input Dynamic View Synthesis"
(2025), and its code (liyw420/GC-4DGS): Gaussians start from the back-projected multi-view depth of the training views,
thinned at random to 250,000 points for images of 1352 x 1014, and training then sees no depth. 250,000 is 0.18 points
per pixel of an image, which is kept for other sizes. Instead of MVSFormer's depth this takes the filtered stereo that
D²'s own prior was built from, so that the input is the same; the points are spread evenly over views and over five
instants, where GC-4DGS takes the first. Left out: its ordinal, patch and multi-view depth losses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.rivals.inputs import Inputs
from d2_plugin.errors import D2Error
from d2_plugin.recordings import Recording
from d2_plugin.runs.start import TimedPoints
from d2_plugin.settings import AtLeastOne, Positive, Seed, Settings


@dataclass(frozen=True)
class DenseStartConfig(Settings):
    """Dense multi-view start (GC-4DGS)."""

    density: Positive = 0.18
    """Points per pixel of one image, over all views and instants together, as published."""
    instants: AtLeastOne = 5
    """Instants that points come from, spread over the recording."""
    seed: Seed = 0
    """Of the choice of points."""


def dense_points(inputs: Inputs, config: DenseStartConfig) -> TimedPoints:
    """The triangulated points and the chosen stereo points, each with its colour and instant.

    Raises:
        D2Error: the prior has no stereo depth at all.
    """
    recording, cameras = inputs.scene.recording, inputs.scene.train_cameras
    frames = sorted({recording.frames[round(i)] for i in np.linspace(0, len(recording.frames) - 1, config.instants)})
    sizes = [recording.cameras[name].width * recording.cameras[name].height for name in cameras]
    share = round(config.density * float(np.mean(sizes)) / (len(frames) * len(cameras)))
    rng = np.random.default_rng(config.seed)
    parts = [
        back_projected(recording, camera, frame, depth, share, rng)
        for frame in frames
        for camera in cameras
        if (depth := inputs.stereo_depth(camera, frame)) is not None
    ]
    if not sum(map(len, parts)):
        raise D2Error("stereo found no depth for a dense start: it needs cameras that see the same, and texture")
    return TimedPoints.joined([inputs.points, *parts])


def back_projected(
    recording: Recording, camera: str, frame: int, depth: np.ndarray, count: int, rng: np.random.Generator
) -> TimedPoints:
    """At most `count` random pixels of a depth map [H, W] (0 = none) as world points with the image's colours."""
    rows, columns = np.nonzero(depth)
    chosen = rng.choice(len(rows), min(count, len(rows)), replace=False)
    rows, columns = rows[chosen], columns[chosen]
    calibration = recording.cameras[camera]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    in_camera = pixels @ np.linalg.inv(calibration.K).T * depth[rows, columns, None].astype(float)
    rotation, translation = calibration.T_camera_world[:3, :3], calibration.T_camera_world[:3, 3]
    colors = recording.image(camera, frame)[rows, columns] / 255
    return TimedPoints((in_camera - translation) @ rotation, colors, np.full(len(rows), recording.seconds(frame)))
