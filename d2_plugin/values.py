"""One value against its declared kind and range, and names for the common kinds of number."""

from __future__ import annotations

import functools
import inspect
import math
import os
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.older import hints_of

MOST = 1e9
"""A declared number that says no bound is of at most this size."""

FAR, TINY = 1e4, 1e-6
"""A bound of at least this size, and one above 0 of at most this, is named only where it was crossed."""

LISTS = (Iterable, Sequence, Collection)
"""Annotations of arguments that any iterable fits."""

UNIONS = (Union, getattr(types, "UnionType", Union))
"""What `get_origin` says of `Union[A, B]` and of `A | B`, which Python 3.9 does not evaluate yet."""


@dataclass(frozen=True)
class Range:
    """Where a number may lie, and its unit. Infinity is refused unless allowed."""

    low: float = -MOST
    high: float = MOST
    unit: str = ""
    open_low: bool = False
    """The lower bound itself is refused."""
    open_high: bool = False
    """The upper bound itself is refused."""
    infinite: bool = False
    """Infinity is allowed."""

    def holds(self, value: float) -> bool:
        """Whether `value`, whole or not, lies inside; NaN never does."""
        if isinstance(value, float) and (math.isnan(value) or (math.isinf(value) and not self.infinite)):
            return False
        above = value > self.low or (value == self.low and not self.open_low)
        below = value < self.high or (value == self.high and not self.open_high)
        return (above and below) or (self.infinite and value == math.inf)

    def described(self, value: float = 0) -> str:
        """The bounds in words; those far away only where `value` crossed them."""
        low = f"{'above' if self.open_low else 'at least'} {self.low:g}"
        if 0 < self.low <= TINY and not 0 < value < self.low:
            low = "above 0"
        high = f"{'below' if self.open_high else 'at most'} {self.high:g}"
        near = (low, self.low > -FAR or value < self.low), (high, self.high < FAR or value > self.high)
        return " and ".join(bound for bound, named in near if named) or "finite"


UNBOUNDED = Range(-math.inf, math.inf)
"""Of a number in a file or an argument that declares no range; among settings it is `Range()`."""


class OutOfRange(D2Error):
    """A value of the right type that lies outside its declared range."""


def options_of(kind: Any) -> tuple[Any, ...]:
    """The kinds of which a value may be: the members of a union, else the kind itself."""
    return get_args(kind) if get_origin(kind) in UNIONS else (kind,)


def checked(kind: Any, limits: Range, value: Any, name: str) -> Any:
    """`value` as the declared kind, or a D2Error that names the setting.

    `kind` and `limits` are what `Declared.kind` and `Declared.range` hold.
    """
    return _checked(kind, limits, value, f"setting {name}")


def fitting(kind: Any, value: Any, name: str) -> Any:
    """`value` as `kind`, an annotation with or without a range, or a D2Error that calls it by `name`."""
    return _checked(*bare_and_range(kind), value, name)


def _checked(kind: Any, limits: Range, value: Any, name: str) -> Any:
    options = options_of(kind)
    if value is None and type(None) in options:
        return None
    options = tuple(option for option in options if option is not type(None))
    if len(options) == 1:
        return _as_kind(*_inner(options[0], limits), value, name)
    unfit: D2Error | None = None
    for option in options:
        try:
            return _as_kind(*_inner(option, limits), value, name)
        except D2Error as error:
            says_more = isinstance(error, OutOfRange) or (isinstance(value, str) and _is_choice(option))
            unfit = error if says_more and unfit is None else unfit
    raise unfit or _wrong(name, "must be " + " or ".join(_noun(_inner(option, limits)[0]) for option in options), value)


def _as_kind(kind: Any, limits: Range, value: Any, name: str) -> Any:
    """`value` as one kind that is no union; a number of numpy or torch is the Python number that it holds."""
    origin = get_origin(kind) or kind
    value = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
    if _is_choice(kind):
        return _as_choice(kind, value, name)
    if origin is tuple:
        return _as_tuple(get_args(kind), limits, value, name)
    if origin in LISTS and isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
        item = (*get_args(kind), Any)[0]
        return tuple(_checked(*_inner(item, limits), one, f"an item of {name}") for one in value)
    if kind in (int, float):
        return _as_number(kind, limits, value, name)
    if (
        kind in (str, Path) and isinstance(value, (str, Path)) and str(value).startswith("~/")
    ):  # no shell expands it in a file, or behind --flag=
        value = os.path.expanduser(str(value))
    if kind is str and isinstance(value, Path):
        return str(value)
    if kind is Path and isinstance(value, (str, Path)) and str(value) != "" and "\0" not in str(value):
        return Path(value)  # no text at all would be the current folder, and a zero byte ends a name
    if kind is Path or origin in LISTS:
        raise _wrong(name, f"must be {_noun(kind)}", value)
    if origin is Any or not isinstance(origin, type) or getattr(origin, "_is_protocol", False):
        return value  # what cannot be told apart
    if not isinstance(value, origin):
        raise _wrong(name, f"must be {_noun(kind)}", value)
    if isinstance(value, Mapping) and len(get_args(kind)) == 2:
        for key, one in value.items():
            _checked(*_inner(get_args(kind)[1], UNBOUNDED), one, f"{shown(key)} in {name}")
    return value


def _is_choice(kind: Any) -> bool:
    return get_origin(kind) is Literal


def _as_choice(kind: Any, value: Any, name: str) -> Any:
    choices = get_args(kind)
    if any(type(value) is type(choice) and value == choice for choice in choices):
        return value
    if isinstance(value, str) and all(isinstance(choice, str) for choice in choices):
        raise unknown_name(name.removeprefix("setting "), value, choices)
    raise _wrong(name, f"must be {_noun(kind)}", value)


def _as_number(kind: type, limits: Range, value: Any, name: str) -> int | float:
    whole = isinstance(value, int) and not isinstance(value, bool)
    if not whole and not (kind is float and isinstance(value, float)):
        raise _wrong(name, f"must be {_noun(kind)}", value)
    try:
        number = kind(value)
    except OverflowError:
        raise OutOfRange(str(_wrong(name, "must be a number below 1.8e308 in size", value))) from None
    if not limits.holds(number):
        bounds = limits.described(number)
        unit = limits.unit.removesuffix("s") if bounds.endswith(" 1") else limits.unit
        raise OutOfRange(str(_wrong(name, f"must be {bounds} {unit}".rstrip(), value)))
    return number


def _as_tuple(kinds: Sequence[Any], limits: Range, value: Any, name: str) -> tuple[Any, ...]:
    if not isinstance(value, Collection) or isinstance(value, (str, bytes, Mapping, Set)):
        raise _wrong(name, "must be a list", value)
    endless = len(kinds) == 2 and kinds[1] is Ellipsis
    if not endless and len(value) != len(kinds):
        raise _wrong(name, f"must be a list of {len(kinds)} values", value)
    each = [kinds[0]] * len(value) if endless else kinds
    pairs = zip(each, value)
    return tuple(_checked(*_inner(kind, limits), item, f"{name}[{i}]") for i, (kind, item) in enumerate(pairs))


Called = TypeVar("Called", bound=Callable[..., Any])


def checked_arguments(function: Called) -> Called:
    """Hold what a public function is given against its annotations: a D2Error says what was expected and got.

    Where a list of something is declared, any iterable but a text is taken, and handed on as a tuple. What cannot be
    told apart (protocols, arrays of a shape, type variables) passes.
    """
    signature = inspect.signature(function)
    many = {name for name, one in signature.parameters.items() if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD)}

    @functools.wraps(function)
    def guarded(*given: Any, **named: Any) -> Any:
        bound = signature.bind(*given, **named)
        kinds = _kinds_of(function)
        for name in (kinds.keys() & bound.arguments.keys()) - many:
            where = f"{name} of {getattr(function, '__qualname__', function)}"
            bound.arguments[name] = fitting(kinds[name], bound.arguments[name], where)
        return function(*bound.args, **bound.kwargs)

    return cast(Called, guarded)


@functools.cache
def _kinds_of(function: Any) -> dict[str, Any]:
    """The declared kinds of arguments; none where an annotation names what this process never imported."""
    try:
        return {name: kind for name, kind in hints_of(function).items() if name != "return"}
    except NameError:
        return {}


def _inner(kind: Any, limits: Range) -> tuple[Any, Range]:
    """A kind inside a union or tuple, and its range: its own, else that of the whole."""
    bare, own = bare_and_range(kind)
    return bare, own if own != UNBOUNDED else limits


def bare_and_range(hint: Any) -> tuple[Any, Range]:
    """The bare type of an annotation and its range."""
    if get_origin(hint) is Annotated:
        bare, *extras = get_args(hint)
        return bare, next((extra for extra in extras if isinstance(extra, Range)), UNBOUNDED)
    return hint, UNBOUNDED


def _noun(kind: Any) -> str:
    if _is_choice(kind):
        return f"one of {', '.join(map(str, get_args(kind)))}"
    if get_origin(kind) is tuple or get_origin(kind) in LISTS:
        return "a list"
    if get_origin(kind) is Mapping or kind is Mapping:
        return "a table"
    if get_origin(kind) is not None or hasattr(kind, "from_dict"):
        return "a table of settings"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
    return words.get(kind) or f"a {kind.__name__}"


def _wrong(name: str, must: str, value: Any) -> D2Error:
    return D2Error(f"{name} {must}, got {shown(value)}")


def counted(number: int, one: str, form: str = "") -> str:
    """A number of things, each of which is called `one`: `1 frame`, `2 frames`; `form` is that of the number."""
    return f"{number:{form}} {one}{'' if number == 1 else 's'}"


def shown(value: Any) -> str:
    """A value on one short line."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python refuses to write a number of more than some thousand digits
        text = f"a {type(value).__name__} too long to be written"
    return text if len(text) < 80 else text[:76] + " ..."
