"""Readers of recordings into one `Recording`."""

from d2_plugin.recordings.layouts import LAYOUTS, Layout, open_recording
from d2_plugin.recordings.recording import Camera, MonoKind, Recording, Source
from d2_plugin.recordings.selection import select_cameras, select_frames

__all__ = [
    "LAYOUTS",
    "Camera",
    "Layout",
    "MonoKind",
    "Recording",
    "Source",
    "open_recording",
    "select_cameras",
    "select_frames",
]
