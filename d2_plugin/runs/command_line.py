"""The command that made a row, written from its settings."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from d2_plugin.settings import Settings, declared


def command_line(command: str, settings: Settings, comma: bool = False, **written: str) -> str:
    """`d2 COMMAND` with every setting that is not the default; folders of this machine are left out.

    Args:
        command: its words after `d2`.
        settings: what was given.
        comma: whether several values of one flag are joined by commas; separate words otherwise.
        written: flags whose text is not simply that of the value.
    """
    words = ["d2", *command.split()]
    kind: Any = type(settings)
    for setting in declared(kind):
        value = getattr(settings, setting.name)
        if value == setting.default:
            continue
        texts = [written[setting.name]] if setting.name in written else _texts(value, comma)
        words += texts if setting.positional else [f"--{setting.name.replace('_', '-')}", *texts]
    return shlex.join(words)


def _texts(value: Any, comma: bool) -> list[str]:
    if isinstance(value, bool):
        return []
    if isinstance(value, tuple):
        texts = [text for item in value for text in _texts(item, comma)]
        return [",".join(texts)] if comma else texts
    return [_without_folders(value)]


def _without_folders(value: Any) -> str:
    """An absolute path as its last part: the rest says nothing about the measurement."""
    text = str(value)
    return Path(text).name if text.startswith("/") else text
