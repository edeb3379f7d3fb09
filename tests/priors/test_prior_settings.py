"""Settings of the priors: one declaration each, and one sentence for every value that cannot be meant."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from d2_plugin.errors import D2Error
from d2_plugin.priors.settings import PriorSettings


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


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"depth_range": [1, 2, 3]}, "depth_range must be a list of 2 values, got .1, 2, 3."),
        ({"depth_range": [0, 3]}, r"depth_range\[0\] must be above 0, got 0"),
        ({"depth_range": [9.0, 1.0]}, "0 < near < far"),
        ({"depth_range": [1.0, float("inf")]}, r"depth_range\[1\] must be above 0 and at most 1e\+09, got inf"),
        ({"tau_c": float("nan")}, "tau_c must be at least 0, got nan"),
        ({"variant": "duel"}, "unknown priors.variant 'duel': .* did you mean 'dual'"),
        ({"mono_threads": -1}, "mono_threads must be at least 0 and at most 1024 threads, got -1"),
        ({"stereo": {"matcher": "patch-match"}}, "unknown priors.stereo.matcher .* did you mean 'patchmatch'"),
        ({"stereo": {"patchmatch_sources": 33}}, "patchmatch_sources must be at least 1 and at most 32, got 33"),
        ({"stereo": {"min_angle": 60.0}}, "min_angle must be below max_angle, got 60 and 60 degrees"),
        ({"align": {"residual": "absolut"}}, "unknown priors.align.residual 'absolut': .* did you mean 'absolute'"),
    ],
)
def test_a_value_that_cannot_be_meant_is_refused_in_one_sentence(table: dict[str, Any], message: str) -> None:
    with pytest.raises(D2Error, match=message) as refusal:
        PriorSettings.from_dict(table)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("settings", [PriorSettings(), PriorSettings.paper(depth_range=(1, 9))])
def test_a_record_of_the_settings_gives_them_back(settings: PriorSettings) -> None:
    assert PriorSettings.from_dict(json.loads(json.dumps(asdict(settings)))) == settings
