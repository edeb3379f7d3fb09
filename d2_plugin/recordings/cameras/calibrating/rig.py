"""What was found out about a rig: where its cameras stand, how exactly that is known, and how large the world is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibrating.align import rig_width
from d2_plugin.recordings.cameras.calibrating.bundle import Bundle
from d2_plugin.recordings.cameras.calibrating.features import Features
from d2_plugin.recordings.recording import Camera
from d2_plugin.values import checked_arguments

ARBITRARY = "arbitrary: give the distance of two cameras, or video a board"
"""Of a scale that nothing says."""


@dataclass(frozen=True, eq=False)
class SolvedRig:
    """A rig that was found; the first camera's axes are the world's, and the width of the rig is 1."""

    cameras: dict[str, Camera]
    pixels: dict[str, float]
    """Camera -> median reprojection error in pixels."""
    seen: dict[str, int]
    """Camera -> points that it sees."""
    doubt: dict[str, tuple[float, float]]
    """Camera -> (degrees, share of the rig's width) that two halves of the images differ by: about two standard
    deviations."""
    scale: str = ARBITRARY
    focals: dict[str, float] = field(default_factory=dict)
    """Camera -> share by which two halves of the images differ about its focal length, where that was found."""

    def verdicts(self) -> dict[str, str]:
        """A sentence per camera."""
        return {name: self._verdict(name) for name in self.cameras}

    def _verdict(self, name: str) -> str:
        degrees, share = self.doubt[name]
        said = f"{self.pixels[name]:.2f} pixels over {self.seen[name]} points"
        known = f"known to {degrees:.2g} degrees and {share:.2%} of the rig's width"
        if name not in self.focals:
            return f"{said}, {known}"
        return f"{said}, {known}, focal length {self.cameras[name].K[0, 0]:.0f} pixels within {self.focals[name]:.1%}"

    @checked_arguments
    def scaled(self, one: str, other: str, distance: float) -> SolvedRig:
        """The same rig with `distance` between two of its cameras."""
        if not distance > 0 or one == other or one not in self.cameras or other not in self.cameras:
            raise D2Error(
                f"a distance of {distance:g} between {one} and {other} says no scale: name two cameras of "
                f"{', '.join(self.cameras)} and how far they stand apart, above 0"
            )
        found = float(np.linalg.norm(self.cameras[one].centre - self.cameras[other].centre))
        return self.times(distance / found, f"from the distance {distance:g} of {one} and {other}")

    def times(self, factor: float, why: str) -> SolvedRig:
        """The same rig, `factor` times as large; `why` says how that is known."""
        cameras = {}
        for name, camera in self.cameras.items():
            T = camera.T_camera_world.copy()
            T[:3, 3] *= factor
            cameras[name] = replace(camera, T_camera_world=T)
        return replace(self, cameras=cameras, scale=why)

    @classmethod
    def of(
        cls,
        found: Bundle,
        features: Mapping[str, Features],
        doubt: Mapping[str, tuple[float, float]],
        focals: Mapping[str, float],
        wanted: tuple[str, ...],
    ) -> SolvedRig:
        """The `wanted` cameras of a bundle, in the axes of the first one and with a width of 1."""
        errors = found.errors(features)
        first = np.linalg.inv(found.cameras[wanted[0]].T_camera_world)
        poses = {name: found.cameras[name].T_camera_world @ first for name in wanted}
        cameras = {name: replace(found.cameras[name], T_camera_world=pose) for name, pose in poses.items()}
        by_camera = {name: errors[:, found.tracks.names.index(name)] for name in wanted}
        rig = cls(
            cameras,
            {name: float(np.nanmedian(missed)) for name, missed in by_camera.items()},
            {name: int(np.isfinite(missed).sum()) for name, missed in by_camera.items()},
            {name: doubt[name] for name in wanted},
            focals={name: focals[name] for name in wanted if name in focals},
        )
        return rig.times(1 / rig_width(cameras), ARBITRARY)
