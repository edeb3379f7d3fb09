"""The cameras of a calibration that is given, checked against the first images before anything long begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from d2_plugin.errors import D2Error
from d2_plugin.recordings.cameras.calibration import Calibration, open_calibration
from d2_plugin.recordings.cameras.camera import CalibratedCamera, rig_width, scaled
from d2_plugin.recordings.cameras.check import calibration_contradicted
from d2_plugin.recordings.importing.settings import UNITS, ImportSettings
from d2_plugin.recordings.importing.source import Cut, VideosSource
from d2_plugin.recordings.importing.video import VideoFile
from d2_plugin.recordings.recording import Recording

WIDE = 100.0
"""A rig wider than this is in millimetres or centimetres, unless --unit says otherwise."""


def known_rig(
    settings: ImportSettings, calibration: Path, videos: Mapping[str, VideoFile]
) -> tuple[dict[str, VideoFile], dict[str, CalibratedCamera], tuple[str, ...]]:
    """(videos turned as the calibration has them, their cameras, notes).

    Raises:
        D2Error: a calibration of another rig or in another unit than it seems.
    """
    turned, read, notes = _oriented(calibration, videos)
    more = tuple(note for note in read.notes if "scale" not in note) if settings.unit else read.notes
    cameras = scaled(read.cameras, UNITS[settings.unit]) if settings.unit else read.cameras
    width = rig_width(cameras)
    if settings.unit is None and width > WIDE:
        raise D2Error(
            f"{calibration} puts the cameras up to {width:.0f} apart, which is no metres: say what it is with "
            "--unit mm, --unit cm or --unit m"
        )
    if len(cameras) > 1 and width == 0:
        raise D2Error(f"{calibration} puts all cameras at one place: give a calibration with their poses")
    wrong = _contradiction(turned, cameras) if len(cameras) > 1 else ""
    if wrong:
        raise D2Error(f"{calibration} does not fit the videos: {wrong}")
    return turned, {camera.name: camera for camera in cameras}, (*notes, *more)


def _oriented(path: Path, videos: Mapping[str, VideoFile]) -> tuple[dict[str, VideoFile], Calibration, tuple[str, ...]]:
    """The calibration of the upright videos; of the stored ones where only those have its aspect."""
    try:
        return dict(videos), open_calibration(path, {name: video.size for name, video in videos.items()}), ()
    except D2Error:
        if not any(video.turn % 180 for video in videos.values()):
            raise
        stored = {name: replace(video, turn=0) for name, video in videos.items()}
        with suppress(D2Error):
            read = open_calibration(path, {name: video.size for name, video in stored.items()})
            return stored, read, ("the calibration is of the images as stored: rotation flags are not followed",)
        raise


def _contradiction(videos: Mapping[str, VideoFile], cameras: Sequence[CalibratedCamera]) -> str:
    """What the images in the middle of the videos say against the calibration, or nothing."""
    indices = {name: {0: len(video.stamps) // 2} for name, video in videos.items()}
    cuts = {camera.name: Cut(0, 0, *camera.size) for camera in cameras}
    source = VideosSource(videos, indices, {camera.name: camera for camera in cameras}, cuts)
    return calibration_contradicted(Recording("videos", source.pinholes(), (0,), 1.0, source))
