"""Error against run time: `d2 bench training` on your own recording; other parts from a checkout of this project."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import d2_plugin
from d2_plugin.commands.arguments.form import HELP, Form, ModuleCommand
from d2_plugin.errors import D2Error, refuse_unknown
from d2_plugin.settings import Positional, Settings

TRAINING = ModuleCommand(
    "d2_plugin.runs.training.bench", "TrainingBench", "D², stereo alone and the backbone at equal time"
)


@dataclass(frozen=True)
class WhichPart(Settings):
    """Which benchmark."""

    part: Annotated[str, Positional()]
    """What is measured: training, or what `python -m benchmarks` lists in a checkout."""


def form(words: list[str]) -> Form:
    """What the benchmark of one part takes; the words of a part of the checkout are all taken off."""
    if not words:
        raise D2Error("d2 bench needs a part: training, or in a checkout what `python -m benchmarks --help` lists")
    if words[0] in HELP:
        return Form.of("d2 bench", __doc__, WhichPart, lambda settings: None)
    if words[0] == "training":
        return TRAINING.form(f"d2 bench {words.pop(0)}")
    of_checkout = _checkout(words[0])
    taken = words[:]
    words.clear()
    return Form("d2 bench", "", (), lambda given: of_checkout(taken))


def _checkout(part: str) -> Callable[[list[str]], str | None]:
    """What answers for the parts that are measured from a checkout: `benchmarks` beside this package.

    Raises:
        D2Error: this package was installed from a wheel, which has none of them.
    """
    folder = Path(d2_plugin.__file__).resolve().parents[1] / "benchmarks"
    if not (folder / "__main__.py").is_file():
        raise D2Error(
            f"'{part}' is measured from a checkout alone: clone the repository and run `python -m benchmarks {part}` "
            "there; `d2 bench training` measures your own recording"
        )
    if str(folder.parent) not in sys.path:
        sys.path.insert(0, str(folder.parent))
    parts = importlib.import_module(f"{folder.name}.__main__")
    refuse_unknown("benchmark", [part], ["training", *parts.PARTS])
    return parts.answer
