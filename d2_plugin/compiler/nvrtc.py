"""NVRTC: the compiler of the GPU kernels, which CUDA builds of torch bring along. No toolkit, no nvcc, no headers.

Compiled kernels are kept in the cache folder of `d2_plugin.compiler`, named by a hash of sources, flags, architecture
and NVRTC's version.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from d2_plugin.cache import cache_folder, check_private, is_trusted, private_cache
from d2_plugin.compiler import CompileError
from d2_plugin.compiler.prebuilt import digest_of
from d2_plugin.durable import CannotWrite, write
from d2_plugin.errors import D2Error

logger = logging.getLogger(__name__)


class NoCuda(D2Error):
    """The kernels are not available on this GPU; a caller with a slower way takes it."""


class Program(NamedTuple):
    """A CUDA source and the headers that it includes, by their bare names."""

    source: Path
    headers: tuple[Path, ...]


class Binary(NamedTuple):
    """What NVRTC made: a cubin, or PTX where it does not know the GPU yet and the driver has to finish the work."""

    code: bytes
    architecture: str


class Nvrtc:
    """The NVRTC library: its version, its architectures, its compiler."""

    def __init__(self) -> None:
        """Find and load the library.

        Raises:
            NoCuda: there is none.
        """
        self._library = _load()
        self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._check(self._library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
        self.version = (major.value, minor.value)

    def architectures(self) -> list[int]:
        """Compute capabilities it compiles for, ascending: 90 is sm_90."""
        count = ctypes.c_int()
        self._check(self._library.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
        found = (ctypes.c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(found))
        return sorted(found)

    def architecture_for(self, capability: int) -> str:
        """The architecture to compile for: the GPU's own, or the newest virtual one before it.

        Raises:
            NoCuda: the GPU is older than all that NVRTC knows.
        """
        known = self.architectures()
        if capability in known:
            return f"sm_{capability}"
        older = [architecture for architecture in known if architecture < capability]
        if not older:
            raise NoCuda(
                f"the GPU is sm_{capability}, but NVRTC {self.version[0]}.{self.version[1]} compiles for sm_{known[0]} "
                "and newer: install a torch built for an older CUDA"
            )
        return f"compute_{older[-1]}"

    def compile(self, code: Program, architecture: str, flags: Sequence[str]) -> bytes:
        """A program as a cubin (``sm_90``) or as PTX (``compute_90``).

        Raises:
            CompileError: NVRTC refused it; the message carries its words.
        """
        names = [header.name.encode() for header in code.headers]
        texts = [header.read_bytes() for header in code.headers]
        array = ctypes.c_char_p * len(names)
        program = ctypes.c_void_p()
        arguments = (code.source.read_bytes(), code.source.name.encode(), len(names), array(*texts), array(*names))
        self._check(self._library.nvrtcCreateProgram(ctypes.byref(program), *arguments))
        try:
            options = [option.encode() for option in (f"--gpu-architecture={architecture}", *flags)]
            array = ctypes.c_char_p * len(options)
            if self._library.nvrtcCompileProgram(program, len(options), array(*options)):
                said = self._read(program, "ProgramLog").decode(errors="replace").strip(chr(0))
                raise CompileError(
                    f"NVRTC {self.version[0]}.{self.version[1]} failed on {code.source.name} for {architecture}; "
                    f"please report what it said:\n{said}"
                )
            return self._read(program, "CUBIN" if architecture.startswith("sm_") else "PTX")
        finally:
            self._library.nvrtcDestroyProgram(ctypes.byref(program))

    def _read(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
        buffer = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, buffer))
        return buffer.raw

    def _check(self, result: int) -> None:
        if result:
            raise D2Error(f"NVRTC says {self._library.nvrtcGetErrorString(result).decode()}: please report this")


library = functools.cache(Nvrtc)
"""The NVRTC library, loaded once."""


def build(name: str, code: Program, flags: Sequence[str], capability: int) -> Binary:
    """A program for GPUs of compute capability `capability` (90 is sm_90), from the cache where it is there already.

    Args:
        flags: of NVRTC, without the architecture.

    Raises:
        NoCuda: no NVRTC, or it does not know the GPU.
        CompileError: NVRTC refused the source.
    """
    compiler = library()
    architecture = compiler.architecture_for(capability)
    key = digest_of([repr((tuple(flags), architecture, compiler.version))], (code.source, *code.headers))
    entry = cache_folder() / f"{name}-{architecture}-{key}.cubin"
    if (binary := _read_entry(entry)) is None:
        start = time.perf_counter()
        binary = compiler.compile(code, architecture, flags)
        logger.info("compiled %s in %.1f s", entry.name, time.perf_counter() - start)
        _write_entry(entry, binary)
    return Binary(binary, architecture)


def _read_entry(entry: Path) -> bytes | None:
    """What `_write_entry` wrote, or None where it is absent or damaged.

    Raises:
        Untrusted: others may write the cache.
    """
    check_private(entry.parent)
    if not is_trusted(entry):
        return None
    try:
        content = entry.read_bytes()
    except OSError:
        return None
    checksum, code = content[:32], content[32:]
    return code if hashlib.sha256(code).digest() == checksum else None


def _write_entry(entry: Path, code: bytes) -> None:
    """The checksum, then the code; renamed into place, so that processes which start together need no lock."""
    try:
        private_cache()
        write(entry, hashlib.sha256(code).digest() + code)
        entry.chmod(0o600)
    except (OSError, CannotWrite) as error:
        logger.warning("cannot use the cache %s (%s): kernels are compiled in every process", entry.parent, error)


def _load() -> ctypes.CDLL:
    for path in _files():
        try:
            # libnvrtc finds its builtins by their bare name only; it has no search path of its own.
            for builtins in sorted(path.parent.glob("*nvrtc-builtins*")):
                if ".alt." not in builtins.name:
                    ctypes.CDLL(str(builtins), mode=ctypes.RTLD_GLOBAL)
            return ctypes.CDLL(str(path))
        except OSError as error:
            logger.debug("cannot load %s: %s", path, error)
    for name in ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise NoCuda("NVRTC, which compiles the GPU kernels, was not found: run `pip install 'd2-4dgs[cuda]'`")


def _files() -> Iterator[Path]:
    """Libraries that pip installed, those of torch's own CUDA version first: a newer one than the driver is no use."""
    specification = importlib.util.find_spec("nvidia")
    folders = [Path(folder) for folder in (specification.submodule_search_locations or ())] if specification else []
    folders.append(Path(torch.__file__).parent / "lib")
    patterns = ("*/bin/**/nvrtc64_*.dll", "nvrtc64_*.dll", "*/lib/libnvrtc[.-]*so*", "libnvrtc[.-]*so*")
    paths = [path for folder in folders for pattern in patterns for path in sorted(folder.glob(pattern))]
    found = [path for path in paths if "builtins" not in path.name and ".alt." not in path.name]
    major = (torch.version.cuda or "").partition(".")[0]
    return iter(sorted(found, key=lambda path: not (major and f".so.{major}" in path.name)))
