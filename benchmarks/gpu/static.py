"""What the GPU kernels take, as the compiler says: no device is needed, and nothing here is a time on one.

nvcc compiles the sources for an architecture; ptxas says registers, spills and shared memory of each kernel, and the
binary says how many instructions it has. Rows of this are called "static analysis" and never more.
"""

import re
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from d2_plugin.compiler.nvrtc import Program
from d2_plugin.errors import D2Error
from d2_plugin.priors.stereo import patchmatch_cuda as patchmatch
from d2_plugin.rasterizer import cuda as rasterizer
from d2_plugin.runs.rows import Row, make_row

ARCHITECTURES = ("sm_80", "sm_90", "sm_120")
"""A100, H100, and the consumer GPUs of their successor."""

INSTRUCTION_BYTES = 16
"""Of one machine instruction, since sm_70."""

ENTRY = re.compile(
    r"Compiling entry function '(?P<kernel>\w+)' for '\w+'.*?"
    r"(?P<stack>\d+) bytes stack frame, (?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)


PROGRAMS = (
    (rasterizer.PROGRAM, rasterizer.flags_for(3)),
    (patchmatch.PROGRAM, patchmatch.flags_for(4)),
)
"""What is compiled and the flags: splatting of three colors, PatchMatch of four sources."""


def static_analysis(nvcc: str, architecture: str, command: str = "") -> list[Row]:
    """One row per kernel: registers, bytes spilled, bytes of shared memory, instructions.

    Raises:
        D2Error: nvcc refuses a source.
    """
    return [
        make_row(
            *("gpu", f"static analysis of {kernel}", "d2", architecture),
            error=None,
            seconds=None,
            command=command,
            **found,
        )
        for program, flags in PROGRAMS
        for kernel, found in _kernels(nvcc, program, (f"-arch={architecture}", *flags)).items()
    ]


def _kernels(nvcc: str, program: Program, flags: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What the compiler says of each kernel of a program."""
    with tempfile.TemporaryDirectory() as folder:
        cubin = Path(folder) / "kernels.cubin"
        words = [nvcc, "-cubin", *flags, "-Xptxas", "-v", "-o", str(cubin), str(program.source)]
        result = subprocess.run(words, capture_output=True, text=True, check=False)
        if result.returncode:
            said = result.stderr[:4000]
            raise D2Error(f"nvcc refused {program.source.name} ({flags[0]}); please report what it said:\n{said}")
        counts = instructions(cubin.read_bytes())
    return {name: {**facts, "instructions": counts[name]} for name, facts in resources(result.stderr).items()}


def resources(printed: str) -> dict[str, dict[str, Any]]:
    """What `ptxas -v` says of each kernel: registers per thread, bytes spilled and stacked, bytes of shared memory."""
    found = {}
    for match in ENTRY.finditer(printed):
        shared = re.search(r"(\d+) bytes smem", match["rest"])
        found[match["kernel"]] = {
            "registers": int(match["registers"]),
            "spill_bytes": int(match["stores"]) + int(match["loads"]),
            "stack_bytes": int(match["stack"]),
            "shared_bytes": int(shared[1]) if shared else 0,
        }
    return dict(sorted(found.items()))


def instructions(cubin: bytes) -> dict[str, int]:
    """Machine instructions of each kernel, padding included: the sizes of the sections ``.text.KERNEL`` of an ELF file.

    Raises:
        D2Error: it is no 64-bit ELF file.
    """
    if cubin[:5] != b"\x7fELF\x02":
        raise D2Error("the compiler wrote no 64-bit ELF file: give a cubin")
    (table,) = struct.unpack_from("<Q", cubin, 40)
    size, count, names = struct.unpack_from("<3H", cubin, 58)
    sections = [struct.unpack_from("<IIQQQQ", cubin, table + i * size) for i in range(count)]
    start = sections[names][4]
    found = {}
    for name, _, _, _, _, length in sections:
        label = cubin[start + name : cubin.index(b"\0", start + name)].decode()
        if label.startswith(".text."):
            found[label.removeprefix(".text.")] = length // INSTRUCTION_BYTES
    return found
