"""Modules that a repository builds in CUDA: the original where it can be imported, ours where it cannot."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import sys
import types
from pathlib import Path

from d2_plugin.attach.recipes import Original

log = logging.getLogger(__name__)


def provide(originals: tuple[Original, ...], folder: Path, on_cpu: bool) -> None:
    """Import every original, or put our stand-in into its place, and say which.

    Args:
        originals: what the repository needs.
        folder: where its script lies.
        on_cpu: its CUDA builds cannot run, so they are not tried.
    """
    for original in originals:
        reason = "it needs a GPU" if on_cpu else _failure(original, folder)
        if reason is None:
            log.info("%s: the original is used", original.name)
        else:
            _put(original)
            log.warning("%s: %s stands in for it (%s)", original.name, original.stand_in, reason)


def _failure(original: Original, folder: Path) -> str | None:
    """Why the original cannot be imported, or None; a module inside the repository is built once, here."""
    try:
        if original.file is None:
            importlib.import_module(original.name)
        elif (folder / original.file).is_file():
            _import_file(original.name, folder / original.file)
        else:
            return f"no file {original.file}"
    except Exception as error:  # a failed build raises anything: ImportError, OSError, RuntimeError, CalledProcessError
        sys.modules.pop(original.name, None)
        first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
        return f"its import failed: {first_line}"
    return None


def _import_file(name: str, path: Path) -> None:
    """Import one file under its full name without its package, whose other imports may fail for other reasons."""
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no module that Python can load")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)


def _put(original: Original) -> None:
    """Our module under the original's name, with a package above it where there is none."""
    parent, _, _ = original.name.rpartition(".")
    absent = parent not in sys.modules and original.file is None and importlib.util.find_spec(parent or "sys") is None
    if parent and absent:
        package = types.ModuleType(parent)
        package.__path__ = []
        sys.modules[parent] = package
    sys.modules[original.name] = importlib.import_module(original.stand_in)
