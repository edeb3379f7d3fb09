"""C++ sources of this package, compiled at first use and kept in a cache.

Where a platform wheel brought them compiled (`.prebuilt`), those are used and no compiler is needed. Else
nothing is compiled at import or at installation, and no torch header is involved: a source is a plain C ABI reached
through ctypes, so a torch upgrade never invalidates a build. An entry of the cache is named by a hash of everything
that shapes the machine code: sources, headers, flags, and all that the compiler predefines for this CPU (its version
and the instruction sets among it), so that a home folder shared by different machines stays safe.

Environment:
    CXX            the compiler to use (with arguments if needed); otherwise c++, g++ or clang++
    D2_CXXFLAGS    flags added last, e.g. ``-march=x86-64-v3`` to leave AVX-512 out
    D2_CACHE       the cache folder, see `d2_plugin.cache`: one that others may write is refused
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import shlex
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from d2_plugin.cache import cache_folder, cache_lock, check_private, is_trusted, private_cache
from d2_plugin.compiler.prebuilt import digest_of
from d2_plugin.compiler.prebuilt import find as find_prebuilt
from d2_plugin.durable import write_text
from d2_plugin.errors import D2Error

__all__ = ["CompileError", "NoCompiler", "cache_folder", "find_compiler", "load_library"]

logger = logging.getLogger(__name__)

BASE_FLAGS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-pthread", "-fno-math-errno", "-fno-trapping-math")
"""Flags of every build. No -ffast-math: the kernels test for NaN and infinity."""

NATIVE_FLAGS = (("-march=native",), ("-mcpu=native",), ())
"""How compilers are asked for this CPU's instructions, best first; the last one always works."""

MESSAGE_LIMIT = 4000
"""How many characters of a compiler's output an error repeats: enough for the first mistake."""

_loaded: dict[Path, ctypes.CDLL] = {}
_guard = threading.Lock()


class NoCompiler(D2Error):
    """There is no C++17 compiler; a caller with a slower way should use that."""


class CompileError(D2Error):
    """The compiler refused a source of this package; the message carries the compiler's own words."""

    longest = 2 * MESSAGE_LIMIT


def find_compiler() -> list[str]:
    """The command of the C++ compiler: ``CXX`` alone where it is set, else the first of c++, g++, clang++.

    Raises:
        NoCompiler: none of them is on the path, or this is Windows, where the kernels have not been ported.
    """
    if os.name == "nt":
        raise NoCompiler("compiled kernels run on Linux and macOS: on Windows use the Linux subsystem (WSL)")
    chosen = os.environ.get("CXX", "").strip()
    if chosen:
        command = _words("CXX", chosen)
        if shutil.which(command[0]) is None:
            raise NoCompiler(f"CXX names '{command[0]}', which is not on the path: correct CXX or unset it")
        return command
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    raise NoCompiler("no C++ compiler found (looked for CXX, c++, g++, clang++): install g++ or clang++")


def _words(variable: str, text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise NoCompiler(f"{variable} is {text!r}, which no shell reads ({error}): correct or unset it") from None


def load_library(
    name: str, sources: Sequence[Path], headers: Sequence[Path] = (), flags: Sequence[str] = ()
) -> ctypes.CDLL:
    """The shared library compiled from `sources`: as a platform wheel brought it, else from the cache if it is there.

    Args:
        name: what the library is called in the cache and in messages, e.g. ``"rasterizer"``.
        headers: files the sources include; a change in them compiles anew, their folders are searched for includes.

    Raises:
        NoCompiler: there is no C++17 compiler.
        CompileError: the compiler refused the sources.
        D2Error: the cache folder cannot be written, or others may write it.
    """
    prebuilt = find_prebuilt(name, sources, headers, flags)
    if prebuilt is not None:
        return ctypes.CDLL(str(prebuilt))
    compiler = find_compiler()
    includes = dict.fromkeys(f"-I{file.parent}" for file in (*sources, *headers))
    user = _words("D2_CXXFLAGS", os.environ.get("D2_CXXFLAGS", ""))
    command = [*compiler, *BASE_FLAGS, *_native_flags(tuple(compiler)), *flags, *includes, *user]
    words = [*BASE_FLAGS, *flags, os.environ.get("D2_CXXFLAGS", ""), _predefined(tuple(command))]
    key = digest_of(words, (*sources, *headers))
    library = cache_folder() / f"{name}-{key}.so"
    with _guard:
        if library not in _loaded:
            check_private(library.parent)
            _loaded[library] = _open(library) or _build(library, command, sources)
        return _loaded[library]


@functools.cache
def _native_flags(compiler: tuple[str, ...]) -> tuple[str, ...]:
    for flags in NATIVE_FLAGS:
        if _run([*compiler, *flags, "-std=c++17", "-fsyntax-only", "-x", "c++", "-"]).returncode == 0:
            return flags
    raise NoCompiler(f"'{shlex.join(compiler)}' does not compile C++17: install a newer g++ or clang++, or set CXX")


@functools.cache
def _predefined(command: tuple[str, ...]) -> str:
    """Every macro that the compiler predefines: its version, the target and the instruction sets it will use."""
    shown = _run([part for part in command if part != "-shared"] + ["-E", "-dM", "-x", "c++", "-"])
    if shown.returncode:
        raise CompileError(f"the compiler refuses its flags ({shlex.join(command)}): {shown.stderr.strip()}")
    return shown.stdout


def _open(library: Path) -> ctypes.CDLL | None:
    """The cached library, or None where it is absent or damaged.

    The checksum comes first because the dynamic loader answers a truncated file with a bus error, not an exception.
    It is a guard against damage; against other people stands that nobody else can have written either file.
    """
    recorded = library.with_suffix(".sha256")
    try:
        if not is_trusted(library) or not is_trusted(recorded) or recorded.read_text() != _checksum(library):
            return None
        return ctypes.CDLL(str(library))
    except (OSError, UnicodeDecodeError):
        return None


def _build(library: Path, command: Sequence[str], sources: Sequence[Path]) -> ctypes.CDLL:
    try:
        private_cache()
        with cache_lock(library.with_suffix(".lock")):
            # Another process may have built it while this one waited for the lock.
            return _open(library) or _compile(library, command, sources)
    except OSError as error:
        raise D2Error(f"cannot use the cache {library.parent} ({error}): set D2_CACHE to a writable folder") from error


def _compile(library: Path, command: Sequence[str], sources: Sequence[Path]) -> ctypes.CDLL:
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix=library.stem, dir=library.parent) as folder:
        built = Path(folder) / library.name
        result = _run([*command, *map(str, sources), "-o", str(built)])
        if result.returncode:
            raise CompileError(
                f"compiling {', '.join(source.name for source in sources)} failed; please report the command "
                f"`{shlex.join(command)}` and what it said:\n{result.stderr.strip()[:MESSAGE_LIMIT]}"
            )
        if not built.is_file():
            raise CompileError(
                f"the compiler ended without an error and without a library (`{shlex.join(command)}`): set CXX to a "
                "g++ or clang++ that works"
            )
        built.chmod(0o700)  # whatever the umask: what others may write is not trusted afterwards
        checksum = _checksum(built)
        built.replace(library)
    recorded = library.with_suffix(".sha256")
    write_text(recorded, checksum)
    recorded.chmod(0o600)
    logger.info("compiled %s in %.1f s", library.name, time.perf_counter() - start)
    return ctypes.CDLL(str(library))


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    # LC_ALL=C: messages in English, whatever the user's language, since they end up in reports.
    environment = {**os.environ, "LC_ALL": "C"}
    try:
        return subprocess.run(command, input="", capture_output=True, text=True, env=environment, check=False)
    except OSError as error:
        raise NoCompiler(f"the compiler '{command[0]}' cannot be run ({error}): install g++ or clang++") from error
