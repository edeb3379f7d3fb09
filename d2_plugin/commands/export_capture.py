"""Write a recording in the input layout of another 4D Gaussian Splatting repository."""

from __future__ import annotations

from d2_plugin.commands.arguments.form import Form


def form(words: list[str]) -> Form:
    """What `d2 export-capture` takes."""
    from d2_plugin.study.capture_export import CaptureExport, run

    return Form.of("d2 export-capture", __doc__, CaptureExport, run)
