"""The `d2` command: from a recording to a prior, a trained model, its scores, and the tables of a study."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from d2_plugin import __version__
from d2_plugin.commands.arguments.boundary import DEBUG, guarded
from d2_plugin.commands.arguments.form import HELP, ModuleCommand
from d2_plugin.commands.arguments.help import entry, help_text
from d2_plugin.errors import D2Error, refuse_unknown

COMMANDS: dict[str, str | ModuleCommand] = {
    "demo": ModuleCommand(
        *("d2_plugin.viewing.demo", "Demo"),
        "A synthetic recording, trained by the backbone alone and with D2: a table, an image and a player.",
    ),
    "import": ModuleCommand(
        *("d2_plugin.commands.import_", "ImportSettings"),
        "Turn videos into a recording: where the cameras stand, one clock for all of them, images, exposures.",
    ),
    "plan": "plan",
    "priors": "priors",
    "train": "train",
    "eval": ModuleCommand(
        "d2_plugin.commands.eval", "Evaluation", "Score the held-out cameras of a trained run again."
    ),
    "render": ModuleCommand(
        *("d2_plugin.viewing.videos.render", "RenderSettings"),
        "A video of a run: its held-out cameras, or a camera that moves; depth, errors, several runs together.",
    ),
    "view": ModuleCommand(
        *("d2_plugin.viewing.live.show", "ViewSettings"),
        "A page in the browser that shows a run, a recording or a depth prior, in space and time.",
    ),
    "compare": ModuleCommand(
        "d2_plugin.commands.compare", "Comparison", "One Markdown table of the scores of several runs; a page of two."
    ),
    "ablate": "ablate",
    "bench": "bench",
    "protocol": ModuleCommand(
        *("d2_plugin.commands.protocol", "ProtocolRun"),
        "A published evaluation on N3DV by its name: its cameras, size, frames, steps and metrics, and what differs.",
    ),
    "report": ModuleCommand(
        "d2_plugin.runs.report.report", "ReportSettings", "One page of everything measured: plots, tables, images."
    ),
    "export": ModuleCommand(
        *("d2_plugin.viewing.export.export", "Export"),
        "Write a trained run as a web page that plays it, or as files that other viewers open.",
    ),
    "export-recording": ModuleCommand(
        *("d2_plugin.commands.export_recording", "RecordingExport"),
        "Write a recording in the input layout of another 4D Gaussian Splatting repository.",
    ),
    "doctor": ModuleCommand(
        *("d2_plugin.commands.doctor", "Doctor"),
        "What is installed and what is missing for which feature, or for a trainer.",
    ),
}
"""Name -> what serves it: a module beside this file, whose docstring is the help and whose `form(words)` says what it
takes; or any module with settings and `run`."""

NEEDED = (3, 11)
"""The Python of the commands; a trainer's process, which imports none of them, may be older."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; an error is one sentence on stderr and exit code 2, Ctrl-C exit code 130."""
    # Read when torch is first imported, further down: OpenMP threads that spin at each barrier make a training step
    # on a busy machine several times slower.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    words = list(sys.argv[1:] if arguments is None else arguments)
    plain = [word for word in words if word != DEBUG]
    return guarded(lambda: _answer(plain), debug=len(plain) < len(words))


def _answer(words: list[str]) -> str | None:
    if words[:1] == ["--version"]:
        return f"d2-4dgs {__version__}"
    if sys.version_info[:2] < NEEDED:
        needed, running = (".".join(map(str, version)) for version in (NEEDED, sys.version_info[:2]))
        raise D2Error(f"the commands need Python {needed} or later, this is {running}: run them in another environment")
    if not words:
        raise D2Error(f"no command is given: have {', '.join(COMMANDS)}; `d2 --help` says what each does")
    if words[0] in HELP:
        return _overview()
    refuse_unknown("command", [words[0]], COMMANDS)
    rest = words[1:]
    command = COMMANDS[words[0]]
    form = command.form(f"d2 {words[0]}") if isinstance(command, ModuleCommand) else _module(command).form(rest)
    return help_text(form, rest) if any(word in HELP for word in rest) else form.run(form.parse(rest))


def _overview() -> str:
    lines = [entry(name, _about(command)) for name, command in COMMANDS.items()]
    head = "Dual-source depth priors for 4D Gaussian Splatting from two to four cameras."
    foot = "`d2 COMMAND --help` says what a command takes; `d2 --version` prints the version."
    debug = f"Every command takes {DEBUG}: an error then shows where it arose."
    return "\n".join(["usage: d2 COMMAND ...", "", head, "", *lines, "", foot, debug])


def _about(command: str | ModuleCommand) -> str:
    return command.help if isinstance(command, ModuleCommand) else (_module(command).__doc__ or "").partition("\n")[0]


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"d2_plugin.commands.{name}")
