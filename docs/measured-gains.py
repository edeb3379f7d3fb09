"""How exactly gains between cameras that stand far apart are measured: a figure of docs/your-recording.md.

    python docs/measured-gains.py RECORDING [RECORDING ...]

The images of cameras 00 02 05 07 are made brighter and darker by known gains. The error is the largest of any channel
against what the same estimate says of the untouched images, since cameras may differ themselves.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np

from d2_plugin.recordings import Source, open_recording, select_cameras
from d2_plugin.recordings.importing.exposure import measured_exposures

GAINS = {"00": (1.0, 1.0, 1.0), "02": (1.12, 1.1, 1.08), "05": (0.87, 0.9, 0.93), "07": (1.15, 0.95, 0.85)}


@dataclass(frozen=True)
class Graded:
    """The images as cameras of other exposures have them."""

    source: Source

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]."""
        bright = self.source.image(camera, frame).astype(float) * GAINS[camera]
        return np.rint(bright).clip(0, 255).astype(np.uint8)


def main(*folders: str) -> None:
    """One line per recording."""
    for folder in folders:
        recording = select_cameras(open_recording(folder), list(GAINS))
        own = measured_exposures(recording, list(GAINS))
        found = measured_exposures(replace(recording, source=Graded(recording.source)), list(GAINS))
        names = [name for name in GAINS if name in own and name in found]
        applied = np.log([GAINS[name] for name in names])
        measured = np.log([np.array(found[name].gain) / own[name].gain for name in names])
        error = np.abs(measured - measured.mean(0) - (applied - applied.mean(0))).max()
        stated = max(max(found[name].error) for name in names)
        sys.stdout.write(
            f"{recording.name}: {', '.join(names)} off by {error:.2%} at most, stated error {stated:.2%}\n"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
