"""What a person sees of an exception: one sentence and an exit code, never a traceback unless `--debug` asks for it."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress

from d2_plugin.errors import D2Error
from d2_plugin.reading import said, shown_path

DEBUG = "--debug"
"""The flag that every command takes: the traceback of an error is printed above its sentence."""

REFUSED, STOPPED, NOBODY_READS = 2, 130, 141
"""Exit codes: an error; stopped by Ctrl-C (128 + SIGINT); whoever read the output went away (128 + SIGPIPE)."""

OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "insufficient memory", "outofmemory", "bad_alloc")
"""What torch, OpenCV and onnxruntime say, in lower case, where Python would raise MemoryError."""


def guarded(answer: Callable[[], str | None], debug: bool) -> int:
    """Print what `answer` returns and give 0, or print the sentence of its exception and give another exit code."""
    interrupted: list[int] = []
    _open_closed_streams()
    _take_any_letter()
    try:
        with _noticed() as interrupted:
            text = answer()
        if text:
            sys.stdout.write(f"{text}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # The interpreter flushes once more at its end, and would complain.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    except (Exception, KeyboardInterrupt) as failure:
        if debug:
            sys.stderr.write(traceback.format_exc())
        stopped = KeyboardInterrupt() if interrupted else failure
        sys.stderr.write(f"d2: {sentence(stopped)}\n")
        return STOPPED if isinstance(stopped, KeyboardInterrupt) else REFUSED
    return 0


@contextmanager
def _noticed() -> Iterator[list[int]]:
    """Within it, the list holds every Ctrl-C: C code that is being imported makes another exception of it."""
    interrupts: list[int] = []

    def stop(number: int, frame: object) -> None:
        interrupts.append(number)
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    ours = before is signal.default_int_handler and threading.current_thread() is threading.main_thread()
    if ours:
        signal.signal(signal.SIGINT, stop)
    try:
        yield interrupts
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def sentence(failure: BaseException) -> str:
    """One line for any exception: what was meant to be read as it is, causes of the system in words, faults named so.

    Expected causes are a D2Error where they arise. An OSError names its file and what the system says of it.
    """
    if isinstance(failure, D2Error):
        return one_line(str(failure))
    if isinstance(failure, KeyboardInterrupt):
        return "stopped: continue with the same command"
    if isinstance(failure, MemoryError) or any(words in str(failure).lower() for words in OUT_OF_MEMORY):
        return "more memory is needed than there is: make images smaller with --downscale 2, or take fewer --frames"
    if isinstance(failure, BrokenExecutor):
        return "a worker process was ended from outside, or for want of memory: run it again with fewer --jobs"
    if isinstance(failure, OSError):
        places = [shown_path(name) for name in (failure.filename, failure.filename2) if isinstance(name, str | bytes)]
        where = " and ".join(places) or "a file or a connection"
        return f"cannot use {where} ({said(failure)}): mend that or name another place"
    return (
        f"unexpected {type(failure).__name__} ({said(failure)}), a fault of d2-4dgs: "
        f"run the same command with {DEBUG} and report what it prints"
    )


def one_line(text: str) -> str:
    """A text without line breaks and control characters, which a name in it may hold."""
    return shown_path(" ".join(text.splitlines()))


def _open_closed_streams() -> None:
    """Nothing stands where a standard stream was closed: a file opened later would get its number, and what libraries
    print would be written into it."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, "r+", encoding="utf-8")  # noqa: SIM115  to the end of the process
            try:
                os.fstat(number)
            except OSError:
                os.dup2(stream.fileno(), number)
            setattr(sys, name, stream)


def _take_any_letter() -> None:
    """Let the two streams write letters that the terminal lacks as escapes instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
