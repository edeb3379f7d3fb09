"""Error against run time of one part; `d2 bench PART --help` says more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from d2_plugin.commands.arguments.form import HELP, Form
from d2_plugin.commands.arguments.study_form import study_form
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.settings import Positional, Settings

PARTS = {"align": "AlignBench", "raster": "RasterBench", "scaling": "ScalingBench", "stereo": "StereoBench"}
"""Module of study/bench -> its settings."""


@dataclass(frozen=True)
class Benchmark(Settings):
    """Which benchmark."""

    part: Annotated[Literal["align", "raster", "scaling", "stereo"], Positional()]
    """What is measured: align, raster, scaling or stereo."""


def form(words: list[str]) -> Form:
    """What the benchmark of one part takes; the part is taken off the words."""
    if not words:
        raise D2Error(f"d2 bench needs a part: have {', '.join(PARTS)}")
    if words[0] in HELP:
        return Form.of("d2 bench", __doc__, Benchmark, lambda settings: None)
    part = words.pop(0)
    if part not in PARTS:
        raise unknown_name("benchmark", part, PARTS)
    return study_form(f"d2 bench {part}", f"d2_plugin.study.bench.{part}", PARTS[part])
