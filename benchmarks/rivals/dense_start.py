"""A dense multi-view start without guidance, in the way of GC-4DGS.

Li, Cao, Ruan, Saxena, Zhu and Cao, "Geometry-Consistent 4D Gaussian Splatting for Sparse-Input Dynamic View Synthesis"
(2025), and its code (liyw420/GC-4DGS): Gaussians start from the back-projected multi-view depth of the training views,
thinned at random to 250,000 points for images of 1352 x 1014, and training then sees no depth. 250,000 is 0.18 points
per pixel of an image, which is kept for other sizes. Instead of MVSFormer's depth this takes the filtered stereo that
D²'s own prior was built from, so that the input is the same; the points are spread evenly over views and over five
instants, where GC-4DGS takes the first. Left out: its ordinal, patch and multi-view depth losses.

`feed_forward_points` starts from what a feed-forward network of all views might give (NoPo4D), EMULATED from true
depth by `benchmarks/emulated_multiview`: every pixel has a depth, bent slowly, soft at edges, invented in the sky.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.emulated_multiview import emulated_multiview
from benchmarks.rivals.inputs import Inputs
from d2_plugin.errors import D2Error
from d2_plugin.priors.geometry import viewing_rays
from d2_plugin.recordings import Recording
from d2_plugin.runs.start import TimedPoints
from d2_plugin.settings import AtLeastOne, Positive, Settings


@dataclass(frozen=True)
class DenseStartConfig(Settings):
    """Dense multi-view start (GC-4DGS)."""

    density: Positive = 0.18
    """Points per pixel of one image, over all views and instants together, as published."""
    instants: AtLeastOne = 5
    """Instants that points come from, spread over the recording."""


def dense_points(inputs: Inputs, config: DenseStartConfig) -> TimedPoints:
    """The triangulated points and the chosen stereo points, each with its colour and instant.

    Raises:
        D2Error: the prior has no stereo depth at all.
    """
    frames = inputs.scene.recording.frames
    chosen = sorted({frames[round(i)] for i in np.linspace(0, len(frames) - 1, config.instants)})
    depths = {
        (camera, frame): inputs.stereo_depth(camera, frame) for frame in chosen for camera in inputs.scene.train_cameras
    }
    return _started(
        inputs, config, depths, "stereo found no depth for a dense start: it needs cameras that see the same"
    )


def feed_forward_points(inputs: Inputs, config: DenseStartConfig) -> TimedPoints:
    """The triangulated points and points of emulated depth of all views, at as many instants as have true depth.

    Raises:
        D2Error: the recording has no true depth.
    """
    recording, names = inputs.scene.recording, inputs.scene.train_cameras
    cameras, depths = [recording.cameras[name] for name in names], dict[tuple[str, int], np.ndarray | None]()
    for frame in recording.frames:
        true = [depth for name in names if (depth := recording.depth(name, frame)) is not None]
        if len(true) == len(names):
            maps = emulated_multiview(true, cameras, seed=frame, shrink=1)["depth"]
            depths |= {(name, frame): map_ for name, map_ in zip(names, maps)}
    return _started(inputs, config, depths, "the recording has no true depth to emulate a network from")


def _started(
    inputs: Inputs, config: DenseStartConfig, depths: Mapping[tuple[str, int], np.ndarray | None], refusal: str
) -> TimedPoints:
    """The triangulated points and `density` points of the maps [H, W] (0 = none) by camera and frame."""
    recording = inputs.scene.recording
    sizes = [recording.cameras[name].width * recording.cameras[name].height for name in inputs.scene.train_cameras]
    share = round(config.density * float(np.mean(sizes)) / max(len(depths), 1))
    rng = np.random.default_rng(0)
    parts = [
        back_projected(recording, camera, frame, depth, share, rng)
        for (camera, frame), depth in depths.items()
        if depth is not None
    ]
    if not sum(map(len, parts)):
        raise D2Error(refusal)
    return TimedPoints.joined([inputs.points, *parts])


def back_projected(
    recording: Recording, camera: str, frame: int, depth: np.ndarray, count: int, rng: np.random.Generator
) -> TimedPoints:
    """At most `count` random pixels of a depth map [H, W] (0 = none) as world points with the image's colours."""
    rows, columns = np.nonzero(depth)
    chosen = rng.choice(len(rows), min(count, len(rows)), replace=False)
    rows, columns = rows[chosen], columns[chosen]
    calibration = recording.cameras[camera]
    in_camera = (viewing_rays(calibration, np.float64) * depth[..., None])[rows, columns]
    rotation, translation = calibration.T_camera_world[:3, :3], calibration.T_camera_world[:3, 3]
    colors = recording.image(camera, frame)[rows, columns] / 255
    return TimedPoints((in_camera - translation) @ rotation, colors, np.full(len(rows), recording.seconds(frame)))
