"""`python -m benchmarks PART ...`: error against run time of one part each; `python -m benchmarks PART --help`."""

import sys
from collections.abc import Sequence

from d2_plugin.commands.arguments.boundary import DEBUG, guarded
from d2_plugin.commands.arguments.form import HELP, ModuleCommand
from d2_plugin.commands.arguments.help import entry, help_text
from d2_plugin.errors import D2Error, refuse_unknown

PARTS = {
    "align": ModuleCommand("benchmarks.align", "AlignBench", "the fit of monocular to geometric depth"),
    "gpu": ModuleCommand("benchmarks.gpu.proof", "GpuBench", "everything that a GPU has to show, in 25 minutes"),
    "never-worse": ModuleCommand(
        "benchmarks.never_worse.bench", "NeverWorseBench", "D² with wrong monocular maps against the backbone"
    ),
    "priors": ModuleCommand("benchmarks.priors", "PriorsBench", "declared against true error of the prior"),
    "raster": ModuleCommand("benchmarks.raster", "RasterBench", "the rasterizer: time, memory, precision"),
    "report": ModuleCommand("benchmarks.report", "ReportSettings", "`d2 report` with the rows of all these as well"),
    "rivals": ModuleCommand("benchmarks.rivals.table", "RivalsBench", "D², backbone and rivals at equal time"),
    "rivals-sweep": ModuleCommand("benchmarks.rivals.sweep", "RivalsSweep", "weight and schedule of each rival"),
    "scaling": ModuleCommand("benchmarks.scaling", "ScalingBench", "priors and training over more frames"),
    "stability": ModuleCommand(
        "benchmarks.stability.sweep", "StabilitySettings", "stiff and extreme cases, in both precisions"
    ),
    "stereo": ModuleCommand("benchmarks.stereo", "StereoBench", "geometric depth: matchers and settings"),
    "trainers": ModuleCommand("benchmarks.trainers.bench", "TrainersBench", "official trainers bare and attached"),
}
"""Every part by name; none is imported before it is asked for."""


def answer(words: Sequence[str]) -> str | None:
    """Run what the words say; returns what is left to print.

    Raises:
        D2Error: no part, or an unknown one.
    """
    parts = "\n".join(entry(name, part.help) for name, part in PARTS.items())
    if not words:
        raise D2Error(f"no part is named: have {', '.join(PARTS)}")
    if words[0] in HELP:
        return f"usage: python -m benchmarks PART ...\n\n{parts}"
    refuse_unknown("benchmark", [words[0]], PARTS)
    form, rest = PARTS[words[0]].form(f"python -m benchmarks {words[0]}"), words[1:]
    return help_text(form, rest) if any(word in HELP for word in rest) else form.run(form.parse(rest))


def main(words: Sequence[str]) -> int:
    """As `d2_plugin.commands.cli.main`."""
    plain = [word for word in words if word != DEBUG]
    return guarded(lambda: answer(plain), debug=len(plain) < len(words))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
