"""What a repository imports and this environment lacks: packages, and modules that the repository builds in CUDA.

What a script needs is read from its own files (`needed`), so that it holds for any snapshot of a repository. Nothing is
installed: stand-ins live in the memory of the process. `d2 doctor --attach` prints the report `needs`.
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

import torch

from d2_plugin.attach.session import Original, Recipe
from d2_plugin.errors import D2Error
from d2_plugin.reading import parsing, read_bytes, said

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StandIn:
    """What we have for a package that is missing: `provided` maps its names to ours; the rest may only be imported."""

    provided: Mapping[str, str]
    why: str


COMPAT = "d2_plugin.compat"
WIDTH = 48
"""Of the column of names in the report."""

SCRIPT = "give the trainer's repository or its script"
MOST_SCRIPT = 1 << 24
"""Bytes of a script, at most."""

STAND_INS = {
    "torchvision": StandIn(
        {
            "torchvision.utils.make_grid": f"{COMPAT}.vision:make_grid",
            "torchvision.utils.save_image": f"{COMPAT}.vision:save_image",
            "torchvision.transforms.ToTensor": f"{COMPAT}.vision:ToTensor",
            "torchvision.transforms.ToPILImage": f"{COMPAT}.vision:ToPILImage",
            "torchvision.transforms.functional.resize": f"{COMPAT}.vision:resize",
        },
        "its wheel must match the build of torch",
    ),
    "mmcv": StandIn(
        {"mmcv.Config": f"{COMPAT}.python_config:Config", "mmcv.ops.knn": f"{COMPAT}.nearest:knn"},
        "the version that has Config (below 2) builds on few machines",
    ),
    "pytorch3d": StandIn(
        {
            f"pytorch3d.transforms.{name}": f"{COMPAT}.kinematic:{name}"
            for name in ("quaternion_apply", "quaternion_invert", "quaternion_multiply")
        },
        "it is built for one torch and one CUDA, and the trainer calls three functions of it",
    ),
    "faiss": StandIn(
        {f"faiss.{name}": f"{COMPAT}.nearest:{name}" for name in ("StandardGpuResources", "GpuIndexFlatL2")},
        "the build for GPUs is not on the package index, and the trainer asks for one nearest neighbour",
    ),
    **dict.fromkeys(("open3d", "tkinter"), StandIn({}, "the trainer imports it and calls nothing of it")),
    "lpips": StandIn({}, "the trainer imports it and calls nothing of it while training"),
    **dict.fromkeys(("nerfview", "viser"), StandIn({}, "gsplat's viewer asks for it: give --disable_viewer")),
    "pointops2_cuda": StandIn({}, "it is built in CUDA and called for lambda_rigid > 0 alone"),
}
"""By the name that is imported. A new one is a row here."""

INSTALL = {
    **{"cv2": "opencv-python-headless", "sklearn": "scikit-learn", "skimage": "scikit-image"},
    **{"PIL": "pillow", "yaml": "pyyaml"},
}
"""What pip calls a package whose import has another name."""


def needs(recipe: Recipe, path: Path) -> str:
    """One line for each package that is missing or stood in for, and one that says whether the launcher can run.

    `path` is the repository's folder, or its script.
    """
    script = path if path.is_file() else path / recipe.script
    if not script.is_file():
        raise D2Error(f"no {recipe.script} in {path}: give the folder of the repository, or its script")
    beside = [script.parent / name for name in recipe.folders]  # gsplat's examples import gsplat, one folder up
    absent = missing(script, {original.name for original in recipe.originals})
    absent = {name: where for name, where in absent.items() if not any((folder / name).is_dir() for folder in beside)}
    certain = needed(script, conditional=False)
    to_install = [name for name in absent if name not in STAND_INS and name in certain]
    lines = [f"{script} imports {len(needed(script))} packages at once"]
    for name, where in absent.items():
        if name in STAND_INS:
            way = f"the launcher stands in for it; {STAND_INS[name].why}"
        else:
            way = f"run `{pip_command([name])}`" if name in to_install else "some options alone import it"
        lines.append(f"{name:{WIDTH}}missing ({where}): {way}")
    lines += [_built(original, script.parent) for original in recipe.originals]
    if not torch.cuda.is_available():
        lines.append(f"{'GPU':{WIDTH}}none: give the launcher --cpu, which is slow")
    verdict = f"install what is missing: `{pip_command(to_install)}`" if to_install else "the launcher can run it"
    return "\n".join([*lines, verdict])


def _built(original: Original, folder: Path) -> str:
    """Whether a module that the repository builds in CUDA is there; it is not loaded."""
    if original.file is not None:
        there = (folder / original.file).is_file()
        state = "built at its first import, with a GPU" if there else f"no {original.file}"
    else:
        there = _is_there(original.name.split(".")[0])
        state = "installed" if there else "not built"
    ours = "" if there and torch.cuda.is_available() else f": {original.stand_in} can stand in for it"
    return f"{original.name:{WIDTH}}{state}{ours}"


def provide(originals: tuple[Original, ...], folder: Path, on_cpu: bool, replace_broken: bool) -> None:
    """Load every original, or put our stand-in into its place, and log which.

    Args:
        originals: what the repository needs.
        folder: where its script lies.
        on_cpu: its CUDA builds cannot run, so they are not tried.
        replace_broken: whether ours takes the place of an original that cannot be loaded.

    Raises:
        D2Error: an original cannot be loaded and must not be replaced.
    """
    for original in originals:
        reason = "it needs a GPU" if on_cpu else _failure(original, folder)
        if reason is None:
            log.info("%s: the original is used", original.name)
        elif on_cpu or replace_broken:
            _put(original)
            log.warning("%s: %s stands in for it (%s)", original.name, original.stand_in, reason)
        else:
            raise D2Error(
                f"{original.name} cannot be loaded ({reason}): build it as the repository says, or give --stand-ins "
                "to train with D2's own rasterizer in its place"
            )


def _failure(original: Original, folder: Path) -> str | None:
    """Why the original cannot be loaded, or None; a module inside the repository is built once, here."""
    try:
        if original.loader is not None:
            module, attribute = original.loader
            if getattr(importlib.import_module(module), attribute, original) is None:
                return f"{module} finds no kernels and cannot build them"
        elif original.file is None:
            importlib.import_module(original.name)
        elif (folder / original.file).is_file():
            _import_file(original.name, folder / original.file)
        else:
            return f"no file {original.file}"
    except Exception as error:  # a failed build raises anything: ImportError, OSError, RuntimeError, CalledProcessError
        sys.modules.pop(original.name, None)
        return f"its import failed: {said(error)}"
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
    if parent and original.file is None and not _is_there(parent):
        package = types.ModuleType(parent)
        package.__path__ = []
        sys.modules[parent] = package
    sys.modules[original.name] = importlib.import_module(original.stand_in)


def needed(script: Path, conditional: bool = True) -> dict[str, str]:
    """Packages that `script` and the files of its repository import at once, and where first; from the files alone.

    Imports inside functions and inside `try` wait or may fail, so they are left out, and so is the standard library but
    for what many machines lack of it and `STAND_INS` names.
    Those under an `if` depend on options; they are left out unless `conditional`.
    """
    packages: dict[str, str] = {}
    standard = getattr(sys, "stdlib_module_names", ())  # Python 3.9 does not list them: everything is looked for there
    root, seen, waiting = script.parent, set[Path](), [script]
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        roots = (root, file.parent, *(folder for folder in file.parents if root in folder.parents))
        for name, line in _imports(file, conditional):
            inside = next((place for base in roots for place in _inside(base, name.lstrip("."))), None)
            top = "tensorboard" if name.startswith("torch.utils.tensorboard") else name.split(".")[0]
            if inside is not None:
                waiting.append(inside)
            elif top and (top in STAND_INS or top not in standard) and not any((base / top).is_dir() for base in roots):
                packages.setdefault(top, f"{file.relative_to(root)}:{line}")
    return packages


def missing(script: Path, replaced: set[str]) -> dict[str, str]:
    """Packages of `needed` that cannot be found here; `replaced` are modules that the recipe puts into place."""
    tops = {name.split(".")[0] for name in replaced}
    return {name: where for name, where in needed(script).items() if name not in tops and not _is_there(name)}


def stand_in_for(script: Path, replaced: set[str]) -> None:
    """Put a stand-in where there is one, and log it.

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
    """Names that a file imports when it is loaded, with lines; `from .a import b` gives .a.b, which is no package."""
    source = read_bytes(file, SCRIPT, MOST_SCRIPT).decode(errors="replace")
    with parsing(f"{file} as Python of this version", SCRIPT):
        tree = ast.parse(source)
    for node in _at_once(tree, conditional):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((f"{'.' * node.level}{node.module}.{alias.name}", node.lineno) for alias in node.names)


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
