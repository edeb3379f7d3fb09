"""The one place where files that somebody else wrote are opened and parsed: a valid content comes out, or one sentence.

Only regular files are opened (a pipe would block, a device never ends), up to a stated size. Text is UTF-8. JSON is
strict: NaN and Infinity are no numbers, no name stands twice in an object, depth and length of numbers are bounded.
Arrays are in `d2_plugin.arrays`.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from d2_plugin.errors import D2Error
from d2_plugin.older import tomllib
from d2_plugin.values import fitting

MOST_BYTES = 1 << 31
"""Larger files are refused unless the caller allows more, and larger arrays."""

MOST_TEXT = 1 << 28
"""Larger texts are refused: their parsed values take up to some thirty times as much memory."""

MOST_SLOW = 1 << 20
"""Longer TOML and YAML is refused: a second of parsing for every few hundred kilobytes."""

DEEPEST = 64
"""Of tables within each other in TOML and YAML."""

MOST_DIGITS = 300
"""Longer whole numbers are refused: they fit no float."""

RESTORE = "restore the file"
"""What to do, where the caller says nothing better."""

_NO_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class Unreadable(D2Error):
    """A file that cannot be read or does not hold what was expected."""


class NoSuchFile(Unreadable, FileNotFoundError):
    """There is no file of that name."""


@contextmanager
def opened(path: Path | str, remedy: str = RESTORE) -> Iterator[BinaryIO]:
    """A regular file, open for reading; `remedy` ends the sentence that says why it cannot be read.

    Raises:
        NoSuchFile: there is none.
        Unreadable: it is a folder, a pipe, a socket or a device, may not be read, or its name is impossible.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise Unreadable(f"{said(ValueError(repr(path)))} is no path: {remedy}")
    try:
        _check_regular(os.stat(path).st_mode, path, remedy)  # to open a device or a pipe may already change it
        handle = os.open(path, os.O_RDONLY | _NO_WAITING)
    except D2Error:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise NoSuchFile(f"cannot read {shown_path(path)} (there is no such file): {remedy}") from None
    except (OSError, ValueError) as failure:  # ValueError: a zero byte, or letters that no file name has
        raise Unreadable(f"cannot read {shown_path(path)} ({said(failure)}): {remedy}") from None
    with os.fdopen(handle, "rb") as file:
        _check_regular(os.fstat(handle).st_mode, path, remedy)
        yield file


def read_bytes(path: Path | str, remedy: str = RESTORE, most: int = MOST_BYTES) -> bytes:
    """All bytes of a regular file of at most `most` bytes; see `opened`."""
    with opened(path, remedy) as file, parsing(shown_path(path), remedy):
        data = file.read(most + 1) if os.fstat(file.fileno()).st_size <= most else None
    if data is None or len(data) > most:
        raise Unreadable(f"{shown_path(path)} has more than {most} bytes, the most that is read: {remedy}")
    return data


def read_text(path: Path | str, remedy: str = RESTORE, most: int = MOST_TEXT) -> str:
    """The text of a UTF-8 file, with or without a byte order mark; see `read_bytes`."""
    data = read_bytes(path, remedy, most)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        raise Unreadable(f"{shown_path(path)} is no UTF-8 text (byte {failure.start}): {remedy}") from None


def read_json(path: Path | str, remedy: str = RESTORE) -> dict[str, Any]:
    """The object in a JSON file; see `parse_json`."""
    content = parse_json(read_text(path, remedy), shown_path(path), remedy)
    if not isinstance(content, dict):
        kinds = {list: "a list", str: "a text", bool: "true or false", type(None): "null"}
        what = kinds.get(type(content), "a number")
        raise Unreadable(f"{shown_path(path)} holds {what}, expected a JSON object: {remedy}")
    return content


def parse_json(text: str, place: str, remedy: str = RESTORE) -> Any:
    """The value of strict JSON; `place` names the file, or the line of a file, in errors.

    Raises:
        Unreadable: no JSON; NaN, Infinity or a number beyond 1.8e308; a name twice in one object; too deep; letters
            that are half of a pair.
    """
    with parsing(f"{place} as JSON", remedy):
        content = json.loads(
            text, parse_constant=_no_constant, parse_float=_finite, parse_int=_whole, object_pairs_hook=_once
        )
        if "\\ud" in text.lower():  # half of a surrogate pair can be neither printed nor a file's name
            json.dumps(content, ensure_ascii=False).encode()
    return content


def read_toml(path: Path | str, remedy: str = RESTORE) -> dict[str, Any]:
    """The tables of a TOML file."""
    return parse_toml(read_text(path, remedy), shown_path(path), remedy)


def parse_toml(text: str, place: str, remedy: str = RESTORE) -> dict[str, Any]:
    """The tables of a TOML text; `place` names the file in errors."""
    check_slow(text, place, remedy)
    with parsing(f"{place} as TOML", remedy):
        if any(part.count(".") > DEEPEST for part in re.split(r"[=,{\n]", text)):  # its time grows with the square
            raise RecursionError("names are nested too deeply")
        return tomllib.loads(text)


def check_slow(text: str, place: str, remedy: str) -> None:
    """Refuse a text that parsers written in Python would take minutes for."""
    if len(text) > MOST_SLOW:
        raise Unreadable(f"{place} has more than {MOST_SLOW} letters, the most that is read of its kind: {remedy}")


def json_text(values: Any, place: str, **layout: Any) -> str:
    """Strict JSON of plain values, as `json.dumps` lays it out; `place` names the file in the error.

    Raises:
        D2Error: a number that is not finite, which JSON cannot hold, with the names that lead to it.
    """
    try:
        return json.dumps(values, allow_nan=False, **layout)
    except ValueError:
        where = _not_finite(values)
        if where is None:
            raise
        raise D2Error(f"{place} would hold a number at {where} that is not finite, which JSON has not") from None


def field(table: Mapping[str, Any], name: str, kind: Any, place: str, remedy: str = RESTORE, default: Any = ...) -> Any:
    """The value under `name` of a parsed object, of the declared kind: `field(entry, "fx", Positive, "camera 00")`.

    `kind` is a type with or without a range (see `d2_plugin.values`); an Ellipsis as `default` means that the value
    must be there.
    """
    if name not in table:
        if default is ...:
            raise Unreadable(f"{place} has no {name}: {remedy}")
        return default
    try:
        return fitting(kind, table[name], f"{name} of {place}")
    except D2Error as failure:
        raise Unreadable(f"{failure}: {remedy}") from None


@contextmanager
def parsing(place: str, remedy: str = RESTORE) -> Iterator[None]:
    """Whatever a parser raises on bytes that it does not understand becomes one sentence; a D2Error passes.

    For parsers of other libraries, whose errors on damaged input have no common kind.
    """
    try:
        yield
    except D2Error:
        raise
    except MemoryError:
        raise Unreadable(f"{place} needs more memory than there is: {remedy}") from None
    except Exception as failure:
        raise Unreadable(f"cannot read {place} ({said(failure)}): {remedy}") from failure


@contextmanager
def reaching(place: Path | str, remedy: str) -> Iterator[None]:
    """An OSError below becomes one sentence with the file it names, or `place`: for listing and asking for files."""
    try:
        yield
    except D2Error:
        raise
    except OSError as failure:
        raise Unreadable(f"cannot read {shown_path(failure.filename or place)} ({said(failure)}): {remedy}") from None


def said(failure: BaseException) -> str:
    """What an exception says, on one short line."""
    reason = getattr(failure, "strerror", None) or str(failure)  # OSError has it, and so have FFmpeg's errors
    text = " ".join(reason.encode("utf-8", "backslashreplace").decode().split()) or type(failure).__name__
    return text if len(text) <= 160 else f"{text[:156]} ..."


def shown_path(path: Path | str | bytes) -> str:
    """A path as a sentence holds it: on one line, of letters that every terminal takes."""
    text = os.fsdecode(path).encode("utf-8", "backslashreplace").decode()
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def _check_regular(mode: int, path: Path | str, remedy: str) -> None:
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
        what = kinds.get(stat.S_IFMT(mode), "a device")
        raise Unreadable(f"{shown_path(path)} is {what}, expected a file: {remedy}")


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"it has {name}, which is not finite and no number of JSON")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is beyond every number")
    return number


def _whole(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a number has {len(text)} digits")
    return int(text)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the name {twice[:40]!r} stands twice in one object")
    return table


def _not_finite(values: Any, place: str = "") -> str | None:
    """Where in nested values the first number stands that is not finite."""
    if isinstance(values, float):
        return None if math.isfinite(values) else place or "its top"
    if not isinstance(values, (Mapping, list, tuple)):
        return None
    pairs = values.items() if isinstance(values, Mapping) else enumerate(values)
    found = (_not_finite(value, f"{place}.{name}".lstrip(".")) for name, value in pairs)
    return next((where for where in found if where is not None), None)
