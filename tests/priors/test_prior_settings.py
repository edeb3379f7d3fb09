"""Settings of the priors: one declaration each, and one sentence for every value that cannot be meant."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any

import pytest

from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import AlignSettings, PriorSettings, StereoSettings
from d2_plugin.settings import declared


def test_settings_come_from_tables_and_unknown_names_are_refused() -> None:
    settings = PriorSettings.from_dict(
        {"tau_c": 0.2, "depth_range": [1, 9], "stereo": {"matcher": "colmap"}, "align": {"across": False}}
    )
    assert (settings.tau_c, settings.depth_range, settings.stereo.matcher) == (0.2, (1, 9), "colmap")
    assert not settings.align.across
    with pytest.raises(D2Error, match="unknown setting of priors.stereo 'matchers': .* did you mean 'matcher'"):
        PriorSettings.from_dict({"stereo": {"matchers": "colmap"}})
    with pytest.raises(D2Error, match="unknown setting of priors 'tauc': .* did you mean 'tau_c'"):
        PriorSettings.from_dict({"tauc": 0.2})
    with pytest.raises(D2Error, match="priors.tau_c must be a number, got 'small'"):
        PriorSettings.from_dict({"tau_c": "small"})
    with pytest.raises(D2Error, match="priors.stereo.min_sources must be a whole number, got True"):
        PriorSettings.from_dict({"stereo": {"min_sources": True}})
    with pytest.raises(D2Error, match="stereo must be a table"):
        PriorSettings.from_dict({"stereo": "colmap"})
    assert PriorSettings.from_dict({"tau_c": 1}).tau_c == 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"depth_range": [1, 2, 3]}, "depth_range must be a list of 2 values, got .1, 2, 3."),
        ({"depth_range": [0, 3]}, r"depth_range\[0\] must be above 0, got 0"),
        ({"depth_range": [9.0, 1.0]}, "0 < near < far"),
        ({"depth_range": [1.0, float("inf")]}, r"depth_range\[1\] must be above 0, got inf"),
        ({"tau_c": float("nan")}, "tau_c must be at least 0, got nan"),
        ({"tau_c": -0.1}, "tau_c must be at least 0, got -0.1"),
        ({"variant": "duel"}, "unknown priors.variant 'duel': .* did you mean 'dual'"),
        ({"mono_kind": "metirc"}, "unknown priors.mono_kind 'metirc': .* did you mean 'metric'"),
        ({"mono_preprocessing": "none"}, "unknown priors.mono_preprocessing 'none'"),
        ({"mono_threads": -1}, "mono_threads must be at least 0 threads, got -1"),
        ({"stereo": {"matcher": "patch-match"}}, "unknown priors.stereo.matcher .* did you mean 'patchmatch'"),
        ({"stereo": {"max_pixels": -5}}, "max_pixels must be at least 1 pixels, got -5"),
        ({"stereo": {"colmap_minutes": 0}}, "colmap_minutes must be above 0 minutes, got 0"),
        ({"stereo": {"patchmatch_sources": 33}}, "patchmatch_sources must be at least 1 and at most 32, got 33"),
        ({"stereo": {"max_angle": 200}}, "max_angle must be at least 0 and at most 180 degrees, got 200"),
        ({"stereo": {"min_angle": 60.0}}, "min_angle must be below max_angle, got 60 and 60 degrees"),
        ({"stereo": {"seed": -1}}, "seed must be at least 0"),
        ({"align": {"residual": "absolut"}}, "unknown priors.align.residual 'absolut': .* did you mean 'absolute'"),
        ({"align": {"epsilon": 0.0}}, "epsilon must be above 0, got 0.0"),
        ({"align": {"min_inliers": 1.5}}, "min_inliers must be at least 0 and at most 1, got 1.5"),
    ],
)
def test_a_value_that_cannot_be_meant_is_refused_in_one_sentence(table: dict[str, Any], message: str) -> None:
    with pytest.raises(D2Error, match=message) as refusal:
        PriorSettings.from_dict(table)
    assert "\n" not in str(refusal.value)


def test_python_meets_the_same_checks() -> None:
    with pytest.raises(D2Error, match="PriorSettings.tau_c must be at least 0, got nan"):
        replace(PriorSettings(), tau_c=float("nan"))
    with pytest.raises(D2Error, match="AlignSettings.epsilon must be above 0"):
        AlignSettings(epsilon=0.0)
    with pytest.raises(D2Error, match="StereoSettings.colmap_minutes must be above 0 minutes"):
        StereoSettings(colmap_minutes=-1.0)


@pytest.mark.parametrize("kind", [PriorSettings, StereoSettings, AlignSettings])
def test_every_setting_says_what_it_does(kind: type) -> None:
    assert [setting.name for setting in declared(kind) if not setting.help] == []


@pytest.mark.parametrize("settings", [PriorSettings(), PriorSettings.paper(depth_range=(1, 9))])
def test_a_record_of_the_settings_gives_them_back(settings: PriorSettings) -> None:
    assert PriorSettings.from_dict(json.loads(json.dumps(asdict(settings)))) == settings
