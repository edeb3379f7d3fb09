"""A calibration file, parsed once: what it is written in is seen from its content, whatever it is called."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np

from d2_plugin.errors import D2Error
from d2_plugin.extras import imported
from d2_plugin.reading import DEEPEST, check_slow, field, parse_json, parse_toml, parsing, read_bytes, read_text
from d2_plugin.recordings.cameras.camera import LARGEST_NUMBER
from d2_plugin.values import Range, shown

CORRECT = "correct the file, see docs/calibration.md"

MOST_BYTES = 1 << 26  # larger calibrations are refused: a rig of 500 cameras takes a few hundred kilobytes

NUMBER = Annotated[float, Range(-LARGEST_NUMBER, LARGEST_NUMBER)]

Table = dict[str, Any]  # what stands between braces in a file, or under a heading: names and whatever the file says


class Document:
    """A calibration file or folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def place(self) -> str:
        """What sentences call it."""
        return str(self.path)

    @cached_property
    def text(self) -> str:
        """The text of the file; nothing for a folder."""
        if self.path.is_dir():
            return ""
        if read_bytes(self.path, CORRECT, MOST_BYTES)[:1] == b"\x80":
            raise D2Error(
                f"{self.path} is a pickle, which can run any program when it is opened: convert it to TOML with "
                "Pose2Sim's or OpenCap's own tool"
            )
        return read_text(self.path, CORRECT, MOST_BYTES)

    @cached_property
    def xml(self) -> ElementTree.Element | None:
        """The root of an XML file; None for anything else."""
        if not self.text.lstrip().startswith("<"):
            return None
        check_slow(self.text, self.place, CORRECT)
        if "<!" in re.sub(r"<!--.*?-->", "", self.text, flags=re.DOTALL):
            raise D2Error(f"{self.path} is XML that declares entities, which no calibration needs: {CORRECT}")
        with parsing(self.place, CORRECT):
            return ElementTree.fromstring(self.text)

    @cached_property
    def opencv(self) -> Table:
        """The entries of OpenCV's FileStorage, YAML or XML, a matrix as {"data": [...]}; nothing for anything else."""
        if self.text.startswith("%YAML"):
            content = parse_yaml(self.text.partition("\n")[2], self.place)
            return content if isinstance(content, dict) else {}
        if self.xml is None or self.xml.tag != "opencv_storage":
            return {}
        matrices = {entry.tag: entry.findtext("data") for entry in self.xml}
        words = {entry.tag: (entry.text or "").replace('"', " ").split() for entry in self.xml}
        return {key: words[key] if data is None else {"data": data.split()} for key, data in matrices.items()}

    @cached_property
    def content(self) -> Any:
        """The value of a JSON or YAML file or the tables of a TOML file; None for a folder, XML and OpenCV's YAML."""
        text = self.text
        if not text or self.xml is not None or text.startswith("%YAML"):
            return None
        if re.match(r"\s*(\{|\[\s*\{)", text):
            return parse_json(text, self.place, CORRECT)
        plain_yaml = re.search(r"^[\w.-]+:(\s|$)", text, re.MULTILINE)
        if plain_yaml and not re.search(r"^[ \t]*\[", text, re.MULTILINE):
            return parse_yaml(text, self.place)
        guess = "" if self.path.suffix == ".toml" else ", which looks like no XML, JSON or YAML,"
        return parse_toml(text, self.place + guess, CORRECT)

    @property
    def table(self) -> Table:
        """The content where it has names, else nothing."""
        return self.content if isinstance(self.content, dict) else {}

    def cameras(self) -> list[Any]:
        """The entries of a list `cameras`, else nothing."""
        entries = self.table.get("cameras")
        return entries if isinstance(entries, list) else []


def has(entries: Any, *names: str) -> bool:
    """Whether the first of a list of objects has all these names: how formats of one shape are told apart."""
    first = entries[0] if isinstance(entries, list) and entries else None
    return isinstance(first, dict) and first.keys() >= set(names)


def object_of(entry: Any, what: str) -> Table:
    """An entry of a list that must be an object; `what` says which."""
    if not isinstance(entry, dict):
        raise D2Error(f"{what} cannot be understood ({shown(entry)} is no object): {CORRECT}")
    return entry


def numbers(table: Table, key: str, shape: tuple[int, ...], place: str, remedy: str = CORRECT) -> np.ndarray:
    """The array under `key`, float64 [*shape], nested in lists or not; -1 in `shape` stands for any length."""
    value = field(table, key, list, place, remedy)
    with parsing(f"{key} of {place}, {shown(value)},", remedy):
        array = np.array(value, np.float64)
    if -1 not in shape and array.size != np.prod(shape):
        raise D2Error(
            f"{key} of {place} cannot be understood: it is {shown(value)}, expected "
            f"{' x '.join(map(str, shape))} numbers: {remedy}"
        )
    if not (np.abs(array) <= LARGEST_NUMBER).all():
        raise D2Error(f"{key} of {place} has a number that is not finite or too large: {remedy}")
    if shape == (4, 4) and not np.allclose(last := array.ravel()[12:], [0, 0, 0, 1]):
        raise D2Error(f"{key} of {place} ends with the row {last.tolist()}, expected 0 0 0 1: {remedy}")
    return array.reshape(shape)


def matrix_of(table: Table, key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A matrix of OpenCV's FileStorage, [*shape]: a row serves as well as a column."""
    entry = table.get(key)
    if not isinstance(entry, dict) or not isinstance(entry.get("data"), list):
        raise D2Error(f"{key} in {where} is no matrix of numbers: write it as an opencv-matrix")
    return numbers(entry, "data", shape, f"{key} in {where}")


def coefficients(table: Table, key: str, place: str) -> np.ndarray:
    """The distortion under `key`, [n]; none where the file has none."""
    return numbers(table, key, (-1,), place) if key in table else np.zeros(0)


def size_of(table: Table, key: str, place: str) -> tuple[int, int]:
    """(width, height) under `key`; some tools write whole numbers with a decimal point."""
    width, height = numbers(table, key, (2,), place)
    if width != round(width) or height != round(height) or min(width, height) < 1:
        raise D2Error(f"{key} of {place} is {width:g} x {height:g}, expected whole pixels: {CORRECT}")
    return int(width), int(height)


def parse_yaml(text: str, place: str) -> Any:
    """Lists, tables and words of YAML, without types (a number is a word) and aliases, which can unfold to any size."""
    yaml = imported("yaml", "PyYAML", "calibration", f"reading {place}")
    check_slow(text, place, CORRECT)
    open_ones: list[list[Any]] = [[]]
    with parsing(place, CORRECT):
        for event in yaml.parse(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # in C where it is there
            if isinstance(event, yaml.AliasEvent):
                raise D2Error(f"{place} has YAML aliases (*name), which no calibration needs: {CORRECT}")
            if isinstance(event, yaml.CollectionStartEvent):
                open_ones.append([])
                if len(open_ones) > DEEPEST:
                    raise D2Error(f"{place} is YAML nested more than {DEEPEST} deep: {CORRECT}")
            elif isinstance(event, yaml.CollectionEndEvent):
                items = open_ones.pop()
                table = isinstance(event, yaml.MappingEndEvent)
                open_ones[-1].append(dict(zip(items[::2], items[1::2], strict=True)) if table else items)
            elif isinstance(event, yaml.ScalarEvent):
                open_ones[-1].append(event.value)
        (content,) = open_ones[0]  # one document
        return content
