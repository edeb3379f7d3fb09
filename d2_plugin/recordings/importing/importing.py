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

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from d2_plugin.durable import make_folder, remove_leftovers, write, write_table, write_text
from d2_plugin.errors import D2Error, MissingExtra
from d2_plugin.locks import only_writer
from d2_plugin.progress import progress_bar
from d2_plugin.reading import json_text
from d2_plugin.recordings.cameras.calibrating.refine import Turn, check_poses, refine, turns_in_words
from d2_plugin.recordings.cameras.calibration import LARGE_RIG, Calibration, open_calibration
from d2_plugin.recordings.cameras.camera import CalibratedCamera, rig_width, scaled
from d2_plugin.recordings.cameras.check import calibration_contradicted
from d2_plugin.recordings.cameras.formats.cameras_json import read_camera
from d2_plugin.recordings.export.folder import described
from d2_plugin.recordings.images import VALID_FOLDER, encode_jpeg, write_mask, write_png
from d2_plugin.recordings.importing.clocks import METHODS, STAMPS, Clock, common_clock, given_clock
from d2_plugin.recordings.importing.exposure import measured_exposures
from d2_plugin.recordings.importing.grid import grid_of
from d2_plugin.recordings.importing.motion import watched_videos
from d2_plugin.recordings.importing.settings import UNITS, ImportSettings, check_calibration
from d2_plugin.recordings.importing.solved_rig import calibration_table, rig_of_videos, summary
from d2_plugin.recordings.importing.source import Cut, VideosSource, cuts_of
from d2_plugin.recordings.importing.steady import DRIFT, steadiness
from d2_plugin.recordings.importing.steps import SOLVED, STEPS, identity, kept, paths_of, refuse_another
from d2_plugin.recordings.importing.video import VideoFile, decoded_alone, read_video
from d2_plugin.recordings.readers.videos import KIND as VIDEOS
from d2_plugin.recordings.readers.videos import TABLE
from d2_plugin.recordings.recording import Exposure, Recording
from d2_plugin.values import checked_arguments, counted

Report = Callable[[str], None]  # called with a sentence after each step

JPEG_QUALITY = 95

SAME_POSE = 1e-6  # difference of two poses, in widths of the rig, that is rounding


@checked_arguments
def import_videos(settings: ImportSettings, report: Report = lambda line: None) -> tuple[Recording, dict[str, Clock]]:
    """(the recording, when each camera started) of an import, or of one that was stopped and goes on.

    A finished one is only read.

    Raises:
        D2Error: one sentence for whatever does not fit; nothing that was there is written over.
    """
    paths, folder = paths_of(settings), settings.output
    own = identity(settings, paths)
    refuse_another(folder, own)
    videos = {name: read_video(path) for name, path in paths.items()}
    check_calibration(settings)
    solved, doubt = None, ""
    if settings.calibration is not None:
        videos, cameras, notes, doubt = _known_rig(settings, settings.calibration, videos)
    else:
        solved = _solved(settings, folder, videos, report)
        cameras = {entry["name"]: read_camera(entry, "the solved calibration") for entry in solved["cameras"]}
        notes = (f"poses were found from the videos; the scale of the world is {solved['scale']}",)
    cuts = cuts_of(settings, {name: camera.size for name, camera in cameras.items()})
    with only_writer(make_folder(folder)):
        refuse_another(folder, own)
        kept(folder, "import", lambda: own)
        remove_leftovers(folder)
        if solved is not None:
            kept(folder, "rig", lambda: solved)
            table = json_text(solved, SOLVED, indent=1, sort_keys=True)  # as the one that is kept has them
            write_text(folder / SOLVED, table + "\n")
        clocks = _clocks(settings, folder, videos, cameras)
        report(_clocks_in_words(clocks, videos))
        guessed = {f"the cameras' clocks are {one.method}" for one in clocks.values() if one.method.startswith(STAMPS)}
        grid = grid_of(videos, clocks, settings.rate, settings.times, settings.frames)
        source = VideosSource(videos, grid.indices, cameras, cuts)
        frames, notes = tuple(grid.indices[next(iter(videos))]), (*notes, *guessed, *grid.notes)
        recording = Recording(
            folder.resolve().name, source.pinholes(), frames, grid.rate, source, folder, notes=notes, late=grid.late
        )
        few = source.checked(recording)
        recording = replace(recording, notes=(*notes, *_notes_of_videos(settings, videos, few)))
        if settings.refine_poses:
            recording = _with_refined_poses(folder, recording, report, doubt)
        elif solved is None and len(cameras) > 1:
            recording = _with_checked_poses(recording, few, report)
        if settings.images != "videos":
            _write_images(folder, recording, settings.images, report)
        if settings.exposure and len(recording.cameras) > 1:
            poses = {name: camera.T_camera_world for name, camera in recording.cameras.items()}
            placed = {name: replace(camera, T_camera_world=poses[name]) for name, camera in few.cameras.items()}
            exposures = _exposures(folder, replace(few, cameras=placed), report)
            recording = replace(recording, exposures=exposures)
        description = described(recording)  # last: without this file the folder is no recording
        if isinstance(recording.source, VideosSource) and settings.images == "videos":
            write_table(folder / TABLE, {"cameras": recording.source.as_dict(), "recording": description}, VIDEOS)
        else:
            write_text(folder / "cameras.json", json_text(description, "cameras.json", indent=1) + "\n")
    return recording, clocks


def _known_rig(
    settings: ImportSettings, calibration: Path, videos: Mapping[str, VideoFile]
) -> tuple[dict[str, VideoFile], dict[str, CalibratedCamera], tuple[str, ...], str]:
    """(videos turned as the calibration has them, their cameras, notes, what refined poses must mend).

    Raises:
        D2Error: a calibration of another rig or in another unit than it seems.
    """
    turned, read, notes = _oriented(calibration, videos)
    more = tuple(note for note in read.notes if "scale" not in note) if settings.unit else read.notes
    cameras = scaled(read.cameras, UNITS[settings.unit]) if settings.unit else read.cameras
    width = rig_width(cameras)
    if settings.unit is None and width > LARGE_RIG:
        raise D2Error(
            f"{calibration} puts the cameras up to {width:.0f} apart, which is no metres: say what it is with "
            "--unit mm, --unit cm or --unit m"
        )
    if len(cameras) > 1 and width == 0:
        raise D2Error(f"{calibration} puts all cameras at one place: give a calibration with their poses")
    for one, other in combinations(cameras, 2):
        if np.allclose(one.T_camera_world, other.T_camera_world, atol=SAME_POSE * width):
            raise D2Error(
                f"{calibration} gives cameras {one.name} and {other.name} the identical pose: correct one, or leave "
                "its video out"
            )
    wrong, mends, said = _contradiction(turned, cameras) if len(cameras) > 1 else (False, False, "")
    doubt = ""
    if wrong and not settings.accept_calibration:
        doubt = f"{calibration} does not fit the videos: {'; '.join((*more, said))}; or give --accept-calibration"
        if not (mends and settings.refine_poses):
            raise D2Error(doubt)
    elif said:
        more = (*more, said)
    return turned, {camera.name: camera for camera in cameras}, (*notes, *more), doubt


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


def _contradiction(videos: Mapping[str, VideoFile], cameras: Sequence[CalibratedCamera]) -> tuple[bool, bool, str]:
    """What an image near the middle of each video says against the calibration, see `calibration_contradicted`.

    Between the two whether turning back fewer than half of the cameras mends it; it says which, then.
    """
    indices = {name: {0: decoded_alone(video, len(video.stamps) // 2)} for name, video in videos.items()}
    cuts = {camera.name: Cut(0, 0, *camera.size) for camera in cameras}
    source = VideosSource(videos, indices, {camera.name: camera for camera in cameras}, cuts)
    recording = Recording("videos", source.pinholes(), (0,), 1.0, source)
    wrong, said = calibration_contradicted(recording)
    turns: dict[str, Turn] = {}
    if wrong and "swapped" not in said:
        with suppress(MissingExtra):
            turns = {name: turn for name, turn in check_poses(recording).items() if turn.wrong}
    mends = 0 < 2 * len(turns) < len(cameras)
    return wrong, mends, "; ".join(turns_in_words(turns, turns)) if mends else said


def _solved(settings: ImportSettings, folder: Path, videos: Mapping[str, VideoFile], report: Report) -> dict[str, Any]:
    """The calibration that the videos give, now or in the import that is continued; nothing is written yet."""
    if (folder / STEPS / "rig.json").is_file():
        return kept(folder, "rig", dict)
    cameras, rig = rig_of_videos(videos, settings)
    for line in summary(rig):
        report(line)
    return calibration_table(cameras, rig)


def _clocks(
    settings: ImportSettings, folder: Path, videos: Mapping[str, VideoFile], cameras: Mapping[str, CalibratedCamera]
) -> dict[str, Clock]:
    def make() -> dict[str, Any]:
        chosen = settings.offsets
        if len(chosen) == 1 and chosen[0] in METHODS:
            clocks = common_clock(videos, chosen[0], lambda: watched_videos(videos, cameras))
        else:
            clocks = given_clock(videos, chosen)
        return {name: asdict(clock) for name, clock in clocks.items()}

    return {name: Clock(**table) for name, table in kept(folder, "clocks", make).items()}


def _clocks_in_words(clocks: Mapping[str, Clock], videos: Mapping[str, VideoFile]) -> str:
    def one(name: str, clock: Clock) -> str:
        rate = videos[name].rate or 25.0
        return f"{name} {clock.seconds * rate:+.2f}" + (f" +- {clock.error * rate:.2f}" if clock.error else "")

    methods = " and ".join(sorted({clock.method for clock in clocks.values()}))
    return f"start in frames, by {methods}: {', '.join(one(*item) for item in clocks.items())}"


def _notes_of_videos(settings: ImportSettings, videos: Mapping[str, VideoFile], few: Recording) -> tuple[str, ...]:
    """HDR, exposures that drift, cameras that were moved.

    Raises:
        D2Error: a camera that was moved, where that is not accepted.
    """
    hdr = ", ".join(f"{name} ({video.hdr})" for name, video in videos.items() if video.hdr)
    notes = [f"HDR of {hdr} was converted to BT.709: what is brighter than white paper is white"] if hdr else []
    if halves := ", ".join(name for name, video in videos.items() if video.interlaced):
        notes.append(
            f"frames of {halves} are two half images, so what moves has combs: deinterlace them (ffmpeg -vf bwdif)"
        )
    for name in few.cameras:
        steady = steadiness(few, name)
        if steady.moved:
            first, last = steady.between
            when = f"between {first:.2f} and {last:.2f} seconds of the recording"
            said = f"camera {name} was moved by {steady.moved:.1%} of its image's width {when}"
            if not settings.accept_calibration:
                raise D2Error(
                    f"{said}: import the parts by themselves (--times), each with its calibration, or give "
                    "--accept-calibration"
                )
            notes.append(said)
        if steady.drift > DRIFT:
            notes.append(f"the exposure of camera {name} drifts by {steady.drift:.0%}: lock it next time")
    return tuple(notes)


def _with_checked_poses(recording: Recording, few: Recording, report: Report) -> Recording:
    """The recording with a note for each camera whose pose a few images contradict."""
    try:
        turns = check_poses(few)
    except MissingExtra as missing:
        report(f"poses are not checked: {missing}")
        return recording
    sentences = turns_in_words(turns, recording.cameras)
    for sentence in sentences:
        report(sentence)
    return replace(recording, notes=(*recording.notes, *sentences[: sum(turn.wrong for turn in turns.values())]))


def _with_refined_poses(folder: Path, recording: Recording, report: Report, doubt: str) -> Recording:
    """The recording with the poses that its images prove to be better, or with those that were given.

    Raises:
        D2Error: those that were given stay, and there is a `doubt` about them.
    """

    def make() -> dict[str, Any]:
        refined = refine(recording)
        poses = {name: camera.T_camera_world.tolist() for name, camera in refined.cameras.items()}
        return {"accepted": refined.accepted, "reason": refined.reason, "poses": poses if refined.accepted else {}}

    refined = kept(folder, "poses", make)
    report(f"poses: {refined['reason']}")
    if doubt and not refined["accepted"]:
        raise D2Error(doubt)
    source = recording.source
    if not isinstance(source, VideosSource) or not refined["poses"]:
        return recording
    poses = {name: np.array(pose) for name, pose in refined["poses"].items()}
    moved = {name: replace(camera, T_camera_world=poses[name]) for name, camera in source.cameras.items()}
    source = replace(source, cameras=moved)
    notes = (*recording.notes, refined["reason"])
    return replace(recording, cameras=source.pinholes(), source=source, notes=notes)


def _write_images(folder: Path, recording: Recording, suffix: str, report: Report) -> None:
    """Write the images that are missing, and valid/CAMERA.png of cameras whose images have black margins."""
    total = len(recording.cameras) * len(recording.frames)
    with progress_bar("write images", total) as bar:
        done = 0
        for name in recording.cameras:
            for frame in recording.frames:
                path = folder / "images" / name / f"{frame:05d}.{suffix}"
                if not path.is_file() and suffix == "png":
                    write_png(path, recording.image(name, frame))
                elif not path.is_file():
                    write(path, encode_jpeg(recording.image(name, frame), JPEG_QUALITY), synced=False)
                bar.update(done := done + 1, name)
            recorded = recording.recorded(name)
            if recorded is not None:
                write_mask(folder / VALID_FOLDER / f"{name}.png", recorded)
    report(f"{counted(total, 'image')} of {counted(len(recording.cameras), 'camera')}")


def _exposures(folder: Path, recording: Recording, report: Report) -> dict[str, Exposure]:
    def make() -> dict[str, Any]:
        return {name: one._asdict() for name, one in measured_exposures(recording, list(recording.cameras)).items()}

    table = kept(folder, "exposures", make)
    exposures = {name: Exposure(tuple(one["gain"]), tuple(one["error"])) for name, one in table.items()}
    unknown = ", ".join(name for name in recording.cameras if name not in exposures)
    gains = ", ".join(f"{name} {100 * (sum(one.gain) / 3 - 1):+.1f} %" for name, one in exposures.items())
    report(f"exposure: {gains or 'not known'}" + (f"; too few shared features for {unknown}" if unknown else ""))
    return exposures
