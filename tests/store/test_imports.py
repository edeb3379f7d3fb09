"""What a trainer's process imports: contract, hooks, rasterizer and store, and nothing that makes priors."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from mimics.workplace import furnish

MOST = 45
"""Modules of this project in an attached process, its adapter among them; four of them are the store's."""

OUTSIDE = ("d2_plugin.priors", "d2_plugin.recordings", "d2_plugin.runs", "d2_plugin.viewing", "d2_plugin.commands")
"""Rooms that no trainer needs."""

NOT_NEEDED = ("cv2", "pycolmap", "onnxruntime", "rich", "matplotlib")
"""Packages that training does without; a bare import needs neither these nor torch and numpy."""

BARE = "import sys, d2_plugin; print(*sys.modules)"

ATTACHED = f"""
import sys
for name in {NOT_NEEDED}:
    sys.modules[name] = None  # an import of it now fails
import torch
from d2_plugin import D2Hooks
from d2_plugin.protocol import View
from d2_plugin.adapters.gsplat_dict import GsplatAdapter

parameters = {{"means": (8, 3), "scales": (8, 3), "quats": (8, 4), "opacities": (8,)}}
parameters |= {{"sh0": (8, 1, 3), "shN": (8, 0, 3)}}
torch.manual_seed(0)
splats = torch.nn.ParameterDict({{name: torch.nn.Parameter(torch.rand(shape)) for name, shape in parameters.items()}})
with torch.no_grad():
    splats["means"][:, 2] += 2.5
optimizers = {{name: torch.optim.Adam([value], lr=1e-3) for name, value in splats.items()}}
d2 = D2Hooks.from_config("d2.toml", backbone=GsplatAdapter(splats, optimizers, {{}}))
K = torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
pose = torch.eye(4)
pose[0, 3] = 0.4
for step in range(1, 11):
    d2.loss(step, View("cam0", 0, 0.0, pose, K, 32, 24)).backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    d2.step(step)
assert {{"densify", "prune", "depth_loss"}} <= set(d2.hooks) and d2.trace
print(*(name for name in sys.modules if name.partition(".")[0] == "d2_plugin"))
"""


def imported(script: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1].split()


def test_importing_the_plugin_imports_nothing_else() -> None:
    names = imported(BARE)
    assert [name for name in names if name.startswith("d2_plugin")] == ["d2_plugin"]
    assert not {"torch", "numpy", *NOT_NEEDED} & set(names)


def test_an_attached_step_needs_torch_and_numpy_and_imports_the_core_and_the_store_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    furnish(tmp_path, monkeypatch)
    names = imported(ATTACHED)
    assert not [name for name in names if name.startswith(OUTSIDE)]
    assert len(names) <= MOST, "\n".join(names)
