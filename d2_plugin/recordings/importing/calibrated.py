"""Videos with the cameras of a calibration, which is held against the first images before anything long begins."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.progress import progress_bar
from d2_plugin.recordings.cameras.check import calibration_contradicted
from d2_plugin.recordings.cameras.formats import CalibratedCamera, Calibration, open_calibration, scaled
from d2_plugin.recordings.images import opencv
from d2_plugin.recordings.importing.decoding import Decoder
from d2_plugin.recordings.importing.files import VideoFile
from d2_plugin.recordings.importing.motion import LONG_SIDE, MOST_FRAMES
from d2_plugin.recordings.importing.profiles import Watched
from d2_plugin.recordings.importing.settings import UNITS, ImportSettings
from d2_plugin.recordings.importing.source import Cut, Upright, VideosSource, unturned
from d2_plugin.recordings.recording import Recording

WIDE = 100.0
"""A rig wider than this is in millimetres or centimetres, unless --unit says otherwise."""


def calibrated(
    settings: ImportSettings, videos: Mapping[str, VideoFile]
) -> tuple[dict[str, VideoFile], dict[str, CalibratedCamera], tuple[str, ...]]:
    """(videos turned as the calibration has them, their cameras, notes)."""
    if settings.calibration is None:
        raise D2Error("a calibration is needed here: give it with --calibration FILE")
    turned, read, notes = _oriented(settings.calibration, videos)
    said = tuple(note for note in read.notes if "scale" not in note) if settings.unit else read.notes
    cameras = scaled(read.cameras, UNITS[settings.unit]) if settings.unit else read.cameras
    _refuse_wide(cameras, settings)
    _refuse_contradiction(turned, cameras, settings)
    return turned, {camera.name: camera for camera in cameras}, (*notes, *said)


def _oriented(path: Path, videos: Mapping[str, VideoFile]) -> tuple[dict[str, VideoFile], Calibration, tuple[str, ...]]:
    """The calibration of the upright videos; of the stored ones where only those have its aspect."""
    try:
        return dict(videos), open_calibration(path, {n: v.turn.size(*v.size) for n, v in videos.items()}), ()
    except D2Error:
        if not any(video.turn.degrees % 180 for video in videos.values()):
            raise
        stored = {name: unturned(video) for name, video in videos.items()}
        with suppress(D2Error):
            read = open_calibration(path, {name: video.size for name, video in videos.items()})
            return stored, read, ("the calibration is of the images as stored: rotation flags are not followed",)
        raise


def _refuse_wide(cameras: tuple[CalibratedCamera, ...], settings: ImportSettings) -> None:
    centres = np.stack([camera.centre for camera in cameras])
    width = float(np.linalg.norm(centres[:, None] - centres, axis=-1).max())
    if settings.unit is None and width > WIDE:
        raise D2Error(
            f"{settings.calibration} puts the cameras up to {width:.0f} apart, which is no metres: say what it is with "
            "--unit mm, --unit cm or --unit m"
        )
    if len(cameras) > 1 and width == 0:
        raise D2Error(f"{settings.calibration} puts all cameras at one place: give a calibration with their poses")


def _refuse_contradiction(
    videos: Mapping[str, VideoFile], cameras: tuple[CalibratedCamera, ...], settings: ImportSettings
) -> None:
    """Hold the calibration against the first images, before anything long begins."""
    if len(videos) < 2:
        return
    indices = {name: {0: len(video.stamps) // 2} for name, video in videos.items()}
    by_name = {camera.name: camera for camera in cameras}
    cuts = {name: Cut(0, 0, camera.width, camera.height) for name, camera in by_name.items()}
    source = VideosSource(Upright(videos, indices), by_name, cuts)
    recording = Recording("videos", {name: cuts[name].camera(by_name[name]) for name in videos}, (0,), 1.0, source)
    wrong = calibration_contradicted(recording)
    if wrong:
        raise D2Error(f"{settings.calibration} does not fit the videos: {wrong}")


def watched(videos: Mapping[str, VideoFile], cameras: Mapping[str, CalibratedCamera]) -> dict[str, Watched]:
    """Small undistorted images of all cameras, from the beginning."""
    cv2 = opencv("finding motion")
    found = {}
    with progress_bar("look for motion", sum(min(len(v.stamps), MOST_FRAMES) for v in videos.values())) as bar:
        done = 0
        for name, video in videos.items():
            decoder, count = Decoder(video), min(len(video.stamps), MOST_FRAMES)
            images = []
            for index in range(count):
                images.append(decoder.grey(index, LONG_SIDE))
                bar.update(done := done + 1, name)
            decoder.close()
            height, width = images[0].shape
            small = cameras[name].of_size((width, height)) if cameras[name].width != width else cameras[name]
            if small.lens.bends:
                x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
                places = np.nan_to_num(small.lens.recorded_pixels(np.stack([x, y], -1)) - 0.5, nan=-9.0)
                images = [cv2.remap(p, places.astype(np.float32), None, cv2.INTER_LINEAR) for p in images]
            found[name] = Watched(small.pinhole(), np.stack(images), video.times[:count])
    return found
