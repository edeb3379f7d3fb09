"""Command lines that are refused, and the forms that read them."""

import re

import pytest

from d2_plugin.commands.arguments.form import Form, ModuleCommand
from d2_plugin.commands.cli import COMMANDS, _module, main


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The sentence with which a command line is refused; another answer fails, and so does a fault of ours."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err.splitlines()
    lines = [line for line in said if not re.match(r"\[|[\w ]+: \d+/\d+, ", line)]  # neither ffmpeg's own nor progress
    assert len(lines) == 1, lines
    assert lines[0].startswith("d2: "), lines
    assert "unexpected" not in lines[0], lines
    return lines[0]


def answered(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """What a command line that does its work prints."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 0
    return capsys.readouterr().out


def form_of(command: str, words: list[str]) -> Form:
    """What reads the words behind a command; some commands look at the words first."""
    known = COMMANDS[command]
    return known.form(f"d2 {command}") if isinstance(known, ModuleCommand) else _module(known).form(words)
