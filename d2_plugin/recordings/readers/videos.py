"""A recording that `d2 import --images videos` left in its videos: videos.json says which frame is where.

The videos are decoded when an image is asked for, so they must stay where they were, unchanged.
"""

from __future__ import annotations

from pathlib import Path

from d2_plugin.durable import Kind, read_table
from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, shown_path
from d2_plugin.recordings.importing.source import VideosSource
from d2_plugin.recordings.importing.video import VideoFile, read_video
from d2_plugin.recordings.readers.folder import with_measured
from d2_plugin.recordings.recording import Recording
from d2_plugin.recordings.selection import select_cameras

TABLE = "videos.json"
KIND = Kind("description of videos", 1, "import the videos again into another folder")


def open_videos(path: Path, cameras: tuple[str, ...] | None = None, intersect: bool = False) -> Recording:
    """The recording; only the headers of the videos are read. `intersect` changes nothing: nothing can be missing."""
    where = path / TABLE
    table = read_table(where, KIND)
    with parsing(str(where), KIND.remedy):
        source = VideosSource.from_dict(table["cameras"], path)
        fps, notes = float(table["recording"]["fps"]), tuple(table["recording"]["notes"])
        names = list(source.cameras)
        pinholes, frames = source.pinholes(), tuple(source.indices[names[0]])
    recording = Recording(path.resolve().name, pinholes, frames, fps, source, path, notes=notes, layout="videos")
    recording = with_measured(recording, table["recording"], str(where))
    for name in names if cameras is None else [name for name in cameras if name in names]:
        _refuse_changed(source.videos[name], name)
    return recording if cameras is None else select_cameras(recording, cameras)


def _refuse_changed(video: VideoFile, name: str) -> None:
    if not video.path.is_file():
        raise D2Error(
            f"the video of camera {name} is not at {shown_path(video.path)} any more: put it back, or import again "
            "with --images png, which needs no videos afterwards"
        )
    now = read_video(video.path)
    if (now.stored_size, now.stamps.tolist()) != (video.stored_size, video.stamps.tolist()):
        raise D2Error(f"{shown_path(video.path)} is not the video that was imported: put it back, or import again")
