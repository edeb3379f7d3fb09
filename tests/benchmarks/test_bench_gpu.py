"""The proof on a GPU: what fits into the time that one is lent for, and what is said where there is none."""

from __future__ import annotations

import struct

import pytest

from benchmarks.__main__ import PARTS
from benchmarks.gpu import proof as gpu
from benchmarks.gpu import static as gpu_static
from d2_plugin.errors import D2Error

PTXAS = """ptxas info    : Compiling entry function 'd2_render' for 'sm_90'
ptxas info    : Function properties for d2_render
    8 bytes stack frame, 12 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 32 registers, used 1 barriers, 11264 bytes smem
ptxas info    : Compiling entry function 'd2_list' for 'sm_90'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 24 registers, used 0 barriers
"""


@pytest.mark.parametrize("name", ["raster", "stereo-cuda", "profile"])
def test_a_step_calls_a_part_with_words_that_the_part_takes(name: str) -> None:
    called = gpu.STEPS[name].words(gpu.GpuBench())
    part, *given = called[called.index("benchmarks") + 1 :]
    PARTS[part].form(part).parse(given)


def test_registers_spills_and_shared_memory_are_read_off_what_ptxas_says() -> None:
    found = gpu_static.resources(PTXAS)
    assert found["d2_render"] == {"registers": 32, "spill_bytes": 16, "stack_bytes": 8, "shared_bytes": 11264}
    assert found["d2_list"] == {"registers": 24, "spill_bytes": 0, "stack_bytes": 0, "shared_bytes": 0}


def test_instructions_are_counted_by_the_sizes_of_sections() -> None:
    names = b"\0.text.d2_render\0"
    header = b"\x7fELF\x02" + bytes(35) + struct.pack("<Q", 64) + bytes(10) + struct.pack("<3H", 64, 2, 1)
    sections = struct.pack("<IIQQQQ", 1, 1, 0, 0, 0, 160) + bytes(24) + struct.pack("<IIQQQQ", 0, 3, 0, 0, 192, 17)
    assert gpu_static.instructions(header + sections + bytes(24) + names) == {"d2_render": 10}
    with pytest.raises(D2Error, match="no 64-bit ELF"):
        gpu_static.instructions(b"text")
