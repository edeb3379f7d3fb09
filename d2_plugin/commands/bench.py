"""Error against run time of one part; `d2 bench PART --help` says more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from benchmarks import BENCHMARKS
from d2_plugin.commands.arguments.form import HELP, Form
from d2_plugin.commands.arguments.study_form import study_form
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.settings import Positional, Settings


@dataclass(frozen=True)
class WhichBenchmark(Settings):
    """Which benchmark."""

    part: Annotated[str, Positional()]
    """What is measured, one of the above."""


def form(words: list[str]) -> Form:
    """What the benchmark of one part takes; the part is taken off the words."""
    if not words:
        raise D2Error(f"d2 bench needs a part: have {', '.join(BENCHMARKS)}")
    if words[0] in HELP:
        return Form.of("d2 bench", f"{__doc__}\n\n{_parts()}", WhichBenchmark, lambda settings: None)
    part = words.pop(0)
    if part not in BENCHMARKS:
        raise unknown_name("benchmark", part, BENCHMARKS)
    return study_form(f"d2 bench {part}", BENCHMARKS[part].module, BENCHMARKS[part].settings)


def _parts() -> str:
    """A line per benchmark, for the help."""
    return "\n".join(f"  {name:13} {benchmark.help}" for name, benchmark in BENCHMARKS.items())
