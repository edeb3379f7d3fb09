"""From what a person types to a checked value of a declared setting, and from a setting to what is typed."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from d2_plugin.errors import D2Error
from d2_plugin.settings import Declared, Range
from d2_plugin.values import bare_and_range, checked, options_of

MOST_NUMBERS = 1_000_000
"""How many numbers a list may hold: a range of more would fill the memory."""


def flag_of(name: str) -> str:
    """The flag of a setting: `priors.stereo.min_angle` is `--priors.stereo.min-angle`."""
    return "--" + name.replace("_", "-")


def read(setting: Declared, texts: Sequence[str], flag: str) -> Any:
    """The value that `texts` stand for, checked against the declaration; `flag` is the flag, for the error.

    `none` is None where that is allowed. Lists are joined by commas; those of whole numbers may hold `first:last` and
    `first:last:step`, the last one included.

    Raises:
        D2Error: a value of another type, or out of range.
    """
    if type(None) in options_of(setting.kind) and [text.lower() for text in texts] == ["none"]:
        return None
    item = item_kind(setting.kind)
    if item is None:
        return checked(setting.kind, setting.range, _plain(setting.kind, texts[-1]), flag)
    pieces = [piece.strip() for text in texts for piece in text.split(",") if piece.strip()]
    value = _numbers(pieces, flag) if item is int else tuple(_plain(item, piece) for piece in pieces)
    return checked(setting.kind, setting.range, value, flag)


def bare(kind: Any) -> Any:
    """The first type of a union that is not None, or the one type, without what `Annotated` adds."""
    return next(bare_and_range(option)[0] for option in options_of(kind) if option is not type(None))


def item_kind(kind: Any) -> Any:
    """What a list holds; None for what is no list."""
    kind = bare(kind)
    return bare(get_args(kind)[0]) if get_origin(kind) is tuple and get_args(kind) else None


def limits(setting: Declared) -> Range:
    """The range of a setting, or that of the values it may hold."""
    inner = [setting.kind, *get_args(setting.kind), *get_args(bare(setting.kind))]
    ranges = [extra for kind in inner for extra in get_args(kind) if isinstance(extra, Range)]
    return setting.range if setting.range != Range() or not ranges else ranges[0]


def placeholder(kind: Any) -> str:
    """What stands for a value in the help."""
    item, kind = item_kind(kind), bare(kind)
    if item is not None:
        one = "NAME" if item is str else placeholder(item)
        return f"{one},{one}" if get_args(kind)[-1] is not Ellipsis else f"{one},..."
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    return {int: "N", float: "X", bool: "true|false", Path: "PATH", str: "TEXT"}.get(kind, "VALUE")


def written(value: Any) -> str:
    """A value as it would be typed."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (tuple, list)):
        return ",".join(map(written, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _plain(kind: Any, text: str) -> Any:
    """The value that a word looks like; the word itself where it fits no type, which the check then refuses."""
    kinds = [bare_and_range(option)[0] for option in options_of(kind)]
    choices = [choice for option in kinds if get_origin(option) is Literal for choice in get_args(option)]
    named = {str(choice): choice for choice in choices} | ({"true": True, "false": False} if bool in kinds else {})
    if text in named or text.lower() in named:
        return named.get(text, named.get(text.lower()))
    for number in (int, float):
        if number in kinds:
            with contextlib.suppress(ValueError):
                return number(text)
    return text


def _numbers(pieces: Sequence[str], flag: str) -> tuple[int, ...]:
    values: list[int] = []
    for piece in pieces or [""]:
        try:
            first, *last = (int(part) for part in piece.split(":"))
            numbers = range(first, last[0] + 1, *last[1:]) if last else [first]
            if not 0 < len(numbers) <= MOST_NUMBERS - len(values) or (last and last[0] < first):
                raise ValueError(piece)
            values += numbers
        except (ValueError, TypeError, OverflowError):
            raise D2Error(
                f"{flag} is '{piece[:80]}': give whole numbers joined by commas, or first:last or first:last:step with "
                f"the first at most the last, {MOST_NUMBERS} numbers at most"
            ) from None
    return tuple(values)
