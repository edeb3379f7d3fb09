"""What the trainers of the tests hold after some attached steps: .ci/attached_steps.py FILE.npz [OTHER.npz].

Writes it to FILE, from the folder that `tests` and `docs` lie in; says how far it is from what another Python or torch
wrote to OTHER, and ends with 1 where Gaussians differ in number or a parameter by more than rounding.
"""

# ruff: noqa: E402, T201  the tests' modules are found first; this is a program

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path[:0] = [str(Path.cwd() / "tests"), str(Path.cwd() / "tests" / "attach")]
from mimics.page import attached
from mimics.workplace import furnish
from repositories import MIMICS, run, snapshot

from d2_plugin.adapters.successors.gsplat_dynamic import GsplatDynamicAdapter

STEPS = 30
"""Insertion and pruning are due at 5, 15 and 25, the trainers' own densification once or twice."""
ROUNDING = 1e-2
"""Of the largest value of a parameter: gradients changed by 1e-6 of themselves move some as far in 30 steps of Adam."""


def main(output: Path, other: Path | None) -> int:
    """Train each for `STEPS` steps, write all parameters, compare."""
    found: dict[str, np.ndarray] = {}
    torch.set_num_threads(1)
    for name in MIMICS:
        with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
            patch.setitem(GsplatDynamicAdapter.__init__.__kwdefaults__, "camera", "cam1")
            furnish(Path(folder), patch)
            outcome = run(name, attached(MIMICS[name], name), stop=STEPS)
            for key, value in snapshot(outcome).items():
                found[f"{name} {key}"] = value.numpy()
            assert {entry.action for entry in outcome.d2.trace} >= {"loss", "insert", "remove"}, name
    np.savez(output, **found)
    differ = False
    theirs = dict(np.load(other)) if other is not None else {}
    for name in MIMICS if other is not None else ():
        ours = {key: value for key, value in found.items() if key.split()[0] == name}
        moved = [key for key, value in ours.items() if theirs[key].shape != value.shape]
        largest = max(
            (float(np.abs(value - theirs[key]).max() / (np.abs(value).max() + 1e-12)) for key, value in ours.items()
             if value.size and key not in moved), default=0.0,
        )  # fmt: skip
        same = not moved and largest <= ROUNDING
        differ |= not same
        apart = "another number of Gaussians" if moved else f"{largest:.1e} apart"
        print(f"{name}: {len(ours)} parameters, {apart}")
    print(f"Python {sys.version.split()[0]}, torch {torch.__version__}, numpy {np.__version__}")
    return int(differ)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else None))
