"""Masks that leave nothing to learn from, said before work begins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from d2_plugin.errors import D2Error
from d2_plugin.recordings.recording import Recording


def empty_masks(recording: Recording, cameras: Sequence[str], frames: Sequence[int]) -> Iterator[str]:
    """Foreground masks without any foreground, among the frames looked at, a sentence for each camera.

    Raises:
        D2Error: a camera of which nothing was recorded, or a mask that cannot be read.
    """
    for name in cameras:
        recorded = recording.recorded(name)
        if recorded is not None and not recorded.any():
            raise D2Error(
                f"nothing of camera {name} was recorded, as its mask in valid/ and its lens say: correct that mask, or "
                "leave the camera out"
            )
        masks = {frame: recording.mask(name, frame) for frame in frames}
        empty = [frame for frame, mask in masks.items() if mask is not None and not mask.any()]
        if empty:
            listed = ", ".join(map(str, empty[:5])) + (", ..." if len(empty) > 5 else "")
            yield f"the foreground mask of camera {name} is empty at frame {listed}: white counts as foreground"


def check_background_weight(recording: Recording, cameras: Sequence[str], weight: float) -> None:
    """Refuse a weight that would change nothing, since there is no mask.

    Raises:
        D2Error: no training camera has a foreground mask at the first frame.
    """
    if weight < 1 and all(recording.mask(name, recording.frames[0]) is None for name in cameras):
        raise D2Error(
            f"--background-weight is {weight:g} and {recording.name} has no foreground mask: put masks at "
            "masks/CAMERA/FRAME.png, or leave the weight at 1"
        )
