"""Packages of the extras that more than one room uses, imported where they are needed."""

from __future__ import annotations

import importlib.util
import signal
import sys
import threading
import zlib  # noqa: F401  before pycolmap, whose own copy of zlib would otherwise be bound and crash later calls
from contextlib import suppress
from types import ModuleType

from d2_plugin.errors import missing_extra


def import_pycolmap(purpose: str, extra: str) -> ModuleType:
    """The module pycolmap; `purpose` completes the sentence "<purpose> needs pycolmap".

    Its import makes SIGTERM print a stack trace of C++ and abort; this takes that back, in the main thread.

    Raises:
        MissingExtra: where it is not installed, or older; the sentence names `extra`, the extra that brings it.
    """
    first = "pycolmap" not in sys.modules
    pycolmap = imported("pycolmap", "pycolmap", extra, purpose)
    if not hasattr(pycolmap, "FeatureExtractor"):
        raise missing_extra("pycolmap 4.2 or later", extra, purpose)
    before = signal.getsignal(signal.SIGTERM)
    if first and before is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
    return pycolmap


def imported(name: str, package: str, extra: str, purpose: str) -> ModuleType:
    """The module `name` of a package; `purpose` completes the sentence "<purpose> needs <package>".

    Raises:
        MissingExtra: where it is not installed; the sentence names `extra`, the extra of this package that brings it.
    """
    with suppress(ImportError):
        module = importlib.import_module(name)
        if getattr(module, "__file__", None) or not hasattr(module, "__path__"):  # see `is_installed`
            return module
    raise missing_extra(package, extra, purpose)


def is_installed(name: str) -> bool:
    """Whether there is such a module; a mere folder of its name, which Python would import as well, is none."""
    return getattr(importlib.util.find_spec(name), "origin", None) is not None


def import_av(purpose: str) -> ModuleType:
    """The module av (PyAV, FFmpeg), see `imported`."""
    return imported("av", "PyAV", "video", purpose)
