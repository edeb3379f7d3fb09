"""`d2 doctor --attach`: what a trainer imports and this environment lacks, and how to get it."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import torch

from d2_plugin.attach.packages import STAND_INS, missing, needed, pip_command
from d2_plugin.attach.recipes import Original, recipe
from d2_plugin.errors import D2Error

WIDTH = 48
"""Of the column of names."""


def needs(repository: str, path: Path) -> str:
    """One line for each package that is missing or stood in for, and one that says whether the launcher can run."""
    found = recipe(repository)
    script = path if path.is_file() else path / found.script
    if not script.is_file():
        raise D2Error(f"no {found.script} in {path}: give the folder of {repository}'s repository, or its script")
    replaced = {original.name for original in found.originals}
    beside = [script.parent / name for name in found.folders]  # gsplat's examples import gsplat, one folder up
    absent = {
        name: where for name, where in missing(script, replaced).items() if not any((f / name).is_dir() for f in beside)
    }
    certain = needed(script, conditional=False)
    to_install = [name for name in absent if name not in STAND_INS and name in certain]
    perhaps = [name for name in absent if name not in STAND_INS and name not in certain]
    lines = [f"{repository}: {script} imports {len(needed(script))} packages at once"]
    lines += [f"{name:{WIDTH}}missing ({absent[name]}): run `{pip_command([name])}`" for name in to_install]
    lines += [
        f"{name:{WIDTH}}missing ({absent[name]}): the launcher stands in for it; {STAND_INS[name].why}"
        for name in absent
        if name in STAND_INS
    ]
    lines += [f"{name:{WIDTH}}missing ({absent[name]}): some options alone import it" for name in perhaps]
    lines += [_built(original, script.parent) for original in found.originals]
    if not torch.cuda.is_available():
        lines.append(f"{'GPU':{WIDTH}}none: give the launcher --cpu, which is slow")
    verdict = f"install what is missing: `{pip_command(to_install)}`" if to_install else "the launcher can run it"
    return "\n".join([*lines, verdict])


def _built(original: Original, folder: Path) -> str:
    """Whether a module that the repository builds in CUDA is there; it is not loaded."""
    if original.file is not None:
        there = (folder / original.file).is_file()
        state = "built at its first import, with a GPU" if there else f"no {original.file}"
    else:
        top = original.name.split(".")[0]
        there = importlib.util.find_spec(top) is not None
        state = "installed" if there else "not built"
    ours = "" if there and torch.cuda.is_available() else f": {original.stand_in} stands in for it"
    return f"{original.name:{WIDTH}}{state}{ours}"
