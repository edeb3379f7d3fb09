"""Reads a tree of Python files: which module imports which, where imports run in a circle or against the arrows.

Nothing is imported to find out: files are parsed, so that imports inside functions are seen too.
"""

from __future__ import annotations

import ast
import configparser
import fnmatch
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

AT_ONCE, LATER, TYPES = "at once", "later", "for types only"
LISTS = re.compile(r"[,\s]+")
DOCUMENT = re.compile(r"(?<![\w./:{}*~<-])((?:[\w.-]+/)+[\w-]+\.md)\b")
LINK = re.compile(r"\]\((?![a-z]+:|#)([^)#\s]+)[^)]*\)")


@dataclass(frozen=True)
class Import:
    """One import of a module of this project, and when it runs."""

    importer: str
    imported: str
    line: int
    when: str

    def __str__(self) -> str:
        return f"{self.importer}, line {self.line}, imports {self.imported}"


@dataclass(frozen=True)
class House:
    """Every module by its name as it is installed, and all imports between them."""

    files: Mapping[str, Path]
    imports: Sequence[Import]

    @classmethod
    def read(cls, packages: Mapping[str, Path]) -> House:
        """The modules of `packages`, which gives each top package's name and folder."""
        files = {}
        for package, folder in packages.items():
            for path in sorted(folder.rglob("*.py")):
                parts = path.relative_to(folder).with_suffix("").parts
                files[".".join([package, *parts]).removesuffix(".__init__")] = path
        imports = [found for name in files for found in _imports(name, files, frozenset(packages))]
        return cls(files, imports)

    def needs(self, name: str) -> set[str]:
        """Modules whose code `name` needs, at once or in a function: those it imports and the packages above them."""
        named = {step.imported for step in self.imports if step.importer == name and step.when != TYPES}
        parts = [other.split(".") for other in named]
        above = {".".join(words[:count]) for words in parts for count in range(1, len(words))}
        # The packages that hold `name` itself are there already: they are needed only where they are asked by name.
        return named | {package for package in above & set(self.files) if not f"{name}.".startswith(f"{package}.")}

    def circles(self) -> list[list[str]]:
        """Groups of modules that need each other, each sorted by name."""
        needs = {name: self.needs(name) for name in self.files}
        reached = {name: _reachable(name, needs) for name in needs}
        groups = {
            tuple(sorted(m for m in reached[name] if name in reached[m])) for name in needs if name in reached[name]
        }
        return [list(group) for group in sorted(groups)]


def room(module: str) -> str:
    """The folder or file of d2_plugin that a module is in, `__init__` for the package itself; `benchmarks` is one."""
    top, *inner = module.split(".")
    return top if top == "benchmarks" else (*inner, "__init__")[0]


def wrong_arrows(house: House, rooms: Mapping[str, str], ground: str) -> list[str]:
    """Imports that `rooms` does not allow, one sentence each; `ground` is what that word stands for in the table."""
    wrong = []
    for step in house.imports:
        at_once, later = _allowed(rooms, ground, room(step.importer))
        target = room(step.imported)
        if target in at_once or (step.when != AT_ONCE and target in later):
            continue
        hint = f": allowed inside a function only ({step.when} now)" if target in later else ""
        wrong.append(f"{step}, but {room(step.importer)} may not import {target}{hint}")
    return sorted(set(wrong))


def _allowed(rooms: Mapping[str, str], ground: str, importer: str) -> tuple[set[str], set[str]]:
    """Rooms that may be imported at once, and those inside functions only (in parentheses in the table)."""
    if importer not in rooms:
        importer = "ground" if importer in ground.split() else importer
    entry = rooms.get(importer, "")
    words = entry.replace("ground", ground).split()
    later = {word.strip("()") for word in words if word.startswith("(")}
    return {word for word in words if not word.startswith("(")} | {importer}, later


def unknown_rooms(house: House, rooms: Mapping[str, str], ground: str) -> list[str]:
    """Rooms of the house that the table does not name."""
    return sorted({room(name) for name in house.files} - set(rooms) - set(ground.split()))


def unpackaged(root: Path, setup: configparser.ConfigParser) -> list[str]:
    """What setup.cfg's `packages` and `package_data` say and the tree does not, and the other way round."""
    places = dict(re.split(r"\s*=\s*", line) for line in setup["options"]["package_dir"].split("\n") if line.strip())
    listed = {name: root / places.get(name, name.replace(".", "/")) for name in setup["options"]["packages"].split()}
    wrong = [
        f"{name} is in `packages` but {folder} is no package"
        for name, folder in listed.items()
        if not (folder / "__init__.py").exists()
    ]
    tops = [root / "d2_plugin", *(root / place for place in places.values())]
    found = {path.parent for top in tops for path in top.rglob("__init__.py")}
    wrong += [f"{folder} is a package but not in `packages`" for folder in sorted(found - set(listed.values()))]
    data = setup["options.package_data"]
    covered = set()
    for package, patterns in data.items():
        for pattern in filter(None, LISTS.split(patterns)):
            matches = set(listed.get(package, root / "nowhere").glob(pattern))
            wrong += [] if matches else [f"package_data's {package} = {pattern} matches no file"]
            covered |= matches
    every = (path for top in tops for path in top.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc"))
    beside = {path for path in every if not any(part.startswith(".") for part in path.relative_to(root).parts)}
    return wrong + [f"{path} is in no package_data" for path in sorted(beside - covered)]


def missing_documents(root: Path, files: Iterable[Path]) -> list[str]:
    """References in `files` to Markdown files or to link targets that are not in the tree under `root`."""
    wrong = []
    for path in files:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            names = DOCUMENT.findall(line) + (LINK.findall(line) if path.suffix == ".md" else [])
            missing = [name for name in names if not ((root / name).exists() or (path.parent / name).exists())]
            wrong += [f"{path.relative_to(root)}, line {number}, names {name}, which is not there" for name in missing]
    return wrong


def text_files(root: Path, places: Sequence[str], patterns: Sequence[str]) -> list[Path]:
    """Files under `root` in `places` (files or folders) whose names match one of `patterns`."""
    every = [
        path for place in places for path in ([root / place] if (root / place).is_file() else (root / place).rglob("*"))
    ]
    return sorted(path for path in every if path.is_file() and any(fnmatch.fnmatch(path.name, p) for p in patterns))


def _imports(name: str, files: Mapping[str, Path], groups: frozenset[str]) -> Iterator[Import]:
    tree = ast.parse(files[name].read_text(encoding="utf-8"))
    package = name if files[name].name == "__init__.py" else name.rpartition(".")[0]
    for node, when in _walk(tree, AT_ONCE):
        targets: Iterable[str] = ()
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            targets = [f"{base}.{alias.name}" if f"{base}.{alias.name}" in files else base for alias in node.names]
        elif isinstance(node, ast.Constant) and node.value in files and node.value not in groups:
            targets, when = [node.value], LATER  # a name for importlib or for `python -m`; groups are entry points'
        yield from (Import(name, target, node.lineno, when) for target in dict.fromkeys(targets) if target in files)


def _walk(node: ast.AST, when: str) -> Iterator[tuple[ast.AST, str]]:
    """Every node below `node` with when its imports run."""
    for child in ast.iter_child_nodes(node):
        now = when
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and when == AT_ONCE:
            now = LATER
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            now = TYPES
        yield child, now
        yield from _walk(child, now)


def _reachable(start: str, needs: Mapping[str, set[str]]) -> set[str]:
    found: set[str] = set()
    rest = list(needs[start])
    while rest:
        name = rest.pop()
        if name not in found:
            found.add(name)
            rest += needs.get(name, ())
    return found
