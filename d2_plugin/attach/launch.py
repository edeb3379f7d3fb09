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
from d2_plugin.attach.packages import provide, stand_in_for
from d2_plugin.attach.recipes import RECIPES, recipe
from d2_plugin.attach.repairs import repair
from d2_plugin.attach.session import Session
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error


def main(arguments: Sequence[str]) -> int:
    """Run a script with D2 attached; a mistake in the input is one sentence on stderr and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="d2: %(message)s")
    try:
        options, command = parsed(arguments)
        session = prepare(options, command)
        try:
            runpy.run_path(command[0], run_name="__main__")
        except SystemExit as end:
            if end.code:
                raise
        session.end()
    except D2Error as error:
        sys.stderr.write(f"d2: {error}\n")
        return 2
    return 0


def prepare(options: argparse.Namespace, command: Sequence[str]) -> Session:
    """All that has to be done before the script `command[0]` runs: paths, stand-ins, repairs, and D2 around it."""
    script = Path(command[0])
    if not script.is_file():
        raise D2Error(f"no script at {script}: give the repository's train.py and its arguments after --")
    if not options.cpu and not torch.cuda.is_available():
        raise D2Error("this trainer needs a GPU and torch finds none: add --cpu to try it on the CPU, which is slow")
    if options.d2 is not None:
        D2Config.from_toml(options.d2)  # a mistake stops here, not when the trainer has read its images
    sys.argv = list(command)
    repository = recipe(options.repository)
    folder = script.resolve().parent
    sys.path[:0] = [str(folder), *(str(folder / name) for name in repository.folders)]
    repair()
    stand_in_for(script.resolve(), {original.name for original in repository.originals})
    provide(repository.originals, script.parent, options.cpu, options.stand_ins)
    if options.cpu:
        run_on_cpu()
    if repository.prepare is not None:
        repository.prepare()
    os.execv = _refuse_restart  # type: ignore[assignment]
    session = (repository.session or Session)(repository, options.d2, exported=options.exported)
    session.wrap()
    return session


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


def _from_here(text: str) -> Path:
    """The path in whatever folder the script goes on to work."""
    return Path(text).expanduser().absolute()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m d2_plugin.attach",
        usage="%(prog)s REPOSITORY [--d2 FILE] [--exported DIR] [--cpu | --stand-ins] -- train.py ARGUMENTS...",
        description="Run another repository's train.py with D2 attached, no line of it edited.",
    )
    parser.add_argument("repository", choices=sorted(RECIPES), help="which codebase the script belongs to")
    parser.add_argument("--d2", type=_from_here, help="configuration of D2; without it the bare trainer runs")
    parser.add_argument(
        "--exported", type=_from_here, help="what d2 export-recording wrote, if the prior is of its source"
    )
    device = parser.add_mutually_exclusive_group()
    device.add_argument("--cpu", action="store_true", help="cuda means cpu, and D2's modules replace CUDA builds")
    device.add_argument("--stand-ins", action="store_true", help="on a GPU, too, they replace what cannot be loaded")
    return parser
