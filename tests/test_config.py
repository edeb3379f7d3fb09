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
        (D2Config.from_dict, {"densify": {"every": 0}}, r"densify\.every must be at least 1 steps, got 0"),
        (D2Config.from_dict, {"prune": {"lambda_e": math.nan}}, r"prune\.lambda_e must be at least 0 and .*, got nan"),
        (D2Config.from_dict, {"depth_loss": {"epsilon": 0}}, r"depth_loss\.epsilon must be above 0, got 0"),
        (D2Config.from_dict, {"remove_at_most": 0}, r"remove_at_most must be above 0 and at most 1"),
        (D2Config.from_dict, {"prior": 3}, r"prior must be text, got 3"),
        (D2Config.from_dict, {"prune": 3}, r"prune must be a table of settings, got 3: write \[prune\] above them"),
        (D2Config.from_dict, {"view_per_evaluation": 3}, r"unknown setting 'view_per.*did you mean 'views_per_eval"),
        (D2Config.from_dict, {"version": 2}, r"the configuration has settings of version 2, and this d2-4dgs reads"),
        (deform.settings_from, {"raster": {"near": -1}}, r"backbone\.raster\.near must be above 0 world units, got -1"),
        (
            deform.settings_from,
            {"hexplane": {"resolutions": [8, 0]}},
            r"resolutions\[1\] must be at least 1 and at most 512, got 0",
        ),
        (deform.settings_from, {"hexplane": {"resolutions": []}}, r"resolutions has 0 levels: give one to eight"),
        (deform.settings_from, {"hexplane": {"resolutions": [1] * 9}}, r"resolutions has 9 levels: give one to eight"),
        (deform.settings_from, {"hexplane": {"instants": 1001}}, r"instants must be .* at most 1000"),
        (deform.settings_from, {"mlp": {"width": 8192}}, r"width must be .* at most 1024"),
        (deform.settings_from, {"field": "hexplan"}, r"unknown backbone\.field 'hexplan': have hexplane, mlp; did you"),
        (
            deform.settings_from,
            {"mlp": {"widht": 3}},
            r"unknown setting of backbone\.mlp 'widht'.*did you mean 'width'",
        ),
        (PriorSettings.from_dict, {"depth_range": [1, 2, 3]}, "depth_range must be a list of 2 values, got .1, 2, 3."),
        (PriorSettings.from_dict, {"depth_range": [9.0, 1.0]}, "0 < near < far"),
        (
            PriorSettings.from_dict,
            {"depth_range": [1.0, math.inf]},
            r"depth_range\[1\] must be above 0 and at most 1e.09, got inf",
        ),
        (PriorSettings.from_dict, {"variant": "duel"}, "unknown priors.variant 'duel': .* did you mean 'dual'"),
        (PriorSettings.from_dict, {"stereo": {"matchers": "x"}}, "unknown setting of priors.stereo 'matchers'"),
        (PriorSettings.from_dict, {"stereo": {"min_angle": 60.0}}, "min_angle must be below max_angle, got 60 and 60"),
        (run, {"iterations": 0}, r"RunSettings\.iterations must be at least 1 steps, got 0"),
        (run, {"device": "gpu"}, r"unknown RunSettings\.device 'gpu': have cpu, cuda"),
        (run, {"mono_onnx": "net.onnx"}, r"--mono-onnx needs --mono-kind"),
        (run, {"hooks": ("prun",)}, r"unknown hook 'prun'.*did you mean 'prune'"),
        (run, {"overrides": {"plan": {"temporal": "maybe"}}}, r"plan\.temporal must be true or false, got 'maybe'"),
        (run, {"overrides": {"plan": {"temporl": True}}}, r"unknown decision of plan 'temporl'.*did you mean 'tempor"),
        (run, {"overrides": {"plan": True}}, r"plan must be a table of settings, got True"),
        (run, {"hooks": (), "overrides": {"prune": {"tau_p": 3}}}, r"prune\.tau_p must be at least 0 and at most 1"),
        (run, {"overrides": {"d2": {"views_per_evaluation": 0}}}, r"views_per_evaluation must be at least 1, got 0"),
        (run, {"overrides": {"backbone": {"sh_degree": 9}}}, r"backbone\.sh_degree must be"),
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
