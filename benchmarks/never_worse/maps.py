"""Recordings whose monocular maps are wrong on purpose, each with the images of the one it was made from."""

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from d2_plugin.durable import make_folder, write_text
from d2_plugin.errors import D2Error
from d2_plugin.priors.frame import Frame
from d2_plugin.priors.monocular.maps import MonoSource, mono_source
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.reading import json_text
from d2_plugin.recordings import Recording, open_recording
from d2_plugin.recordings.images import opencv

Spoiled = Literal["noise", "smooth", "constant", "other"]
"""`noise`: every pixel is random. `smooth`: random blobs, which the scene may follow by chance. `constant`: one value.
`other`: the map of another frame, half the recording away, or of another camera where there is one frame."""
SPOILED: tuple[Spoiled, ...] = get_args(Spoiled)

BLOB = 0.08
"""Standard deviation of the blobs, image widths."""
SMALLER = 4
"""Maps of noise are this many times smaller than the image, as those of networks are."""


def spoiled_recording(
    path: Path,
    cameras: Sequence[str],
    frames: Sequence[int] | None,
    kind: Spoiled,
    folder: Path,
    prior: PriorSettings,
) -> Path:
    """A copy of the recording at `path` with other maps, in `folder`; images and all else are links to it.

    Args:
        cameras, frames: those that train; no other image gets a map.
        folder: where it is made; named as the recording, since rows have that name.
        prior: names the network that predicts where the recording has no maps of its own.

    Raises:
        D2Error: there is neither a map nor a network.
    """
    made = folder / path.resolve().name
    if (made / "mono" / "mono.json").is_file():
        return made
    recording = open_recording(path, frames=frames)
    for entry in path.resolve().iterdir():
        if entry.name != "mono" and not (make_folder(made) / entry.name).exists():
            (made / entry.name).symlink_to(entry)
    source = mono_source(recording, prior, folder / "predicted")
    if source is None:
        raise D2Error(f"{recording.name} has no monocular maps: give a network")
    for camera in cameras:
        target = make_folder(made / "mono" / camera)
        for frame in recording.frames:
            map_ = _map(kind, recording, cameras, camera, frame, source)
            np.save(target / f"{frame:05d}.npy", map_.astype(np.float16))
    about = {"kind": source.kind, "emulated": recording.mono_emulated}
    write_text(made / "mono" / "mono.json", json_text(about, "mono.json"))  # last: what lacks it is made again
    if open_recording(made).mono_kind is None:
        raise D2Error(
            f"{path.name} is of layout '{recording.layout}', which reads no maps: export it to a folder first"
        )
    return made


def _map(
    kind: Spoiled, recording: Recording, cameras: Sequence[str], camera: str, frame: int, source: MonoSource
) -> np.ndarray:
    if kind == "other":
        camera, frame = _elsewhere(recording.frames, cameras, camera, frame)
        found = source.map(camera, Frame.read(recording, [camera], frame))
        if found is None:
            raise D2Error(f"camera {camera} has no monocular map of frame {frame}: add it")
        return found
    size = recording.cameras[camera].height // SMALLER, recording.cameras[camera].width // SMALLER
    if kind == "constant":
        return np.full(size, 0.5)
    random = np.random.default_rng([frame, zlib.crc32(camera.encode())])
    if kind == "noise":
        return random.uniform(0.1, 1, size)
    blobs = opencv("making blobs").GaussianBlur(random.standard_normal(size), (0, 0), BLOB * size[1])
    return 0.1 + (blobs - blobs.min()) / np.ptp(blobs)


def _elsewhere(frames: Sequence[int], cameras: Sequence[str], camera: str, frame: int) -> tuple[str, int]:
    """The image whose map is taken for this one's."""
    if len(frames) > 1:
        return camera, frames[(frames.index(frame) + len(frames) // 2) % len(frames)]
    return cameras[(cameras.index(camera) + 1) % len(cameras)], frame
