"""From videos, calibrated or not, to a recording: each step is kept in its folder, so a stopped import goes on.

import/import.json    what is imported, with checksums: another import into the same folder is refused
import/clocks.json    when each camera began
import/rig.json       where the cameras stand, found from the videos where no calibration was given
calibration.json      the same for --calibration of other takes, with reprojection errors and a verdict per camera
import/poses.json     what --refine-poses found
images/CAMERA/*.png   the images, each written whole or not at all
import/exposures.json
cameras.json          last: a folder without it is no recording yet (videos.json with --images videos)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.durable import make_folder, remove_leftovers, write, write_table, write_text
from d2_plugin.locks import only_writer
from d2_plugin.progress import progress_bar
from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.calibrating import refine
from d2_plugin.recordings.cameras.calibrating.from_videos import Evidence, calibration_table, rig_of_videos, said_of
from d2_plugin.recordings.cameras.formats import CalibratedCamera
from d2_plugin.recordings.cameras.formats.cameras_json import read_entry
from d2_plugin.recordings.export.folder import described
from d2_plugin.recordings.images import opencv, write_png
from d2_plugin.recordings.importing import claimed
from d2_plugin.recordings.importing.calibrated import calibrated, watched
from d2_plugin.recordings.importing.clocks import METHODS, Clock, common_clock, given_clock
from d2_plugin.recordings.importing.exposure import measured_exposures
from d2_plugin.recordings.importing.files import VideoFile, read_video
from d2_plugin.recordings.importing.grid import Grid, grid_of
from d2_plugin.recordings.importing.settings import (
    OF_A_SOLVED_RIG,
    ImportSettings,
    check_calibration,
    check_names,
    cut_of,
)
from d2_plugin.recordings.importing.source import Cut, Upright, VideosSource
from d2_plugin.recordings.masks import VALID_FOLDER, as_image
from d2_plugin.recordings.readers.videos import KIND as VIDEOS
from d2_plugin.recordings.readers.videos import TABLE
from d2_plugin.recordings.recording import Exposure, Recording
from d2_plugin.values import checked_arguments

Told = Callable[[str], None]

JPEG_QUALITY = 95


@dataclass(frozen=True)
class Imported:
    """What an import found."""

    recording: Recording
    clocks: Mapping[str, Clock]
    folder: Path


@checked_arguments
def import_videos(settings: ImportSettings, told: Told = lambda line: None) -> Imported:
    """Import the videos, or continue an import that was stopped; a finished one is only read.

    `told` is called with a sentence after each step.

    Raises:
        D2Error: one sentence for whatever does not fit; nothing that was there is written over.
    """
    paths = claimed.paths_of(settings)
    check_names(settings, list(paths))
    folder = settings.output
    identity = claimed.identity(settings, paths)
    claimed.refuse_another(folder, identity)
    found = {name: read_video(path) for name, path in paths.items()}
    check_calibration(settings)
    solved = _solved(settings, folder, found, told) if settings.calibration is None else None
    videos, cameras, notes = calibrated(settings, found) if solved is None else (found, *_read(solved, found))
    cuts = {name: cut_of(settings, name, (camera.width, camera.height)) for name, camera in cameras.items()}
    with only_writer(make_folder(folder)):
        claimed.claim(folder, identity)
        remove_leftovers(folder)
        if solved is not None:
            claimed.kept(folder, "rig", lambda: solved)
            table = json_text(solved, "calibration.json", indent=1, sort_keys=True)  # as the one that is kept has them
            write_text(folder / "calibration.json", table + "\n")
        clocks = _clocks(settings, folder, videos, cameras)
        told(_said_of_clocks(clocks, videos))
        grid = grid_of(videos, clocks, settings.rate, settings.times, settings.frames)
        recording = _recording(folder, videos, cameras, cuts, grid, notes)
        if settings.refine_poses:
            recording = _with_refined_poses(folder, recording, told)
        recording = _images(settings, folder, recording, told)
        recording = _exposures(settings, folder, recording, told)
        _finish(settings, folder, recording)
    return Imported(recording, clocks, folder)


def _solved(settings: ImportSettings, folder: Path, found: Mapping[str, VideoFile], told: Told) -> dict[str, Any]:
    """The calibration that the videos give, now or when it was found before; nothing is written yet."""
    if (folder / claimed.STEPS / "rig.json").is_file():
        return claimed.kept(folder, "rig", dict)
    evidence = Evidence(**{name: getattr(settings, name) for name in OF_A_SOLVED_RIG})
    cameras, rig = rig_of_videos(found, evidence, settings.offsets)
    for line in said_of(rig):
        told(line)
    return calibration_table(cameras, rig)


def _read(
    solved: Mapping[str, Any], found: Mapping[str, VideoFile]
) -> tuple[dict[str, CalibratedCamera], tuple[str, ...]]:
    """(cameras by name, notes) of a calibration that was found."""
    entries = [read_entry(entry, "the solved calibration") for entry in solved["cameras"]]
    cameras = {entry.name: entry.recorded(None, "the solved calibration") for entry in entries}
    note = f"poses were found from the videos; the scale of the world is {solved['scale']}"
    return {name: cameras[name] for name in found}, (note,)


def _clocks(
    settings: ImportSettings, folder: Path, videos: Mapping[str, VideoFile], cameras: Mapping[str, CalibratedCamera]
) -> dict[str, Clock]:
    def find() -> dict[str, Any]:
        chosen = settings.offsets
        if len(chosen) == 1 and chosen[0] in METHODS:
            clocks = common_clock(videos, chosen[0], lambda: watched(videos, cameras))
        else:
            clocks = given_clock(videos, chosen)
        return {name: clock.as_dict() for name, clock in clocks.items()}

    return {name: Clock(**table) for name, table in claimed.kept(folder, "clocks", find).items()}


def _said_of_clocks(clocks: Mapping[str, Clock], videos: Mapping[str, VideoFile]) -> str:
    def one(name: str, clock: Clock) -> str:
        rate = videos[name].rate or 25.0
        error = f" +- {clock.error * rate:.2f}" if clock.error else ""
        drift = f", drifting {clock.drift * 1e6:.0f} ppm" if clock.drift else ""
        return f"{name} {clock.seconds * rate:+.2f}{error}{drift}"

    methods = sorted({clock.method for name, clock in clocks.items()})
    return f"start in frames, by {' and '.join(methods)}: {', '.join(one(*item) for item in clocks.items())}"


def _recording(
    folder: Path,
    videos: Mapping[str, VideoFile],
    cameras: Mapping[str, CalibratedCamera],
    cuts: Mapping[str, Cut],
    grid: Grid,
    notes: tuple[str, ...],
) -> Recording:
    """The recording as it is in the videos."""
    source = VideosSource(Upright(videos, grid.indices), cameras, cuts)
    pinholes = {name: cuts[name].camera(camera) for name, camera in cameras.items()}
    frames = tuple(grid.indices[next(iter(videos))])
    return Recording(
        folder.resolve().name, pinholes, frames, grid.rate, source, folder, notes=(*notes, *grid.notes), late=grid.late
    )


def _with_refined_poses(folder: Path, recording: Recording, told: Told) -> Recording:
    """The recording with the poses that its images prove to be better, or with those that were given."""

    def find() -> dict[str, Any]:
        found = refine(recording)
        poses = {name: camera.T_camera_world.tolist() for name, camera in found.cameras.items()}
        return {"accepted": found.accepted, "reason": found.reason, "poses": poses if found.accepted else {}}

    found = claimed.kept(folder, "poses", find)
    told(f"poses: {found['reason']}")
    poses = {name: np.array(pose) for name, pose in found["poses"].items()}
    source = recording.source
    if not isinstance(source, VideosSource) or not poses:
        return recording
    moved = {
        name: replace(camera, rotation=poses[name][:3, :3], translation=poses[name][:3, 3])
        for name, camera in source.cameras.items()
    }
    return replace(
        recording,
        cameras={name: replace(camera, T_camera_world=poses[name]) for name, camera in recording.cameras.items()},
        source=replace(source, cameras=moved),
        notes=(*recording.notes, found["reason"]),
    )


def _images(settings: ImportSettings, folder: Path, recording: Recording, told: Told) -> Recording:
    """Write the images that are missing; from then on they are read back, unless they stay in the videos."""
    if settings.images == "videos":
        return recording
    total = len(recording.cameras) * len(recording.frames)
    with progress_bar("write images", total) as bar:
        done = 0
        for name in recording.cameras:
            for frame in recording.frames:
                path = folder / "images" / name / f"{frame:05d}.{settings.images}"
                if not path.is_file():
                    _write_image(path, recording.image(name, frame))
                bar.update(done := done + 1, name)
    _write_masks(folder, recording)
    told(f"{total} images of {len(recording.cameras)} cameras")
    return recording


def _write_image(path: Path, image: np.ndarray) -> None:
    if path.suffix == ".png":
        write_png(path, image)
        return
    cv2 = opencv("writing images")
    _, encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    write(path, encoded.tobytes(), synced=False)


def _write_masks(folder: Path, recording: Recording) -> None:
    """valid/CAMERA.png, white where the camera recorded something, of those whose images have black margins."""
    for name in recording.cameras:
        recorded = recording.recorded(name)
        if recorded is not None:
            write_png(folder / VALID_FOLDER / f"{name}.png", as_image(recorded))


def _exposures(settings: ImportSettings, folder: Path, recording: Recording, told: Told) -> Recording:
    if not settings.exposure or len(recording.cameras) < 2:
        return recording

    def find() -> dict[str, Any]:
        found = measured_exposures(recording, list(recording.cameras))
        return {name: one._asdict() for name, one in found.items()}

    kept = claimed.kept(folder, "exposures", find)
    found = {name: Exposure(tuple(one["gain"]), tuple(one["error"])) for name, one in kept.items()}
    unknown = [name for name in recording.cameras if name not in found]
    gains = ", ".join(f"{name} {100 * (sum(one.gain) / 3 - 1):+.1f} %" for name, one in found.items())
    told(
        f"exposure: {gains or 'not known'}" + (f"; too few shared features for {', '.join(unknown)}" if unknown else "")
    )
    return replace(recording, exposures=found)


def _finish(settings: ImportSettings, folder: Path, recording: Recording) -> None:
    """The file that makes the folder a recording."""
    description = described(recording)
    if settings.images != "videos":
        write_text(folder / "cameras.json", json_text(description, "cameras.json", indent=1) + "\n")
        return
    source = recording.source
    assert isinstance(source, VideosSource)
    table = {"cameras": source.as_dict(), "recording": description}
    write_table(folder / TABLE, table, VIDEOS)
