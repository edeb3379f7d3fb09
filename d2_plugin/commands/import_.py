"""Turn videos into a recording: where the cameras stand, one clock for all of them, pictures, exposures."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form
from d2_plugin.commands.arguments.recording import say, say_notes


def form(words: list[str]) -> Form:
    """What `d2 import` takes."""
    from d2_plugin.captures.videos.importing import import_videos
    from d2_plugin.captures.videos.settings import ImportSettings

    def run(settings: ImportSettings) -> str:
        found = import_videos(settings, told=say)
        capture = found.capture
        say_notes(capture.notes)
        sizes = sorted({(camera.width, camera.height) for camera in capture.cameras.values()})
        shown = ", ".join(f"{width}x{height}" for width, height in sizes)
        about = f"{len(capture.cameras)} cameras, {len(capture.frames)} frames at {capture.fps:g} per second"
        return f"{about}, {shown} pixels in {found.folder}\n`d2 doctor {found.folder}` says what it lacks"

    return Form.of("d2 import", __doc__, ImportSettings, run)
