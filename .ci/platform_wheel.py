"""`platform_wheel.py WHEEL FOLDER`: the same wheel with the CPU kernels compiled, for who has no compiler.

Every library of the package is compiled for each level of `d2_plugin.compiler.prebuilt.LEVELS` with the compiler of
this machine and without a dependency on libstdc++; the wheel's tag names the oldest glibc that they need. Nothing
else changes.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import subprocess
import sys
import tempfile
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, NoReturn

from d2_plugin import compiler
from d2_plugin.compiler import prebuilt

PACKAGE = Path(prebuilt.__file__).parents[1]
STATIC = ("-static-libstdc++", "-static-libgcc")
OLDEST_GLIBC = 17  # of manylinux_2_17, the oldest that there is a name for


class Library(NamedTuple):
    """What a call of `load_library` asks for."""

    name: str
    sources: tuple[Path, ...]
    headers: tuple[Path, ...] = ()
    flags: tuple[str, ...] = ()


class Noted(Exception):
    """Raised in place of loading."""


def libraries() -> list[Library]:
    """Every library that the package loads, as its modules ask for it."""
    found: list[Library] = []

    def note(name: str, sources: list[Path], headers: tuple = (), flags: tuple = ()) -> NoReturn:
        found.append(Library(name, tuple(sources), tuple(headers), tuple(flags)))
        raise Noted

    compiler.load_library = note  # before the modules below are loaded, which import it by name
    from d2_plugin.gaussians import native_background, native_slice, native_ssim
    from d2_plugin.hooks import native_depth_loss
    from d2_plugin.priors.cross_view import kernel as cross_view
    from d2_plugin.priors.stereo.filtering import kernel as filtering
    from d2_plugin.priors.stereo.patchmatch_kernel import PatchMatchKernel
    from d2_plugin.priors.stereo.settings import StereoSettings
    from d2_plugin.rasterizer import native

    gaussians = native, native_slice, native_ssim, native_background, native_depth_loss
    modules = *gaussians, filtering, cross_view
    loads = [*(module.library for module in modules), lambda: PatchMatchKernel([], (1.0, 2.0), StereoSettings())]
    for load in loads:
        with contextlib.suppress(Noted):
            load()
    missing = set(PACKAGE.rglob("*.cpp")) - {source for library in found for source in library.sources}
    assert not missing, f"no library has the sources {sorted(map(str, missing))}: add its module here"
    return found


def compiled(library: Library, level: str, folder: Path) -> Path:
    """One library for one level of instructions."""
    path = folder / prebuilt.file_name(library.name, level, library.sources, library.headers, library.flags)
    includes = dict.fromkeys(f"-I{file.parent}" for file in (*library.sources, *library.headers))
    command = [*compiler.find_compiler(), *compiler.BASE_FLAGS, prebuilt.LEVELS[level].flag, *library.flags, *includes]
    subprocess.run([*command, *map(str, library.sources), *STATIC, "-s", "-o", str(path)], check=True)
    return path


def glibc(paths: list[Path]) -> int:
    """The minor version of the oldest glibc 2 that has what these libraries need."""
    found = {int(number) for path in paths for number in re.findall(rb"GLIBC_2\.(\d+)", path.read_bytes())}
    return max({OLDEST_GLIBC, *found})


def record_line(name: str, data: bytes) -> str:
    """A line of RECORD."""
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    return f"{name},sha256={digest},{len(data)}\n"


def with_kernels(wheel: Path, folder: Path, kernels: list[Path]) -> Path:
    """The wheel with the libraries and their checksums in d2_plugin/compiled/."""
    tag = f"manylinux_2_{glibc(kernels)}_x86_64"
    with zipfile.ZipFile(wheel) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    (about,) = (name.removesuffix("WHEEL") for name in files if name.endswith(".dist-info/WHEEL"))
    del files[f"{about}RECORD"]
    described = files[f"{about}WHEEL"].decode().replace("Root-Is-Purelib: true", "Root-Is-Purelib: false")
    files[f"{about}WHEEL"] = described.replace("-none-any", f"-none-{tag}").encode()
    added = {path.name: path.read_bytes() for path in kernels}
    checksums = {name: hashlib.sha256(data).hexdigest() for name, data in added.items()}
    added[prebuilt.CHECKSUMS] = (json.dumps(checksums, indent=1) + "\n").encode()
    files |= {f"d2_plugin/{prebuilt.FOLDER.name}/{name}": data for name, data in added.items()}
    record = "".join(record_line(name, data) for name, data in files.items())
    out = folder / wheel.name.replace("-none-any", f"-none-{tag}")
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (files | {f"{about}RECORD": f"{record}{about}RECORD,,\n".encode()}).items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
    return out


def main(wheel: Path, folder: Path) -> str:
    """What was written."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        wanted = [(library, level) for library in libraries() for level in prebuilt.LEVELS]
        with ThreadPoolExecutor(8) as pool:
            kernels = list(pool.map(lambda pair: compiled(*pair, Path(work)), wanted))
        out = with_kernels(wheel, folder, kernels)
    return f"{out}: {len(kernels)} libraries, {out.stat().st_size / 1e6:.1f} MB"


if __name__ == "__main__":
    sys.stdout.write(main(Path(sys.argv[1]), Path(sys.argv[2])) + "\n")
