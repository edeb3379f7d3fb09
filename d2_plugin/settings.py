"""One declaration per setting: its type, range and unit stand in the annotation, its help in the docstring under it.

    @dataclass(frozen=True)
    class PruneConfig(Settings):
        every: Steps = 100
        \"\"\"Steps between evaluations.\"\"\"
        tau_p: Share = 0.75
        \"\"\"Score above which an evaluation counts against a Gaussian.\"\"\"

Every way in meets the same check: Python, TOML, a run's JSON and the command line. A value out of range is one sentence
before anything is computed.
"""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import math
import textwrap
import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from d2_plugin.errors import D2Error, unknown_name

__all__ = [
    "Angle",
    "Count",
    "Declared",
    "NotNegative",
    "Positional",
    "Positive",
    "Range",
    "Seed",
    "Settings",
    "Share",
    "Steps",
]


@dataclass(frozen=True)
class Range:
    """Where a number may lie, and its unit; bounds that are None do not bound. Infinity is refused unless allowed."""

    low: float | None = None
    high: float | None = None
    unit: str = ""
    open_low: bool = False
    """The lower bound itself is refused."""
    infinite: bool = False
    """Infinity is a value."""

    def holds(self, value: float) -> bool:
        """Whether `value` lies inside; what is not a number never does."""
        if math.isnan(value) or (math.isinf(value) and not self.infinite):
            return False
        above = self.low is None or value > self.low or (value == self.low and not self.open_low)
        return above and (self.high is None or value <= self.high)

    def __str__(self) -> str:
        low = "" if self.low is None else f"{'above' if self.open_low else 'at least'} {self.low:g}"
        high = "" if self.high is None else f"at most {self.high:g}"
        return " and ".join(part for part in (low, high) if part) or "finite"


@dataclass(frozen=True)
class Positional:
    """Marks a setting that the command line takes by its place and not behind a flag: `Annotated[str, Positional()]`."""


Count = Annotated[int, Range(0)]
"""A whole number, 0 or more."""
Steps = Annotated[int, Range(0, unit="steps")]
"""Optimizer steps."""
Seed = Annotated[int, Range(0, 2**63 - 1)]
"""Of a random generator."""
Positive = Annotated[float, Range(0, open_low=True)]
"""A number above 0."""
NotNegative = Annotated[float, Range(0)]
"""A number, 0 or more."""
Share = Annotated[float, Range(0, 1)]
"""A part of a whole, 0..1."""
Angle = Annotated[float, Range(0, 180, unit="degrees")]
"""An angle."""


class OutOfRange(D2Error):
    """A value of the right type that lies outside its declared range."""


class Declared(NamedTuple):
    """One setting as it was declared."""

    name: str
    kind: Any
    """The annotation without what `Annotated` adds: a plain type, a Literal, a union, a tuple or a Settings."""
    default: Any
    """MISSING where a value must be given."""
    range: Range
    positional: bool
    """Whether the command line takes it by its place."""
    help: str
    """The docstring under the field, its lines joined."""


Chosen = TypeVar("Chosen", bound="Settings")


@dataclass(frozen=True)
class Settings:
    """Base of all settings; a subclass is a frozen dataclass."""

    def __post_init__(self) -> None:
        """Check each value against its declaration; whole numbers become floats and lists tuples where declared so."""
        for setting in declared(type(self)):
            value = checked(setting.kind, setting.range, getattr(self, setting.name), f"{_place(self)}{setting.name}")
            object.__setattr__(self, setting.name, value)

    @classmethod
    def from_dict(cls: type[Chosen], table: Mapping[str, Any], where: str = "settings") -> Chosen:
        """From nested mappings, as TOML gives them; what is absent keeps its default. `where` names the table.

        Raises:
            D2Error: an unknown name, with the nearest one suggested; a value of the wrong type or out of range.
        """
        if not isinstance(table, Mapping):
            raise D2Error(f"{where} must be a table of settings, got {table!r}: write [{where}] above them")
        known = {setting.name: setting for setting in declared(cls)}
        for name in table:
            if name not in known:
                raise unknown_name(f"setting in [{where}]", name, known)
        given = {name: _from_plain(known[name], value, f"{where}.{name}") for name, value in table.items()}
        missing = [name for name, setting in known.items() if setting.default is MISSING and name not in given]
        if missing:
            raise D2Error(f"[{where}] needs {', '.join(missing)}: add it")
        return cls(**given)


@functools.cache
def declared(kind: Any) -> tuple[Declared, ...]:
    """The declarations of all settings of a class, those of its bases first."""
    hints, helps = get_type_hints(kind, include_extras=True), _docstrings(kind)
    found = []
    for entry in fields(kind):
        default = entry.default if entry.default_factory is MISSING else entry.default_factory()
        bare, limits = _annotation(hints[entry.name])
        by_place = any(isinstance(extra, Positional) for extra in get_args(hints[entry.name])[1:])
        found.append(Declared(entry.name, bare, default, limits, by_place, helps.get(entry.name, "")))
    return tuple(found)


def checked(kind: Any, limits: Range, value: Any, name: str) -> Any:
    """`value` as the declared kind, or a D2Error that names the setting.

    `kind` is what `Declared.kind` holds.
    """
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    if value is None and type(None) in options:
        return None
    failures = []
    for option in (option for option in options if option is not type(None)):
        try:
            return _as_kind(*_inner(option, limits), value, name)
        except D2Error as error:
            failures.append(error)
    raise next((error for error in failures if isinstance(error, OutOfRange)), failures[0])


def _as_kind(kind: Any, limits: Range, value: Any, name: str) -> Any:
    """`value` as one kind that is no union."""
    if kind is Any:
        return value
    if get_origin(kind) is Literal:
        if not isinstance(value, str):
            raise _wrong(name, f"must be one of {', '.join(get_args(kind))}", value)
        if value not in get_args(kind):
            raise unknown_name(name, value, get_args(kind))
        return value
    if get_origin(kind) is tuple:
        return _as_tuple(get_args(kind), limits, value, name)
    if kind in (int, float):
        return _as_number(kind, limits, value, name)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if isinstance(get_origin(kind) or kind, type) and isinstance(value, get_origin(kind) or kind):
        if isinstance(value, bool) and kind is not bool:
            raise _wrong(name, f"must be a {kind.__name__}", value)
        return value
    words = {bool: "true or false", str: "text"}
    raise _wrong(name, f"must be a value like {words.get(kind, getattr(kind, '__name__', kind))}", value)


def _as_number(kind: type, limits: Range, value: Any, name: str) -> int | float:
    number = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
    whole = isinstance(number, int) and not isinstance(number, bool)
    if not whole and not (kind is float and isinstance(number, float)):
        raise _wrong(name, f"must be a {'whole number' if kind is int else 'number'}", value)
    unit = f" {limits.unit}" if limits.unit else ""
    if not limits.holds(number):
        raise OutOfRange(str(_wrong(name, f"must be {limits}{unit}", value)))
    return kind(number)


def _as_tuple(kinds: Sequence[Any], limits: Range, value: Any, name: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise _wrong(name, "must be a list", value)
    endless = len(kinds) == 2 and kinds[1] is Ellipsis
    if not endless and len(value) != len(kinds):
        raise _wrong(name, f"must be a list of {len(kinds)} values", value)
    each = [kinds[0]] * len(value) if endless else kinds
    pairs = zip(each, value, strict=True)
    return tuple(checked(*_inner(kind, limits), item, f"{name}[{i}]") for i, (kind, item) in enumerate(pairs))


def _inner(kind: Any, limits: Range) -> tuple[Any, Range]:
    bare, own = _annotation(kind)
    return bare, own if own != Range() else limits


def _from_plain(setting: Declared, value: Any, where: str) -> Any:
    """A table becomes the Settings that are declared there; anything else is checked as it is."""
    for option in (setting.kind, *get_args(setting.kind)):
        if isinstance(option, type) and is_dataclass(option) and issubclass(option, Settings):
            if isinstance(value, option) or (value is None and option is not setting.kind):
                return value
            return option.from_dict(value, where)
    return checked(setting.kind, setting.range, value, where)


def _annotation(hint: Any) -> tuple[Any, Range]:
    """The bare type of an annotation and its range."""
    if get_origin(hint) is Annotated:
        bare, *extras = get_args(hint)
        return bare, next((extra for extra in extras if isinstance(extra, Range)), Range())
    return hint, Range()


def _place(settings: Settings) -> str:
    return f"{type(settings).__name__}."


def _wrong(name: str, must: str, value: Any) -> D2Error:
    text = repr(value)
    return D2Error(f"setting {name} {must}, got {text if len(text) < 80 else text[:76] + ' ...'}")


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """The strings that stand under the fields of a class and of its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_dataclass(base):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        for field, below in itertools.pairwise(body):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = " ".join(text.split())
    return found
