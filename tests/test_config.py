"""Every setting of hooks, backbones, rasterizer and runs: what cannot be is refused in one sentence, files keep all."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny import ALL_HOOKS

from d2_plugin import D2Config, D2Error
from d2_plugin.backbones import deform
from d2_plugin.config import DensifyConfig, PruneConfig
from d2_plugin.runs.settings import RunSettings, check


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"densify": {"budget_per_view": -5}}, r"densify\.budget_per_view must be at least 0, got -5"),
        ({"densify": {"scale": -1}}, r"densify\.scale must be at least 0\.001 and at most 1000, got -1"),
        ({"densify": {"opacity": 2}}, r"densify\.opacity must be above 0 and at most 1, got 2"),
        ({"densify": {"tau_v": math.nan}}, r"densify\.tau_v must be at least 0 and at most 1, got nan"),
        ({"densify": {"every": 0}}, r"densify\.every must be at least 1 steps, got 0"),
        ({"densify": {"start": 1.5}}, r"densify\.start must be a whole number, got 1\.5"),
        ({"densify": {"stop": "late"}}, r"densify\.stop must be a whole number, got 'late'"),
        ({"prune": {"lambda_e": math.nan}}, r"prune\.lambda_e must be at least 0 and at most 1, got nan"),
        ({"prune": {"patience": 0}}, r"prune\.patience must be at least 1 and at most 1000, got 0"),
        ({"prune": {"patience": True}}, r"prune\.patience must be a whole number, got True"),
        ({"depth_loss": {"weight": -0.1}}, r"depth_loss\.weight must be at least 0, got -0\.1"),
        ({"depth_loss": {"epsilon": 0}}, r"depth_loss\.epsilon must be above 0, got 0"),
        ({"views_per_evaluation": -3}, r"views_per_evaluation must be at least 1, got -3"),
        ({"prior_memory_mb": 0}, r"prior_memory_mb must be at least 1 MB, got 0"),
        ({"seed": -1}, r"seed must be at least 0, got -1"),
        ({"prior": 3}, r"prior must be text, got 3"),
        ({"prune": 3}, r"prune must be a table of settings, got 3: write \[prune\] above them"),
        ({"view_per_evaluation": 3}, r"unknown setting 'view_per_evaluation'.*did you mean 'views_per_evaluation'"),
        ({"version": 2}, r"the configuration has settings of version 2, and this d2-4dgs reads version 1"),
    ],
)
def test_a_wrong_configuration_is_one_sentence(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(D2Error, match=sentence):
        D2Config.from_dict(table)


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


def test_a_file_says_its_version_and_another_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d2.toml"
    path.write_text(ALL_HOOKS.to_toml())
    assert tomllib.loads(path.read_text())["version"] == 1
    path.write_text(ALL_HOOKS.to_toml().replace("version = 1", ""))
    assert D2Config.from_toml(path) == ALL_HOOKS
    path.write_text(ALL_HOOKS.to_toml().replace("version = 1", "version = 7"))
    with pytest.raises(D2Error, match=r"d2\.toml has settings of version 7, and this d2-4dgs reads version 1: use the"):
        D2Config.from_toml(path)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"position_rate": 0}, r"backbone\.position_rate must be above 0 and at most 100, got 0"),
        ({"sh_degree": 4}, r"backbone\.sh_degree must be at least 0 and at most 3, got 4"),
        ({"densify": {"every": 0}}, r"backbone\.densify\.every must be at least 1 steps, got 0"),
        ({"raster": {"near": -1}}, r"backbone\.raster\.near must be above 0 world units, got -1"),
        ({"raster": {"alpha_max": 1}}, r"backbone\.raster\.alpha_max must be above 0 and below 1, got 1"),
        ({"mlp": {"width": 0}}, r"backbone\.mlp\.width must be at least 1 and at most 8192, got 0"),
        (
            {"hexplane": {"resolutions": [8, 0]}},
            r"hexplane\.resolutions\[1\] must be at least 1 and at most 1024, got 0",
        ),
        ({"hexplane": {"resolutions": []}}, r"resolutions has no level: give at least one"),
        ({"field": "hexplan"}, r"unknown backbone\.field 'hexplan': have hexplane, mlp; did you mean 'hexplane'"),
        ({"mlp": {"widht": 3}}, r"unknown setting of backbone\.mlp 'widht'.*did you mean 'width'"),
    ],
)
def test_a_wrong_backbone_is_one_sentence(table: dict[str, Any], sentence: str) -> None:
    with pytest.raises(D2Error, match=sentence):
        deform.settings_from(table)


RUN = RunSettings("room", ("a",))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"iterations": 0}, r"RunSettings\.iterations must be at least 1 steps, got 0"),
        ({"seed": -1}, r"RunSettings\.seed must be at least 0"),
        ({"downscale": 0}, r"RunSettings\.downscale must be at least 1, got 0"),
        ({"device": "gpu"}, r"unknown RunSettings\.device 'gpu': have cpu, cuda"),
        ({"mono_kind": "relativ"}, r"unknown RunSettings\.mono_kind 'relativ'.*did you mean 'relative'"),
        ({"mono_onnx": "net.onnx"}, r"--mono-onnx needs --mono-kind"),
        ({"hooks": ("prun",)}, r"unknown hook 'prun'.*did you mean 'prune'"),
        ({"overrides": {"plan": {"temporal": "maybe"}}}, r"plan\.temporal must be true or false, got 'maybe'"),
        ({"overrides": {"plan": {"temporl": True}}}, r"unknown decision of plan 'temporl'.*did you mean 'temporal'"),
        ({"overrides": {"plan": True}}, r"plan must be a table of settings, got True"),
        ({"overrides": {"prune": {"tau_p": 3}}}, r"prune\.tau_p must be at least 0 and at most 1, got 3"),
        ({"overrides": {"prune": 3}}, r"prune must be a table of settings, got 3"),
        ({"hooks": (), "overrides": {"prune": {"tau_p": 3}}}, r"prune\.tau_p must be at least 0 and at most 1, got 3"),
        ({"overrides": {"d2": {"views_per_evaluation": 0}}}, r"views_per_evaluation must be at least 1, got 0"),
        ({"overrides": {"backbone": {"sh_degree": 9}}}, r"backbone\.sh_degree must be"),
        ({"overrides": {"prunes": {}}}, r"unknown table 'prunes'.*did you mean 'prune'"),
    ],
)
def test_a_wrong_run_is_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(D2Error, match=sentence):
        check(replace(RUN, **changes))


def test_a_run_survives_its_file_and_names_another_version() -> None:
    settings = check(replace(RUN, frames=(0, 2), overrides={"prune": {"tau_p": 0.5}}))
    table = settings.as_table()
    assert table["version"] == 1
    assert RunSettings.from_table(table, "run.json") == settings
    assert RunSettings.from_table({k: v for k, v in table.items() if k != "version"}, "run.json") == settings
    with pytest.raises(D2Error, match=r"run\.json has settings of version 9"):
        RunSettings.from_table(table | {"version": 9}, "run.json")
