"""One declaration per setting: its type, range and unit stand in the annotation, its help in the docstring under it.

    @dataclass(frozen=True)
    class PruneConfig(Settings):
        every: Steps = 100
        \"\"\"Steps between evaluations.\"\"\"
        tau_p: Share = 0.75
        \"\"\"Score above which an evaluation counts against a Gaussian.\"\"\"

Every way in meets the same check: Python, TOML, a run's JSON and the command line. A wrong value is refused in one
sentence before anything is computed.
"""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, NamedTuple, TypeVar, cast, get_args

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.older import hints_of
from d2_plugin.values import UNBOUNDED, bare_and_range, checked, options_of, shown
from d2_plugin.values import Range as Range


@dataclass(frozen=True)
class Positional:
    """Marks a setting that the command line takes by its place, not behind a flag: `Annotated[str, Positional()]`."""


Count = Annotated[int, Range(0)]
"""A whole number, 0 or more (and `d2_plugin.values.MOST` at most, as every number that declares no other bound)."""
Steps = Annotated[int, Range(0, unit="steps")]
"""Optimizer steps, 0 or more."""
Every = Annotated[int, Range(1, unit="steps")]
"""Optimizer steps from one time to the next, 1 or more."""
AtLeastOne = Annotated[int, Range(1)]
"""A whole number, 1 or more."""
Downscale = Annotated[int, Range(1, 65_535)]
"""How many times smaller an image becomes along each side."""
AtATime = Annotated[int, Range(1, 1024)]
"""How many threads or processes work at a time, 1 or more."""
Seed = Annotated[int, Range(0, 2**63 - 1)]
"""Seed of a random generator."""
Positive = Annotated[float, Range(1e-9)]
"""A number above 0."""
NotNegative = Annotated[float, Range(0)]
"""A number, 0 or more."""
LearningRate = Annotated[float, Range(0, 100)]
"""Learning rate per step."""
Relative = Annotated[float, Range(0, 1e6)]
"""A difference relative to what it is a difference of, 0 or more."""
Share = Annotated[float, Range(0, 1)]
"""A part of a whole, 0..1."""
Angle = Annotated[float, Range(0, 180, unit="degrees")]
"""An angle, 0 to 180 degrees."""

FORMAT = 1
"""Version of the settings in files (d2.toml, run.json); it rises when a name gets another meaning."""

NONE = "none"
"""How files and the command line, which have no word for it, write that an optional setting has no value."""


class Declared(NamedTuple):
    """One setting as it was declared."""

    name: str
    """Of the field, or dotted with the names of its tables before it."""
    kind: Any
    """The annotation without what `Annotated` adds: a plain type, a Literal, a union, a tuple or a Settings."""
    default: Any
    """MISSING where a value must be given."""
    range: Range
    positional: bool
    """Whether the command line takes it by its place."""
    owner: type
    """The class whose setting it is."""
    more: str = ""
    """What is said after the docstring."""

    @property
    def help(self) -> str:
        """The docstring under the field, its lines joined; for a table without one, the first line of its class."""
        text = _docstrings(self.owner).get(self.name.rpartition(".")[2]) or _first_line(table_of(self.kind))
        return f"{text} {self.more}".strip()


Chosen = TypeVar("Chosen", bound="Settings")


@dataclass(frozen=True)
class Settings:
    """Base of all settings; a subclass is a frozen dataclass."""

    def __post_init__(self) -> None:
        """Check each value against its declaration; whole numbers become floats and lists tuples where declared so.

        A subclass that checks several settings against each other does so after this.
        """
        for setting in declared(type(self)):
            name = f"{type(self).__name__}.{setting.name}"
            value = checked(setting.kind, setting.range, getattr(self, setting.name), name)
            object.__setattr__(self, setting.name, value)

    @classmethod
    def from_dict(cls: type[Chosen], table: Mapping[str, Any], where: str = "settings") -> Chosen:
        """From nested mappings, as TOML gives them; what is absent keeps its default.

        `where` names the table in errors; "" is the top of a file, whose settings stand under no name.

        Raises:
            D2Error: an unknown name, with the nearest one suggested; a value of the wrong type or out of range.
        """
        if not isinstance(table, Mapping):
            raise D2Error(f"{where} must be a table of settings, got {shown(table)}: write [{where}] above them")
        known = {setting.name: setting for setting in declared(cls)}
        for name in table:
            if name not in known:
                raise unknown_name(f"setting of {where}" if where else "setting", str(name), known)
        above = f"{where}." if where else ""
        given = {name: _from_plain(known[name], value, f"{above}{name}") for name, value in table.items()}
        missing = [name for name, setting in known.items() if setting.default is MISSING and name not in given]
        if missing:
            raise D2Error(f"{where or 'the settings'} must have {', '.join(missing)}: add what is missing")
        return cls(**given)


def declared(kind: Any) -> tuple[Declared, ...]:
    """The declarations of all settings of a class, those of its bases first."""
    return _declared(kind)


@functools.cache
def _declared(kind: Any) -> tuple[Declared, ...]:
    hints = hints_of(kind)
    found = []
    for entry in fields(kind):
        default = entry.default if entry.default_factory is MISSING else entry.default_factory()
        bare, limits = bare_and_range(hints[entry.name])
        by_place = any(isinstance(extra, Positional) for extra in get_args(hints[entry.name])[1:])
        found.append(Declared(entry.name, bare, default, Range() if limits == UNBOUNDED else limits, by_place, kind))
    return tuple(found)


def of_this_format(table: Mapping[str, Any], place: str) -> dict[str, Any]:
    """The settings of a file without its `version`, which must be `FORMAT`; a file that has none is of version 1."""
    if not isinstance(table, Mapping):
        raise D2Error(f"{place} must be a table of settings, got {shown(table)}: give a file, a mapping or a D2Config")
    version = table.get("version", 1)
    if version != FORMAT or isinstance(version, bool):
        raise D2Error(
            f"{place} has settings of version {shown(version)}, and this d2-4dgs reads version {FORMAT}: "
            "use the d2-4dgs that wrote it, or write it anew"
        )
    return {name: value for name, value in table.items() if name != "version"}


def table_of(kind: Any) -> type[Settings] | None:
    """The Settings that a declared kind is, or may be; None where it is a plain value."""
    for option in options_of(kind):
        if isinstance(option, type) and is_dataclass(option) and issubclass(option, Settings):
            return option
    return None


def _from_plain(setting: Declared, value: Any, where: str) -> Any:
    """A table becomes the Settings that are declared there, "none" nothing; anything else is checked as it is."""
    options = options_of(setting.kind)
    if isinstance(value, str) and value == NONE and type(None) in options and str not in options:
        return None
    kind = table_of(setting.kind)
    if kind is None or isinstance(value, kind) or (value is None and kind is not setting.kind):
        return checked(setting.kind, setting.range, value, where)
    return kind.from_dict(value, where)


def _first_line(kind: type | None) -> str:
    return "" if kind is None or not kind.__doc__ else kind.__doc__.strip().splitlines()[0]


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """The strings that stand under the fields of a class and of its bases; none where there is no source."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_dataclass(base):
            continue
        try:
            module = ast.parse(textwrap.dedent(inspect.getsource(base)))
        except (OSError, TypeError):
            continue
        body = cast(ast.ClassDef, module.body[0]).body
        for field, below in zip(body, body[1:]):  # noqa: RUF007  newer than Python 3.9
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
                text = below.value.value if isinstance(below.value, ast.Constant) else None
                if isinstance(text, str):
                    found[field.target.id] = " ".join(text.split())
    return found
