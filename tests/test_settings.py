"""One declaration per setting: whatever is wrong is refused in one sentence that names it, whatever is right stays."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import d2_plugin
from d2_plugin import D2Config
from d2_plugin.backbones.deform import DeformSettings
from d2_plugin.backbones.trainer import TrainSettings
from d2_plugin.backbones.yang4d import Yang4DSettings
from d2_plugin.errors import D2Error
from d2_plugin.hooks import HOOKS
from d2_plugin.protocol import RasterSettings
from d2_plugin.settings import (
    AtLeastOne,
    Count,
    Positional,
    Positive,
    Range,
    Seed,
    Settings,
    Share,
    Steps,
    declared,
    table_of,
)
from d2_plugin.values import UNBOUNDED, bare_and_range


@dataclass(frozen=True)
class Inner(Settings):
    """A table inside.

    Its second line.
    """

    part: Share = 0.5


@dataclass(frozen=True)
class Base(Settings):
    """What two have in common."""

    start: Steps = 1
    """The first step
    of all."""


@dataclass(frozen=True)
class Example(Base):
    """One setting of each kind."""

    name: Annotated[str, Positional()] = "studio"
    kind: Literal["relative", "metric"] = "relative"
    """What the network returns."""
    weight: Positive = 1.0
    reach: Annotated[float, Range(0, infinite=True, unit="m")] = math.inf
    share: Share = 0.5
    stop: Steps | None = None
    tau: Literal["auto"] | Positive = "auto"
    levels: tuple[AtLeastOne, ...] = (1, 2)
    bounds: tuple[Positive, Positive] | None = None
    folder: Path | None = None
    on: bool = True
    seed: Seed = 0
    inner: Inner = field(default_factory=Inner)
    maybe: Inner | None = None


NAMES = {setting.name: setting for setting in declared(Example)}

ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.just(10**400),
    st.just(-(10**5000)),
    st.floats(allow_nan=True, allow_infinity=True),
    st.text(max_size=5),
    st.sampled_from(["auto", "relative", "metric"]),
    st.lists(st.one_of(st.integers(-3, 3), st.floats(), st.text(max_size=2), st.none()), max_size=3),
    st.dictionaries(st.sampled_from(["part", "parts"]), st.floats(), max_size=1),
    st.builds(object),
    st.floats().map(np.float64),
    st.integers(-5, 5).map(np.int64),
    st.booleans().map(np.bool_),
    st.floats(width=32).map(torch.tensor),
    st.just(np.zeros(3)),
    st.just(Inner()),
)


@given(st.sampled_from(sorted(NAMES)), ANYTHING)
def test_any_value_is_refused_in_one_sentence_with_its_name_or_kept_and_python_is_checked_as_files_are(
    name: str, value: Any
) -> None:
    try:
        made = Example.from_dict({name: value}, "run")
    except D2Error as refusal:
        sentence = str(refusal)
        assert f"run.{name}" in sentence
        assert "\n" not in sentence
        if not isinstance(value, dict):  # which only files have in the place of settings
            with pytest.raises(D2Error, match=rf"Example\.{name}"):
                Example(**{name: value})
        return
    kept = getattr(made, name)
    assert Example(**{name: kept}) == made
    for number in kept if isinstance(kept, tuple) else (kept,):
        limits = Range(1) if name == "levels" else Range(1e-9) if name == "bounds" else NAMES[name].range
        assert not isinstance(number, (int, float)) or isinstance(number, bool) or limits.holds(number)


def test_whole_numbers_become_floats_and_lists_tuples() -> None:
    made = Example(weight=2, levels=[3, 4], bounds=[1, 2], folder="a/b")
    assert (made.weight, made.levels, made.bounds, made.folder) == (2.0, (3, 4), (1.0, 2.0), Path("a/b"))
    assert isinstance(made.weight, float)
    assert isinstance(Example(start=np.int64(3)).start, int)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"start": -1}, r"setting run\.start must be at least 0 steps, got -1"),
        ({"share": 2}, r"setting run\.share must be at least 0 and at most 1, got 2"),
        ({"share": math.nan}, r"setting run\.share must be at least 0 and at most 1, got nan"),
        ({"weight": 0}, r"setting run\.weight must be above 0, got 0"),
        ({"weight": 10**400}, r"setting run\.weight must be a number below 1.8e308 in size, got 1000.* \.\.\.$"),
        ({"weight": "much"}, r"setting run\.weight must be a number, got 'much'"),
        ({"on": 1}, r"setting run\.on must be true or false, got 1"),
        ({"start": 1.5}, r"setting run\.start must be a whole number, got 1.5"),
        ({"kind": "metrc"}, r"unknown run\.kind 'metrc': have metric, relative; did you mean 'metric'\?"),
        ({"kind": 3}, r"setting run\.kind must be one of relative, metric, got 3"),
        ({"tau": [1]}, r"setting run\.tau must be one of auto or a number, got \[1\]"),
        ({"tau": -1}, r"setting run\.tau must be above 0, got -1"),
        ({"tau": "aut"}, r"unknown run\.tau 'aut': have auto; did you mean 'auto'\?"),
        ({"levels": [1, 0]}, r"setting run\.levels\[1\] must be at least 1, got 0"),
        ({"bounds": [1]}, r"setting run\.bounds must be a list of 2 values, got \[1\]"),
        ({"strat": 3}, r"unknown setting of run 'strat': have .*; did you mean 'start'\?"),
        ({"inner": 3}, r"run\.inner must be a table of settings, got 3: write \[run\.inner\] above them"),
        ({"inner": {"prat": 1}}, r"unknown setting of run\.inner 'prat': have part; did you mean 'part'\?"),
        ({"inner": {"part": 2}}, r"setting run\.inner\.part must be at least 0 and at most 1, got 2"),
    ],
)
def test_a_mistake_is_told_with_what_was_expected_and_what_to_do(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(D2Error, match=sentence):
        Example.from_dict(table, "run")


def test_a_setting_without_a_default_is_asked_for() -> None:
    @dataclass(frozen=True)
    class Needy(Settings):
        name: str
        count: Count = 0

    with pytest.raises(D2Error, match="recording must have name: add what is missing"):
        Needy.from_dict({"count": 1}, "recording")
    assert declared(Needy)[0].default is MISSING


def every_settings_class() -> list[type[Settings]]:
    """All classes of settings of the package, the bundled backbones' too."""
    packages = [d2_plugin, importlib.import_module("d2_plugin.backbones")]
    for package in packages:
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    found, left = [], [Settings]
    while left:
        left += (kinds := left.pop().__subclasses__())
        found += [kind for kind in kinds if kind.__module__.startswith("d2_plugin")]
    return found


def numbers_in(kind: Any, limits: Range) -> Iterator[tuple[Any, Range]]:
    """The numbers that a declared kind holds, with the range of each."""
    bare, own = bare_and_range(kind)
    limits = limits if own == UNBOUNDED else own
    if bare in (int, float):
        yield bare, limits
    if get_origin(bare) is not Literal:
        for inner in get_args(bare):
            yield from numbers_in(inner, limits)


def test_every_number_among_the_settings_has_both_bounds() -> None:
    classes = every_settings_class()
    assert len(classes) > 20
    without = [
        f"{kind.__module__}.{kind.__name__}.{setting.name}"
        for kind in classes
        for setting in declared(kind)
        for number, limits in numbers_in(setting.kind, setting.range)
        if limits.holds(number(10**25)) or limits.holds(number(-(10**25))) or (limits.low and limits.holds(1e-320))
    ]
    assert without == []


def test_no_number_takes_what_is_none_and_every_default_is_allowed_in_files() -> None:
    for kind in every_settings_class():
        plain = {}
        for setting in declared(kind):
            for number, limits in numbers_in(setting.kind, setting.range):
                assert not limits.holds(math.nan), (kind, setting.name)
                assert limits.infinite or number is int or not limits.holds(math.inf), (kind, setting.name)
            if setting.default is not MISSING and table_of(setting.kind) is None:
                plain[setting.name] = setting.default
            if type(setting.default) in (int, float):
                for wrong in ("much", [1], True):
                    with pytest.raises(D2Error, match=setting.name):
                        kind.from_dict({setting.name: wrong})
        if all(setting.default is not MISSING for setting in declared(kind)):
            assert kind.from_dict(plain) == kind()


@pytest.mark.parametrize(
    "kind",
    [D2Config, TrainSettings, Yang4DSettings, DeformSettings, RasterSettings, *(row.config for row in HOOKS.values())],
)
def test_every_setting_of_hooks_and_backbones_has_help(kind: type[Settings]) -> None:
    assert [setting.name for setting in declared(kind) if not setting.help] == []
