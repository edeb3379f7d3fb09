"""A rig: where its cameras stand, how exactly that is known, how large the world is, and how it lies over another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.bundle import Bundle
from d2_plugin.recordings.cameras.calibrating.features import Features
from d2_plugin.recordings.cameras.camera import rig_width, rigid
from d2_plugin.recordings.cameras.epipolar import degrees_between
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments

ARBITRARY = "arbitrary: give the distance of two cameras, or video a board"  # of a scale that nothing says


@dataclass(frozen=True, eq=False)
class SolvedRig:
    """A rig that was solved; the first camera's axes are the world's, and the width of the rig is 1."""

    cameras: dict[str, Camera]
    pixels: dict[str, float]  # camera -> median reprojection error in pixels
    seen: dict[str, int]  # camera -> points that it sees
    doubt: dict[str, tuple[float, float]]
    """Camera -> (degrees, share of the rig's width) that two halves of the images differ by: about two standard
    deviations."""
    scale: str = ARBITRARY
    focals: dict[str, float] = field(default_factory=dict)
    """Camera -> share by which two halves of the images differ about its focal length, where that was adjusted."""

    def verdicts(self) -> dict[str, str]:
        """A sentence per camera."""
        sentences = {}
        for name, (degrees, share) in self.doubt.items():
            known = f"known to {degrees:.2g} degrees and {share:.2%} of the rig's width"
            sentences[name] = f"{self.pixels[name]:.2f} pixels over {self.seen[name]} points, {known}"
            if name in self.focals:
                length = self.cameras[name].K[0, 0]
                sentences[name] += f", focal length {length:.0f} pixels within {self.focals[name]:.1%}"
        return sentences

    @checked_arguments
    def scaled(self, one: str, other: str, distance: float) -> SolvedRig:
        """The same rig with `distance` between two of its cameras."""
        if not distance > 0 or one == other or one not in self.cameras or other not in self.cameras:
            raise D2Error(
                f"a distance of {distance:g} between {one} and {other} says no scale: name two cameras of "
                f"{', '.join(self.cameras)} and how far they stand apart, above 0"
            )
        apart = float(np.linalg.norm(self.cameras[one].centre - self.cameras[other].centre))
        return self.times(distance / apart, f"from the distance {distance:g} of {one} and {other}")

    def times(self, factor: float, why: str) -> SolvedRig:
        """The same rig, `factor` times as large; `why` says how that is known."""
        size = np.array([[1, 1, 1, factor]] * 3 + [[1, 1, 1, 1]])
        cameras = {
            name: replace(camera, T_camera_world=camera.T_camera_world * size) for name, camera in self.cameras.items()
        }
        return replace(self, cameras=cameras, scale=why)

    @classmethod
    def of(
        cls,
        bundle: Bundle,
        features: Mapping[str, Features],
        doubt: Mapping[str, tuple[float, float]],
        focals: Mapping[str, float],
        wanted: tuple[str, ...],
    ) -> SolvedRig:
        """The `wanted` cameras of a bundle, in the axes of the first one and with a width of 1."""
        errors = bundle.errors(features)
        first = np.linalg.inv(bundle.cameras[wanted[0]].T_camera_world)
        poses = {name: bundle.cameras[name].T_camera_world @ first for name in wanted}
        cameras = {name: replace(bundle.cameras[name], T_camera_world=pose) for name, pose in poses.items()}
        by_camera = {name: errors[:, bundle.tracks.names.index(name)] for name in wanted}
        rig = cls(
            cameras,
            {name: float(np.nanmedian(missed)) for name, missed in by_camera.items()},
            {name: int(np.isfinite(missed).sum()) for name, missed in by_camera.items()},
            {name: doubt[name] for name in wanted},
            focals={name: focals[name] for name in wanted if name in focals},
        )
        return rig.times(1 / rig_width(cameras.values()), ARBITRARY)


def aligned(cameras: Mapping[str, Camera], onto: Mapping[str, Camera]) -> dict[str, Camera]:
    """`cameras` in the world of `onto`: rotated by the mean of the rotations between the two, scaled by their spreads.

    Rotations settle the turn because the centres of two cameras, or of several on a line, do not.
    """
    names = [name for name in cameras if name in onto]
    between = sum(onto[name].T_camera_world[:3, :3].T @ cameras[name].T_camera_world[:3, :3] for name in names)
    left, _, right = np.linalg.svd(between)
    rotation = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    here, there = (np.stack([rig[name].centre for name in names]) for rig in (cameras, onto))
    middle, goal = here.mean(axis=0), there.mean(axis=0)
    spread = np.linalg.norm(here - middle)
    scale = float(np.linalg.norm(there - goal) / spread) if spread > 0 else 1.0
    laid = {}
    for name, camera in cameras.items():
        R = camera.T_camera_world[:3, :3] @ rotation.T
        centre = goal + scale * rotation @ (camera.centre - middle)
        laid[name] = replace(camera, T_camera_world=rigid(R, -R @ centre))
    return laid


def differences(cameras: Mapping[str, Camera], onto: Mapping[str, Camera]) -> dict[str, tuple[float, float]]:
    """Camera -> (degrees, share of the rig's width) that it differs by, once the rigs are laid over each other."""
    width = rig_width(onto.values()) or 1.0
    return {
        name: (degrees_between(one, onto[name]), float(np.linalg.norm(one.centre - onto[name].centre) / width))
        for name, one in aligned(cameras, onto).items()
    }
