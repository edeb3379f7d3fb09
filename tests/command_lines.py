"""Command lines that are refused."""

from __future__ import annotations

import pytest

from d2_plugin.commands.cli import main


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The sentence with which a command line is refused; another answer fails, and so does a fault of ours."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("[")]  # ffmpeg's own
    assert len(lines) == 1, lines
    assert lines[0].startswith("d2: "), lines
    assert "unexpected" not in lines[0], lines
    return lines[0]
