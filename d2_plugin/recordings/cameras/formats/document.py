"""A calibration file, parsed once: what it is written in is seen from its content, whatever it is called."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from d2_plugin.errors import D2Error, missing_extra
from d2_plugin.reading import field, parse_json, parsing, read_bytes, read_text, read_toml, said
from d2_plugin.recordings.cameras.calibration import LARGEST_NUMBER
from d2_plugin.values import Range, shown

CORRECT = "correct the file, see docs/calibration.md"

MOST_BYTES = 1 << 26
"""Larger calibrations are refused: a rig of 500 cameras takes a few hundred kilobytes."""

NUMBER = Annotated[float, Range(-LARGEST_NUMBER, LARGEST_NUMBER)]


class Document:
    """A calibration file or folder; each property is its content in one notation, or None where it is another one."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def place(self) -> str:
        """What sentences call it."""
        return str(self.path)

    @cached_property
    def text(self) -> str:
        """The text of the file, empty for a folder."""
        if self.path.is_dir():
            return ""
        if read_bytes(self.path, CORRECT, MOST_BYTES)[:1] == b"\x80":
            raise D2Error(
                f"{self.path} is a pickle, which can run any program when it is opened: convert it to TOML with "
                "Pose2Sim's or OpenCap's own tool"
            )
        return read_text(self.path, CORRECT, MOST_BYTES)

    @cached_property
    def notation(self) -> str:
        """`json`, `opencv` (its YAML), `yaml`, `toml`, or nothing for a folder."""
        if self.path.is_dir():
            return ""
        if re.match(r"\s*(\{|\[\s*\{)", self.text):
            return "json"
        if self.text.startswith("%YAML"):
            return "opencv"
        plain_yaml = re.search(r"^[\w.-]+:(\s|$)", self.text, re.MULTILINE)
        return "yaml" if plain_yaml and not re.search(r"^\s*\[", self.text, re.MULTILINE) else "toml"

    @cached_property
    def json(self) -> Any:
        """The value of a JSON file, else None."""
        return parse_json(self.text, self.place, CORRECT) if self.notation == "json" else None

    @cached_property
    def toml(self) -> dict[str, Any] | None:
        """The tables of a TOML file, else None."""
        return read_toml(self.path, CORRECT) if self.notation == "toml" else None

    @cached_property
    def yaml(self) -> Any:
        """The value of a YAML file that OpenCV did not write, else None."""
        return _yaml(self.text, self.place) if self.notation == "yaml" else None

    def table(self) -> dict[str, Any]:
        """The tables of a TOML file or the object of a JSON or YAML file; empty where it is something else."""
        content = self.json or self.toml or self.yaml
        return content if isinstance(content, dict) else {}


def numbers(table: Mapping[str, Any], key: str, shape: tuple[int, ...], place: str) -> np.ndarray:
    """The array under `key`, float64 [*shape], nested in lists or not; -1 in `shape` stands for any length."""
    value = field(table, key, list, place, CORRECT)
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as failure:
        raise D2Error(f"{key} of {place} is {shown(value)}, which cannot be understood ({said(failure)})") from None
    if -1 not in shape and array.size != np.prod(shape):
        raise D2Error(
            f"{key} of {place} cannot be understood: it is {shown(value)}, expected "
            f"{' x '.join(map(str, shape))} numbers: {CORRECT}"
        )
    if not (np.abs(array) <= LARGEST_NUMBER).all():
        raise D2Error(f"{key} of {place} has a number that is not finite or too large: {CORRECT}")
    return array.reshape(shape)


def size_of(table: Mapping[str, Any], key: str, place: str) -> tuple[int, int]:
    """(width, height) under `key`; some tools write whole numbers with a decimal point."""
    width, height = numbers(table, key, (2,), place)
    if width != round(width) or height != round(height) or min(width, height) < 1:
        raise D2Error(f"{key} of {place} is {width:g} x {height:g}, expected whole pixels: {CORRECT}")
    return int(width), int(height)


def _yaml(text: str, place: str) -> Any:
    """YAML without aliases, which can unfold to any size."""
    try:
        import yaml
    except ImportError:
        raise missing_extra("PyYAML", "calibration", f"reading {place}") from None
    with parsing(place, CORRECT):
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, Loader=yaml.SafeLoader)):
            raise D2Error(f"{place} has YAML aliases (*name), which no calibration needs: {CORRECT}")
        return yaml.safe_load(text)
