"""How many instructions a kernel takes for one fragment of a warp: its smallest loop with an exponential, disassembled.

nvdisasm comes with the CUDA toolkit, and as the package nvidia-cuda-nvdisasm.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

EXPONENTIAL = "MUFU.EX2"

_KERNEL = re.compile(r"\s*\.section\s+\.text\.(?P<name>\w+),")
_LABEL = re.compile(r"(?P<name>\.L\w+):")
_INSTRUCTION = re.compile(r"\s*/\*[0-9a-f]{4,}\*/\s+(?P<text>\S.*?)\s*;")
_BRANCH = re.compile(r"\bBRA\b[^`]*`\((?P<label>\.L\w+)\)")


def nvdisasm() -> str | None:
    """The disassembler: on the path, or from its package; None without one."""
    found = shutil.which("nvdisasm")
    spec = importlib.util.find_spec("nvidia")
    if found or spec is None:
        return found
    packaged = (path for place in spec.submodule_search_locations or () for path in Path(place).glob("*/bin/nvdisasm"))
    return next((str(path) for path in packaged), None)


def fragment_instructions(program: str, cubin: Path) -> dict[str, int]:
    """For each kernel of a cubin with an exponential in a loop, the instructions of the smallest such loop."""
    told = subprocess.run([program, "-c", str(cubin)], capture_output=True, text=True, check=False).stdout
    return smallest_loops(told)


def smallest_loops(assembly: str) -> dict[str, int]:
    """The same, from what nvdisasm says."""
    found = {}
    for name, lines in _kernels(assembly):
        sizes = [len(loop) for loop in _loops(lines) if any(EXPONENTIAL in text for text in loop)]
        if sizes:
            found[name] = min(sizes)
    return found


def _kernels(assembly: str) -> Iterator[tuple[str, list[str]]]:
    name, lines = "", list[str]()
    for line in assembly.splitlines():
        begun = _KERNEL.match(line)
        if begun:
            yield name, lines
            name, lines = begun["name"], []
        else:
            lines.append(line)
    yield name, lines


def _loops(lines: list[str]) -> Iterator[list[str]]:
    """The instructions of every loop: from the target of a branch back up to the branch."""
    instructions, labels = list[str](), dict[str, int]()
    for line in lines:
        label, instruction = _LABEL.match(line), _INSTRUCTION.match(line)
        if label:
            labels[label["name"]] = len(instructions)
        elif instruction:
            instructions.append(instruction["text"])
            branch = _BRANCH.search(instruction["text"])
            if branch and branch["label"] in labels:
                yield instructions[labels[branch["label"]] :]
