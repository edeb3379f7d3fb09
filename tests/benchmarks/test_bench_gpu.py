"""The proof on a GPU: what fits into the time that one is lent for, and what is said where there is none."""

import pytest

from benchmarks.__main__ import PARTS
from benchmarks.gpu import proof as gpu


@pytest.mark.parametrize("name", ["raster", "stereo-cuda", "profile"])
def test_a_step_calls_a_part_with_words_that_the_part_takes(name: str) -> None:
    called = gpu.STEPS[name].words(gpu.GpuBench())
    part, *given = called[called.index("benchmarks") + 1 :]
    PARTS[part].form(part).parse(given)
