"""What the method needs for a recording, and what is left out, and why."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from d2_plugin.commands.arguments.form import Form, Given
from d2_plugin.commands.arguments.recording import recording_form, run_settings, show_notes, show_plan
from d2_plugin.progress import show
from d2_plugin.values import counted

if TYPE_CHECKING:
    from d2_plugin.recordings import Recording


def form(words: list[str]) -> Form:
    """What `d2 plan` takes."""
    return recording_form("d2 plan", __doc__, run, tables=("priors", "plan"))


def run(given: Given) -> None:
    """Say what the recording is, then each decision."""
    from d2_plugin.runs.scene import Scene
    from d2_plugin.runs.settings import check

    scene = Scene.open(check(run_settings(given)))
    show(f"recording  {described(scene.recording)}")
    show_notes((*scene.recording.notes, *_clock(scene.recording)))
    show_plan(scene.plan)


def described(recording: Recording) -> str:
    """Name, layout, cameras, frames and size of the images, in one line."""
    cameras, frames = list(recording.cameras), recording.frames
    sizes = " or ".join(dict.fromkeys(f"{camera.width}x{camera.height}" for camera in recording.cameras.values()))
    when = f"frames {frames[0]} to {frames[-1]} ({len(frames)})" if len(frames) > 1 else f"frame {frames[0]}"
    who = f"{counted(len(cameras), 'camera')} ({', '.join(cameras)})"
    when += f" at {recording.rate:g} per second"
    return f"{recording.name}: layout {recording.layout}, {who}, {when}, {sizes} pixels"


def _clock(recording: Recording) -> Iterable[str]:
    """How far images are from the instants of their numbers, or that nothing says that cameras are synchronised."""
    late = [abs(seconds) * recording.fps for times in recording.late.values() for seconds in times.values()]
    if late:
        yield f"images were taken up to {max(late):.2f} frames off their numbers' instants; each is trained at its own"
    elif len(recording.frames) > 1 and not Path(recording.path or "", "import", "clocks.json").is_file():
        yield "nothing says how the cameras were synchronised: equal frame numbers are taken as one instant"
