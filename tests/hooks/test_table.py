"""The example in the docstring of the hooks is a whole hook: one file and one row, and everything knows it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

from d2_plugin import hooks

FILE_OF_THE_HOOK = """
from dataclasses import dataclass
from torch import Tensor
from d2_plugin.hooks import Context, Hook, HookConfig
from d2_plugin.settings import NotNegative
"""

SCRIPT = """
from d2_plugin import hooks
import shrink
from shrink import Shrink, ShrinkConfig
HookRow = hooks.HookRow
hooks.HOOKS |= {ROW}

import torch
from d2_plugin import D2Config, D2Error
from d2_plugin.config import for_iterations
from d2_plugin.runs.settings import HOOK_NAMES, RunSettings, check, hook_config
from d2_plugin.settings import declared
from tiny import make_trainer, parameters, same
from pathlib import Path

config = D2Config.from_dict({"shrink": {"weight": 0.5}})
trainer = make_trainer(config, iterations=2)
trainer.run()
done = [(entry.step, entry.hook, entry.action) for entry in trainer.d2.trace]
assert done == [(1, "shrink", "loss"), (2, "shrink", "loss")]
bare = make_trainer(iterations=2)
bare.run()
assert not same(parameters(bare), parameters(trainer))
assert trainer.d2.state_dict()["hooks"] == {"shrink": {}}

import tomllib
assert D2Config.from_dict(tomllib.loads(config.to_toml())) == config
assert {setting.name: setting.help for setting in declared(D2Config)}["shrink"] == "Keeps Gaussians small."
assert "shrink" in HOOK_NAMES
run = check(RunSettings("room", ("a",), hooks=("shrink",), overrides={"shrink": {"weight": 2}}))
assert hook_config(run, Path("p")).shrink.weight == 2.0
assert for_iterations(["shrink"], 100).hooks == ("shrink",)
for wrong, sentence in (
    ({"shrink": {"weight": -1}}, "shrink.weight must be at least 0, got -1"),
    ({"shrnk": {}}, "unknown hook 'shrnk': have densify, depth_loss, motion, prune, shrink; did you mean 'shrink'?"),
):
    try:
        D2Config.from_dict(wrong)
    except D2Error as error:
        assert sentence in str(error), error
    else:
        raise AssertionError(wrong)
"""


def test_a_hook_is_added_with_one_file_and_one_row(tmp_path: Path) -> None:
    example = re.search(r"class,\n\n(.*?)\n\nand the list", hooks.__doc__, re.DOTALL)[1]
    row = re.search(r'`("shrink": HookRow\(.*?\))`', hooks.__doc__)[1]
    (tmp_path / "shrink.py").write_text(FILE_OF_THE_HOOK + textwrap.dedent(example))
    script = SCRIPT.replace("ROW", row)
    tests = Path(__file__).parents[1]
    environment = {"PYTHONPATH": f"{tmp_path}:{tests}:{tests.parent}"}
    subprocess.run([sys.executable, "-c", script], check=True, env=os.environ | environment, timeout=300)
