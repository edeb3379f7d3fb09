"""The command line of the launcher."""

from __future__ import annotations

import argparse
import logging
import os
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import torch

from d2_plugin.attach.cpu import run_on_cpu
from d2_plugin.attach.gsplat import GsplatSession, put_in_place
from d2_plugin.attach.originals import provide
from d2_plugin.attach.packages import stand_in_for
from d2_plugin.attach.recipes import RECIPES, Recipe, recipe
from d2_plugin.attach.repairs import repair
from d2_plugin.attach.session import Session, found_in
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error

SESSIONS: dict[str, type[Session]] = {"trainer": Session, "gsplat": GsplatSession}
"""By the kind of a recipe, what follows its run."""

log = logging.getLogger(__name__)


def main(arguments: Sequence[str]) -> int:
    """Run a script with D2 attached; a mistake in the input is one sentence on stderr and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="d2: %(message)s")
    try:
        session = launch(*parsed(arguments))
    except D2Error as error:
        sys.stderr.write(f"d2: {error}\n")
        return 2
    if session is not None:
        session.end()
    return 0


def launch(options: argparse.Namespace, command: Sequence[str]) -> Session | None:
    """Prepare the process for the repository and run `command`, its script and arguments, inside it."""
    found = prepare(options, command)
    session = None
    if options.d2 is not None:
        session = SESSIONS[found.kind](found, options.d2, exported=options.exported)
        session.wrap()
    runpy.run_path(command[0], run_name="__main__")
    return session


def prepare(options: argparse.Namespace, command: Sequence[str]) -> Recipe:
    """All that has to be done before the script runs, but D2 itself: paths, stand-ins, repairs; returns the recipe."""
    script = Path(command[0])
    if not script.is_file():
        raise D2Error(f"no script at {script}: give the repository's train.py and its arguments after --")
    _check_device(options.cpu)
    if options.d2 is not None:
        D2Config.from_toml(options.d2)  # a mistake is told now, not when the trainer has read its images
    sys.argv = list(command)
    found = recipe(options.repository)
    folder = script.resolve().parent
    sys.path[:0] = [str(folder), *(str(folder / name) for name in found.folders)]
    repair()
    stand_in_for(script.resolve(), {original.name for original in found.originals})
    provide(found.originals, script.parent, options.cpu)
    if options.cpu:
        run_on_cpu()
    if found.kind == "gsplat":
        put_in_place()
    if found.mend is not None:
        for place in found.models:
            found.mend(found_in(*place))
    os.execv = _refuse_restart  # type: ignore[assignment]
    return found


def _check_device(cpu: bool) -> None:
    if torch.cuda.is_available() == (not cpu):
        return
    if cpu:
        raise D2Error("--cpu is for machines without a GPU, and this one has one: leave it out")
    raise D2Error("this trainer needs a GPU and torch finds none: add --cpu to try it on the CPU, which is slow")


def _refuse_restart(path: str, arguments: Sequence[str]) -> NoReturn:
    """Stop a trainer that restarts itself, as 4DGaussians does when its loss is not a number: D2 would be lost."""
    raise D2Error(
        f"the trainer wants to restart itself as {' '.join(map(str, arguments[:2]))}, as 4DGaussians does when its "
        "loss is not a number (its issue 215): stopped here"
    )


def parsed(arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Options of the launcher, and the command after `--`."""
    arguments = list(arguments)
    at = arguments.index("--") if "--" in arguments else len(arguments)
    options, command = _parser().parse_args(arguments[:at]), arguments[at + 1 :]
    if not command:
        raise D2Error("no script to run: put the repository's train.py and its arguments after --")
    return options, command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m d2_plugin.attach",
        usage="%(prog)s REPOSITORY [--d2 FILE] [--exported DIR] [--cpu] -- train.py ARGUMENTS...",
        description="Run another repository's train.py with D2 attached, no line of it edited.",
    )
    parser.add_argument("repository", choices=sorted(RECIPES), help="which codebase the script belongs to")
    parser.add_argument("--d2", type=Path, default=None, help="configuration of D2; without it the bare trainer runs")
    exported = "folder that d2 export-recording wrote, if the prior was built from its source"
    parser.add_argument("--exported", type=Path, default=None, help=exported)
    parser.add_argument("--cpu", action="store_true", help="no GPU: cuda means cpu, D2's modules replace CUDA builds")
    return parser
