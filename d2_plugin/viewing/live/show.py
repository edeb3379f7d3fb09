"""`d2 view` and `d2 train --view`: what to show, and for how long."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin.errors import D2Error
from d2_plugin.recordings import open_recording
from d2_plugin.settings import AtLeastOne, Positional, Range, Settings
from d2_plugin.store.store import PriorStore
from d2_plugin.viewing.checkpoints import is_output_folder, open_subject
from d2_plugin.viewing.live.viewer import Viewer
from d2_plugin.viewing.stand_in import subject_of_store
from d2_plugin.viewing.subject import Subject, subject_of_recording, with_priors

LOCAL = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class ViewSettings(Settings):
    """What is shown, and who may look."""

    shown: Annotated[Path, Positional()]
    """Folder of a run, a recording or a depth prior; or what an official trainer wrote, with --recording."""
    host: str = "127.0.0.1"
    """Address to listen at; the default is this machine alone, and 0.0.0.0 lets everybody in."""
    port: Annotated[int, Range(1, 65535)] = 8080
    """Port of the page; the next free one where it is in use."""
    height: Annotated[int, Range(16, 4096, unit="pixels")] = 360
    """Height of an image at rest; while something moves it is as small as it must be."""
    recording: Path | None = None
    """The recording of a prior or of a checkpoint."""
    train_cameras: tuple[str, ...] | None = None
    """Cameras that such a checkpoint was trained with."""
    downscale: AtLeastOne = 1
    """Make the recording's images this many times smaller."""


def run(settings: ViewSettings) -> str:
    """Show it until Ctrl-C."""
    subject = subject_at(settings)
    viewer = Viewer(subject=subject, host=settings.host, port=settings.port, height=settings.height)
    notes = [subject.note] if subject.note else []
    sys.stdout.write("".join(f"     note  {note}\n" for note in notes) + f"{said_of(viewer, settings.host)}\n")
    sys.stdout.flush()
    try:
        viewer.stay()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return "closed"


def subject_at(settings: ViewSettings) -> Subject:
    """What lies at the path: a prior store, a run, a checkpoint, or else a recording.

    Raises:
        D2Error: one sentence for what is none of these.
    """
    path = settings.shown
    if (path / "store.json").is_file():
        if settings.recording is None:
            return subject_of_store(PriorStore.open(path))
        return with_priors(subject_of_recording(open_recording(settings.recording, downscale=settings.downscale)), path)
    if path.is_file() or (path / "run.json").is_file() or is_output_folder(path):
        return open_subject(path, settings.recording, settings.train_cameras, settings.downscale)
    if path.is_dir() and not any(path.iterdir()):
        raise D2Error(f"{path} is empty: give the folder of a run, a recording or a depth prior")
    return subject_of_recording(open_recording(path, downscale=settings.downscale))


def said_of(viewer: Viewer, host: str) -> str:
    """Where the page is, and who can see it."""
    who = "" if host in LOCAL else "; everybody who reaches this machine can see it and move in it"
    return f"{viewer.url}  (Ctrl-C ends){who}"
