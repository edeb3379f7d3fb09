"""Every setting of hooks, backbones, priors and runs: what cannot be is refused in one sentence, files keep all."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import ALL_HOOKS

from d2_plugin import D2Config, D2Error
from d2_plugin.backbones import deform
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.priors.settings import PriorSettings
from d2_plugin.runs.settings import RunSettings, check

RUN = RunSettings("room", ("a",))


def run(table: dict[str, Any]) -> RunSettings:
    return check(replace(RUN, **table))


@pytest.mark.parametrize(
    ("read", "table", "sentence"),
    [
        (D2Config.from_dict, {"view_per_evaluation": 3}, r"unknown setting 'view_per.*did you mean 'views_per_eval"),
        (D2Config.from_dict, {"version": 2}, r"the configuration has settings of version 2, and this d2-4dgs reads"),
        (deform.settings_from, {"hexplane": {"resolutions": []}}, r"resolutions has 0 levels: give one to eight"),
        (deform.settings_from, {"hexplane": {"resolutions": [1] * 9}}, r"resolutions has 9 levels: give one to eight"),
        (deform.settings_from, {"field": "hexplan"}, r"unknown backbone\.field 'hexplan': have hexplane, mlp; did you"),
        (PriorSettings.from_dict, {"depth_range": [9.0, 1.0]}, "0 < near < far"),
        (PriorSettings.from_dict, {"stereo": {"min_angle": 60.0}}, "min_angle must be below max_angle, got 60 and 60"),
        (run, {"mono_onnx": "net.onnx"}, r"--mono-onnx needs --mono-kind"),
        (run, {"hooks": ("prun",)}, r"unknown hook 'prun'.*did you mean 'prune'"),
        (run, {"overrides": {"plan": {"temporl": True}}}, r"unknown decision of plan 'temporl'.*did you mean 'tempor"),
        (run, {"overrides": {"d2": {"densify": 5}}}, r"d2\.densify is a table of its own"),
        (run, {"overrides": {"prunes": {}}}, r"unknown table 'prunes'.*did you mean 'prune'"),
    ],
)
def test_what_cannot_be_meant_is_one_sentence(read: Callable, table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(D2Error, match=sentence) as refusal:
        read(table)
    assert "\n" not in str(refusal.value)


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
    with pytest.raises(D2Error, match=r"d2\.toml has settings of version 7, and this d2-4dgs reads version 1: use the"):
        D2Config.from_toml(path)
    path.write_text('prior = "maps"\n[densify]\n')
    assert D2Config.from_toml(path).prior == str(tmp_path / "maps")
    path.write_text(replace(ALL_HOOKS, prior="/somewhere").to_toml())
    assert D2Config.from_toml(path).prior == "/somewhere"
    path.write_text("[densify\n")
    with pytest.raises(D2Error, match="not valid TOML"):
        D2Config.from_toml(path)


def test_a_run_survives_its_file_and_names_another_version() -> None:
    settings = run({"frames": (0, 2), "overrides": {"prune": {"tau_p": 0.5}}})
    table = settings.as_table()
    assert table["version"] == 1
    assert RunSettings.from_table(table, "run.json") == settings
    assert RunSettings.from_table({k: v for k, v in table.items() if k != "version"}, "run.json") == settings
    with pytest.raises(D2Error, match=r"run\.json has settings of version 9"):
        RunSettings.from_table(table | {"version": 9}, "run.json")


@pytest.mark.parametrize("settings", [PriorSettings(), PriorSettings.paper(depth_range=(1, 9))])
def test_a_record_of_the_settings_of_priors_gives_them_back(settings: PriorSettings) -> None:
    assert PriorSettings.from_dict(json.loads(json.dumps(asdict(settings)))) == settings
