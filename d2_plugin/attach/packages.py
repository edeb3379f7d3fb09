"""Packages that a repository imports and this environment lacks: what can stand in for them, and how to get the rest.

What a script needs is read from its own files (`needed`), so that it holds for any snapshot of a repository. Nothing is
installed: stand-ins live in the memory of the process.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import logging
import sys
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from d2_plugin.errors import D2Error
from d2_plugin.reading import read_bytes, said

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StandIn:
    """What we have for a package that is missing: `provided` maps its names to ours; the rest may only be imported."""

    provided: Mapping[str, str]
    why: str


VISION = "d2_plugin.compat.vision"
KINEMATIC = "d2_plugin.compat.kinematic"

SCRIPT = "give the trainer's repository or its script"
MOST_SCRIPT = 1 << 24
"""Bytes of a script, at most."""

STAND_INS = {
    "torchvision": StandIn(
        {
            "torchvision.utils.make_grid": f"{VISION}:make_grid",
            "torchvision.utils.save_image": f"{VISION}:save_image",
            "torchvision.transforms.ToTensor": f"{VISION}:ToTensor",
            "torchvision.transforms.ToPILImage": f"{VISION}:ToPILImage",
            "torchvision.transforms.functional.resize": f"{VISION}:resize",
        },
        "its wheel must match the build of torch",
    ),
    "mmcv": StandIn(
        {"mmcv.Config": "d2_plugin.compat.python_config:Config", "mmcv.ops.knn": "d2_plugin.compat.knn:knn"},
        "the version that has Config (below 2) builds on few machines",
    ),
    "pytorch3d": StandIn(
        {
            f"pytorch3d.transforms.{name}": f"{KINEMATIC}:{name}"
            for name in ("quaternion_apply", "quaternion_invert", "quaternion_multiply")
        },
        "it is built for one torch and one CUDA, and the trainer calls three functions of it",
    ),
    "faiss": StandIn(
        {f"faiss.{name}": f"{KINEMATIC}:{name}" for name in ("StandardGpuResources", "GpuIndexFlatL2")},
        "the build for GPUs is not on the package index, and the trainer asks for one nearest neighbour",
    ),
    "open3d": StandIn({}, "the trainer imports it and calls nothing of it"),
    "lpips": StandIn({}, "the trainer imports it and calls nothing of it while training"),
    "nerfview": StandIn({}, "gsplat's script imports it for its viewer: give --disable_viewer"),
    "viser": StandIn({}, "gsplat's script imports it for its viewer: give --disable_viewer"),
    "pointops2_cuda": StandIn({}, "it is built in CUDA and called for lambda_rigid > 0 alone"),
}
"""By the name that is imported. A new one is a row here."""

INSTALL = {
    **{"cv2": "opencv-python-headless", "sklearn": "scikit-learn", "skimage": "scikit-image"},
    **{"PIL": "pillow", "yaml": "pyyaml"},
}
"""What pip calls a package whose import has another name."""


def _standard_library() -> frozenset[str]:
    """Names of its modules; Python 3.9 does not list them, so there everything is looked for."""
    return getattr(sys, "stdlib_module_names", frozenset())


def needed(script: Path, conditional: bool = True) -> dict[str, str]:
    """Packages that `script` and the files of its repository import at once, and where first; from the files alone.

    Imports inside functions and inside `try` wait or may fail, so they are left out, and so is the standard library.
    Those under an `if` depend on options; they are left out unless `conditional`.
    """
    found: dict[str, str] = {}
    root, seen, waiting = script.parent, set[Path](), [script]
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        roots = (root, file.parent, *(folder for folder in file.parents if root in folder.parents))
        for name, line in _imports(file, conditional):
            inside = next((place for base in roots for place in _inside(base, name)), None)
            top = name.split(".")[0]
            if inside is not None:
                waiting.append(inside)
            elif top not in _standard_library() and not any((base / top).is_dir() for base in roots):
                found.setdefault(top, f"{file.relative_to(root)}:{line}")
    return found


def missing(script: Path, replaced: set[str]) -> dict[str, str]:
    """Packages of `needed` that cannot be found here; `replaced` are modules that the recipe puts into place."""
    tops = {name.split(".")[0] for name in replaced}
    return {name: where for name, where in needed(script).items() if name not in tops and not _is_there(name)}


def stand_in_for(script: Path, replaced: set[str]) -> None:
    """Put a stand-in where there is one and say so.

    Raises:
        D2Error: packages are missing that nothing stands in for; one sentence with the pip command.
    """
    absent = missing(script, replaced)
    certain = needed(script, conditional=False)
    unknown = [name for name in absent if name not in STAND_INS and name in certain]
    if unknown:
        places = ", ".join(f"{name} ({absent[name]})" for name in unknown)
        raise D2Error(f"the trainer imports what is not installed: {places}; run `{pip_command(unknown)}`")
    for name in absent.keys() & STAND_INS.keys():
        sys.meta_path.append(_Finder(name))
        log.warning("%s is missing: D2 stands in for what training calls of it (%s)", name, STAND_INS[name].why)


def pip_command(names: list[str]) -> str:
    """How to get packages by the names that are imported."""
    return "pip install " + " ".join(INSTALL.get(name, name) for name in names)


def _is_there(name: str) -> bool:
    if name in sys.modules:
        return True
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _imports(file: Path, conditional: bool) -> Iterator[tuple[str, int]]:
    """Absolute names that a file imports when it is loaded, with lines; `from a import b` gives a.b and a."""
    source = read_bytes(file, SCRIPT, MOST_SCRIPT).decode(errors="replace")
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as failure:
        raise D2Error(f"{file} is no Python that this version reads ({said(failure)}): {SCRIPT}") from None
    for node in _at_once(tree, conditional):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


def _at_once(node: ast.AST, conditional: bool) -> Iterator[ast.AST]:
    """Statements that run when the module is loaded and whose failure is not caught."""
    for child in ast.iter_child_nodes(node):
        depends = isinstance(child, ast.If) and "__name__" not in ast.dump(child.test) and not conditional
        if not depends and not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.Try)):
            yield child
            yield from _at_once(child, conditional)


def _inside(root: Path, name: str) -> Iterator[Path]:
    """Files of the repository that an absolute name may stand for, the longest first."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        place = root.joinpath(*parts[:length])
        yield from (file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file())


class _Finder(MetaPathFinder, Loader):
    """Finds one absent package and everything below it; asked last, after all that is really there."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        inside = fullname == self.package or fullname.startswith(f"{self.package}.")
        return ModuleSpec(fullname, self, is_package=True) if inside else None

    def create_module(self, spec: ModuleSpec) -> types.ModuleType:
        return _Absent(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        """Nothing to run."""


class _Absent(types.ModuleType):
    """A module that is not installed: what we have of it works, everything else says so when it is called."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        full = f"{self.__name__}.{name}"
        package = full.split(".")[0]
        ours = STAND_INS[package].provided
        if full in ours:
            module, attribute = ours[full].split(":")
            return getattr(importlib.import_module(module), attribute)
        if any(key.startswith(f"{full}.") for key in ours):
            return importlib.import_module(full)
        return _NotCallable(full)


class _NotCallable:
    """Anything else of an absent package: it may be imported, named and passed on, not called."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _NotCallable(f"{self._name}.{name}")

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[type, ...]:
        """A class of the trainer's may derive from it."""
        return (object,)

    def __call__(self, *_: Any, **__: Any) -> Any:
        package = self._name.split(".")[0]
        raise D2Error(f"the trainer calls {self._name}, and {package} is missing: run `{pip_command([package])}`")
