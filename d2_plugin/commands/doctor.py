"""What is installed and what is missing for which feature.

With --attach REPOSITORY PATH: what that trainer imports and this environment lacks, and how to get it.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from d2_plugin import __version__, compiler, registry
from d2_plugin.compiler import prebuilt
from d2_plugin.errors import D2Error
from d2_plugin.extras import is_installed
from d2_plugin.settings import Positional, Settings

OPTIONAL = {
    "onnxruntime": ("mono", "monocular depth from an ONNX network"),
    "pycolmap": ("stereo", "sparse points from known cameras"),
    "cv2": ("image", "images, videos, building priors"),
    "kornia": ("test", "image operations that tests compare with"),
    "av": ("video", "the import of videos, and videos of a run"),
    "viser": ("view", "the page that shows a run, and one that trains"),
    "fourdgs": ("formats", "exports as .4dgs"),
    "rich": ("cli", "progress bars"),
    "distributed": ("cluster", "priors built by several processes or machines"),
}


@dataclass(frozen=True)
class Doctor(Settings):
    """What to look at: this installation, or what a trainer needs beside it."""

    path: Annotated[Path | None, Positional()] = None
    """With --attach: the folder of a trainer's repository, or its script."""
    attach: str | None = None
    """Name of the repository, as the launcher knows it."""


def run(settings: Doctor) -> str:
    """The report on this installation, or on what a trainer needs."""
    if settings.attach is not None:
        if settings.path is None:
            raise D2Error("a trainer is examined by both its name and its folder: d2 doctor --attach fudan FOLDER")
        from d2_plugin.attach.packages import needs
        from d2_plugin.attach.recipes import recipe

        return needs(recipe(settings.attach), settings.path)
    if settings.path is not None:
        raise D2Error(
            "a folder is looked at with --attach NAME, as the repository of that trainer; what a recording needs says "
            f"d2 plan {settings.path} --train-cameras all"
        )
    return report()


def report() -> str:
    """A few lines a person can paste into an issue."""
    import torch

    from d2_plugin.compiler.gpu_state import gpu_state

    lines = [
        f"d2-4dgs {__version__}, Python {platform.python_version()}, torch {torch.__version__}, {os.cpu_count()} cores",
        *(f"{part:12}{state}" for part, state in gpu_state()),
        f"compiler    {_compiler()}",
        f"cache       {compiler.cache_folder()}",
        f"backbones   {', '.join(registry.names(registry.BACKBONES))}",
    ]
    known = importlib.metadata.packages_distributions()
    lines += [f"{module:12}{_state(known.get(module, [module]), module, *why)}" for module, why in OPTIONAL.items()]
    return "\n".join(lines)


def _compiler() -> str:
    if (prebuilt.FOLDER / prebuilt.CHECKSUMS).is_file():
        return f"not needed: the CPU kernels came compiled, for {', '.join(prebuilt.usable()) or 'other CPUs'}"
    try:
        return " ".join(compiler.find_compiler())
    except compiler.NoCompiler as error:
        return f"none: {error}"


def _state(names: Sequence[str], module: str, extra: str, purpose: str) -> str:
    if not is_installed(module):
        return f"missing, needed for {purpose}: run `pip install 'd2-4dgs[{extra}]'`"
    with suppress(importlib.metadata.PackageNotFoundError):
        return f"{importlib.metadata.version(names[0])} ({purpose})"
    return f"of unknown version ({purpose})"
