"""Turn videos into a recording: where the cameras stand, one clock for all of them, images, exposures."""

from __future__ import annotations

from shlex import quote

from d2_plugin.commands.arguments.recording import show_notes
from d2_plugin.progress import show
from d2_plugin.recordings.importing.importing import import_videos
from d2_plugin.recordings.importing.settings import ImportSettings
from d2_plugin.values import counted

__all__ = ["ImportSettings", "run"]


def run(settings: ImportSettings) -> str:
    """Import; returns what the recording holds and where it is."""
    recording, _ = import_videos(settings, report=show)
    show_notes(recording.notes)
    sizes = sorted({(camera.width, camera.height) for camera in recording.cameras.values()})
    shown = ", ".join(f"{width}x{height}" for width, height in sizes)
    frames = f"{counted(len(recording.frames), 'frame')} at {recording.rate:g} per second"
    plan = f"`d2 plan {quote(str(settings.output))} --train-cameras all` says what is used and what is left out"
    return f"{counted(len(recording.cameras), 'camera')}, {frames}, {shown} pixels in {settings.output}\n{plan}"
