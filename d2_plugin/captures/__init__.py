"""Readers of recordings into one `Capture`."""

from d2_plugin.captures.capture import Camera, Capture, MonoKind, Source
from d2_plugin.captures.layouts import LAYOUTS, Layout, open_capture
from d2_plugin.captures.selection import select_cameras, select_frames

__all__ = [
    "LAYOUTS",
    "Camera",
    "Capture",
    "Layout",
    "MonoKind",
    "Source",
    "open_capture",
    "select_cameras",
    "select_frames",
]
