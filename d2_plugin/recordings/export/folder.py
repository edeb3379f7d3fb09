"""Any recording written out in the folder layout, from which it reads back the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.formats.cameras_json import camera_table
from d2_plugin.recordings.export.base import whole_folder
from d2_plugin.recordings.images import MASK_FOLDERS, VALID_FOLDER, write_mask, write_png
from d2_plugin.recordings.recording import Recording
from d2_plugin.values import checked_arguments


@checked_arguments
def save_recording(recording: Recording, path: Path | str) -> Path:
    """Write images, cameras, true depth and monocular maps of `recording` under `path`; returns it.

    Images are lossless PNG; maps are float32. Raises `D2Error` where `path` already holds something.
    """
    description = json_text(described(recording), "cameras.json", indent=1)
    with whole_folder(path) as folder:
        for camera in recording.cameras:
            for frame in recording.frames:
                _save_frame(recording, folder, camera, frame)
            recorded = recording.recorded(camera)
            if recorded is not None:
                write_mask(folder / VALID_FOLDER / f"{camera}.png", recorded)
        if recording.mono_kind is not None:
            declared = {"kind": recording.mono_kind, "emulated": recording.mono_emulated}
            (folder / "mono" / "mono.json").write_text(json_text(declared, "mono.json") + "\n")
        (folder / "cameras.json").write_text(description + "\n")  # last: a folder without it is no recording
    return Path(path)


def _save_frame(recording: Recording, folder: Path, camera: str, frame: int) -> None:
    def place(kind: str, suffix: str) -> Path:
        target = folder / kind / camera / f"{frame:05d}{suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    write_png(place("images", ".png"), recording.image(camera, frame))
    depth, mono = recording.depth(camera, frame), recording.mono(camera, frame)
    if depth is not None:
        np.savez_compressed(place("depth", ".npz"), depth=depth.astype(np.float32))
    if mono is not None:
        np.save(place("mono", ".npy"), mono.astype(np.float32))
    mask = recording.mask(camera, frame)
    if mask is not None:
        write_mask(place(MASK_FOLDERS[0], ".png"), mask)


def described(recording: Recording) -> dict[str, Any]:
    """What cameras.json says of a recording."""
    bounds = {name: list(camera.near_far) for name, camera in recording.cameras.items() if camera.near_far is not None}
    exposures = {name: one._asdict() for name, one in recording.exposures.items() if name in recording.cameras}
    late = {
        name: {str(k): v for k, v in one.items()} for name, one in recording.late.items() if name in recording.cameras
    }
    return {
        **({"exposures": exposures} if exposures else {}),
        **({"late": late} if late else {}),
        "convention": "OpenCV axes, x_cam = R X + t, pixel centres at +0.5",
        "source": recording.name,
        "notes": list(recording.notes),
        "fps": recording.fps,
        "bounds": bounds,
        "cameras": [camera_table(camera) for camera in recording.cameras.values()],
    }
