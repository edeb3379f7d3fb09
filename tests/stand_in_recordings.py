"""Small recordings that tests write themselves, in the form of the recordings that are not part of the project."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from prior_cases import MAPS, showing
from refusals import refuses

from d2_plugin.recordings import Recording, Source, open_recording
from d2_plugin.recordings.export.n3dv import llff_row
from d2_plugin.recordings.images import write_png
from d2_plugin.recordings.synthetic.room import synthetic_recording


@dataclass(frozen=True)
class Smooth(Source):
    """Soft colours and a bright spot that moves by three pixels per frame: a video loses little of them."""

    width: int
    height: int

    def image(self, camera: str, frame: int) -> np.ndarray:
        """RGB uint8 [H, W, 3]; the colours tell cameras apart, the spot tells frames apart."""
        y, x = np.mgrid[: self.height, : self.width] / self.height
        number = sum(camera.encode()) % 7
        soft = np.stack([80 + 50 * x, 90 + 40 * y, np.full_like(x, 60 + 10 * number)], axis=-1)
        spot = np.exp(-((x * self.height - 12 - 3 * frame) ** 2 + (y * self.height - self.height / 2) ** 2) / 72)
        return np.rint(soft + 90 * spot[..., None]).astype(np.uint8)


def renamed(recording: Recording, names: tuple[str, ...], **changes: object) -> Recording:
    """The recording with other names for its cameras, and other values of `changes` in each."""
    old = dict(zip(names, recording.cameras, strict=True))
    cameras = {name: replace(recording.cameras[was], name=name, **changes) for name, was in old.items()}

    def of(kind: str) -> Callable[[str, int], np.ndarray | None]:
        return lambda name, frame: getattr(recording, kind)(old[name], frame)

    return showing(recording, {kind: of(kind) for kind in MAPS}, cameras=cameras)


def smooth_recording(names: tuple[str, ...], frames: int = 20, width: int = 96, height: int = 64) -> Recording:
    """Cameras on an arc that declare near and far, named `names`, whose images are `Smooth`."""
    rig = synthetic_recording(len(names), 0, frames, width, height, fps=24.0)
    cameras = {
        name: replace(camera, name=name, near_far=(1.5, 9.0))
        for name, camera in zip(names, rig.cameras.values(), strict=True)
    }
    return replace(rig, cameras=cameras, source=Smooth(width, height), mono_kind=None, mono_emulated=False)


def write_videos(recording: Recording, folder: Path) -> Path:
    """The recording as N3DV has it: camXX.mp4 (cam before each name) and poses_bounds.npy."""
    cv2 = pytest.importorskip("cv2")
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in recording.cameras.items():
        code = cv2.VideoWriter_fourcc(*"mp4v")
        video = cv2.VideoWriter(str(folder / f"cam{name}.mp4"), code, recording.fps, (camera.width, camera.height))
        if not video.isOpened():
            pytest.skip("this OpenCV writes no MPEG-4 video")
        for frame in recording.frames:
            video.write(recording.image(name, frame)[..., ::-1])
        video.release()
    return write_rows(recording, folder)


def write_grey(path: Path, value: int = 0, size: tuple[int, int] = (32, 24)) -> None:
    """An image of one grey value, `size` wide and high, and the folders that it lies in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.full((size[1], size[0], 3), value, np.uint8))


def write_rows(recording: Recording, folder: Path) -> Path:
    """poses_bounds.npy of cameras that declare near and far."""
    rows = [llff_row(camera, camera.near_far or (1.0, 10.0)) for camera in recording.cameras.values()]
    np.save(folder / "poses_bounds.npy", np.stack(rows))
    return folder


def refused(path: Path, pattern: str, **options: object) -> None:
    """Opening the recording in `path` is refused in one sentence that fits `pattern`."""
    refuses(pattern, open_recording, path, **options)
