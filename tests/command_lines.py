"""Command lines that are refused."""

from __future__ import annotations

import re

import pytest

from d2_plugin.commands.cli import main


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The sentence with which a command line is refused; another answer fails, and so does a fault of ours."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err.splitlines()
    lines = [line for line in said if not re.match(r"\[|\w+: \d+/\d+, ", line)]  # neither ffmpeg's own nor progress
    assert len(lines) == 1, lines
    assert lines[0].startswith("d2: "), lines
    assert "unexpected" not in lines[0], lines
    return lines[0]
