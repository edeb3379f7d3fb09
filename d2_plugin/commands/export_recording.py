"""Write a recording in the input layout of another 4D Gaussian Splatting repository."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 export-recording` takes."""
    from d2_plugin.runs.recording_export import RecordingExport, run

    return Form.of("d2 export-recording", __doc__, RecordingExport, run)
