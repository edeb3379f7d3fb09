"""Settings: one declaration each; what is wrong is one sentence that names it, what is right stays, in files too."""

from __future__ import annotations

import importlib
import json
import math
import os
import pkgutil
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import MISSING, asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from tiny import ALL_HOOKS

import d2_plugin
from d2_plugin import D2Config
from d2_plugin.backbones import deform
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.runs.settings import RunSettings, check
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
            refuses(rf"Example\.{name}", Example, **{name: value})
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
    assert Example(levels=range(3, 5)).levels == Example(levels=np.array([3, 4])).levels == (3, 4)
    assert Example(name=Path("a/b")).name == "a/b"
    for unordered in ({3, 4}, {3: 4}, "34", iter([3, 4])):
        refuses("levels must be a list", Example, levels=unordered)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"start": -1}, r"setting run\.start must be at least 0 steps, got -1"),
        ({"weight": 0}, r"setting run\.weight must be above 0, got 0"),
        ({"weight": 10**400}, r"setting run\.weight must be a number below 1.8e308 in size, got 1000.* \.\.\.$"),
        ({"weight": "much"}, r"setting run\.weight must be a number, got 'much'"),
        ({"on": 1}, r"setting run\.on must be true or false, got 1"),
        ({"start": 1.5}, r"setting run\.start must be a whole number, got 1.5"),
        ({"kind": "metrc"}, r"unknown run\.kind 'metrc': have metric, relative; did you mean 'metric'\?"),
        ({"kind": 3}, r"setting run\.kind must be one of relative, metric, got 3"),
        ({"tau": [1]}, r"setting run\.tau must be one of auto or a number, got \[1\]"),
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
    refuses(sentence, Example.from_dict, table, "run")


def test_a_setting_without_a_default_is_asked_for() -> None:
    @dataclass(frozen=True)
    class Needy(Settings):
        name: str
        count: Count = 0

    refuses("recording must have name: add what is missing", Needy.from_dict, {"count": 1}, "recording")
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


def test_every_number_among_the_settings_is_one_and_has_both_bounds_and_every_default_is_allowed_in_files() -> None:
    classes = every_settings_class()
    assert len(classes) > 20
    for kind in classes:
        plain = {}
        for setting in declared(kind):
            place = (kind, setting.name)
            for number, limits in numbers_in(setting.kind, setting.range):
                assert not limits.holds(number(10**25)), place
                assert not limits.holds(number(-(10**25))), place
                assert not (limits.low and limits.holds(1e-320)), place
                assert not limits.holds(math.nan), place
                assert limits.infinite or number is int or not limits.holds(math.inf), place
            if setting.default is not MISSING and table_of(setting.kind) is None:
                plain[setting.name] = setting.default
            if type(setting.default) in (int, float):
                for wrong in ("much", [1], True):
                    refuses(setting.name, kind.from_dict, {setting.name: wrong})
        if all(setting.default is not MISSING for setting in declared(kind)):
            assert kind.from_dict(plain) == kind()


def run(table: dict[str, Any]) -> RunSettings:
    return check(RunSettings("room", ("a",), **table))


@pytest.mark.parametrize(
    ("read", "table", "sentence"),
    [
        (D2Config.from_dict, {"view_per_evaluation": 3}, r"unknown setting 'view_per.*did you mean 'views_per_eval"),
        (deform.settings_from, {"hexplane": {"resolutions": []}}, r"resolutions has 0 levels: give one to eight"),
        (deform.settings_from, {"hexplane": {"resolutions": [1] * 9}}, r"resolutions has 9 levels: give one to eight"),
        (PriorSettings.from_dict, {"depth_range": [9.0, 1.0]}, "0 < near < far"),
        (PriorSettings.from_dict, {"stereo": {"min_angle": 60.0}}, "min_angle must be below max_angle, got 60 and 60"),
        (run, {"overrides": {"plan": {"temporl": True}}}, r"unknown decision of plan 'temporl'.*did you mean 'tempor"),
        (run, {"overrides": {"d2": {"densify": 5}}}, r"d2\.densify is a table of its own"),
        (run, {"overrides": {"training": {"seed": 5}}}, r"training\.seed is a setting of the run: give it as --seed"),
        (run, {"overrides": {"prunes": {}}}, r"unknown table 'prunes'.*did you mean 'prune'"),
        (run, {"overrides": {"version": 1, "prior": "priors"}}, r"is a d2\.toml, .* under \[d2\], and leave out"),
    ],
)
def test_what_cannot_be_meant_is_one_sentence(read: Callable, table: dict[str, Any], sentence: str) -> None:
    refuses(sentence, read, table)


@settings(max_examples=40)
@given(
    st.builds(
        D2Config,
        prior=st.none() | st.text(min_size=1),
        densify=st.none()
        | st.builds(DensifyConfig, stop=st.none() | st.integers(0, 9), tau_u_mono=st.just(math.inf) | st.floats(0, 9)),
        prune=st.none() | st.builds(PruneConfig, stop=st.none() | st.integers(0, 9), tau_p=st.floats(0, 1)),
        seed=st.integers(0, 2**63 - 1),
    )
)
def test_any_configuration_survives_toml(config: D2Config) -> None:
    assert D2Config.from_dict(tomllib.loads(config.to_toml())) == config


def test_a_file_says_its_version_and_paths_are_its_folders(tmp_path: Path) -> None:
    path = tmp_path / "d2.toml"
    text = ALL_HOOKS.to_toml()
    assert tomllib.loads(text)["version"] == 1
    path.write_text(text.replace("version = 1", ""))
    assert D2Config.from_toml(path) == ALL_HOOKS
    path.write_text(text.replace("version = 1", "version = 7"))
    refuses(r"d2\.toml has settings of version 7, and this d2-4dgs reads version 1: use the", D2Config.from_toml, path)
    path.write_text('prior = "maps"\n[densify]\n')
    assert D2Config.from_toml(path).prior == str(tmp_path / "maps")
    path.write_text(replace(ALL_HOOKS, prior="/somewhere").to_toml())
    assert D2Config.from_toml(path).prior == "/somewhere"
    path.write_text('prior = "~/maps"\n[densify]\n')
    assert D2Config.from_toml(path).prior == os.path.expanduser("~/maps")
    assert Example(folder="~/a").folder == Path.home() / "a"
    path.write_text("[densify\n")
    refuses("as TOML", D2Config.from_toml, path)


def test_a_run_survives_its_file_and_names_another_version() -> None:
    settings = run({"frames": (0, 2), "overrides": {"prune": {"tau_p": 0.5}}})
    table = settings.as_table()
    assert table["version"] == 1
    assert RunSettings.from_table(table, "run.json") == settings
    assert RunSettings.from_table({k: v for k, v in table.items() if k != "version"}, "run.json") == settings
    refuses(r"run\.json has settings of version 9", RunSettings.from_table, table | {"version": 9}, "run.json")


@pytest.mark.parametrize("settings", [PriorSettings(), PriorSettings.paper(depth_range=(1, 9))])
def test_a_record_of_the_settings_of_priors_gives_them_back(settings: PriorSettings) -> None:
    assert PriorSettings.from_dict(json.loads(json.dumps(asdict(settings)))) == settings
