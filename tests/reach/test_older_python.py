"""What a trainer's process imports runs where official environments stand: Python 3.9 and torch 2.0."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import pytest

from d2_plugin import older, registry
from d2_plugin.config import D2Config
from d2_plugin.errors import D2Error
from d2_plugin.hooks import HOOKS
from d2_plugin.settings import Range, Settings, declared

LOADED = """
import importlib, pkgutil, sys
import d2_plugin
from d2_plugin import D2Config, D2Hooks, registry
import d2_plugin.attach.launch, d2_plugin.store.exported
for room in ("hooks", "gaussians", "rasterizer", "adapters", "compat", "attach"):
    package = importlib.import_module("d2_plugin." + room)
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
for name in registry.names(registry.ADAPTERS):
    registry.load(registry.ADAPTERS, name)
for name, module in sorted(sys.modules.items()):
    if name.split(".")[0] == "d2_plugin" and getattr(module, "__file__", None):
        print(module.__file__)
"""
"""Imports what a trainer may, and prints the files that this loads."""


@functools.cache
def trainer_files() -> list[str]:
    done = subprocess.run([sys.executable, "-c", LOADED], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_what_a_trainer_imports_keeps_to_python_3_9() -> None:
    pytest.importorskip("vermin", reason="needs vermin")
    files = trainer_files()
    names = {Path(file).relative_to(Path(files[0]).parent).as_posix() for file in files if "d2_plugin" in file}
    assert {"plugin.py", "protocol.py", "settings.py", "store/store.py", "attach/launch.py"} <= names
    options = ["--no-tips", "--violations", "--no-parse-comments", "--exclude", "long"]  # Tensor.long is no Python 2
    command = [sys.executable, "-c", "from vermin import main; main()", *options, "-t=3.9-", *files]
    judged = subprocess.run(command, capture_output=True, text=True, check=False)
    assert judged.returncode == 0, judged.stdout + judged.stderr


def unions_at_run_time(text: str) -> list[str]:
    """`A | None` and `A | B` of types outside annotations, which Python 3.9 cannot evaluate and vermin does not see."""
    tree, types = ast.parse(text), {"None", "str", "int", "float", "bool", "list", "dict", "tuple", "Path", "Mapping"}
    notes = [getattr(node, name, None) for node in ast.walk(tree) for name in ("annotation", "returns")]
    inside = {id(node) for note in notes if note is not None for node in ast.walk(note)}
    unions = (n for n in ast.walk(tree) if isinstance(n, ast.BinOp) and isinstance(n.op, ast.BitOr))
    found = [ast.unparse(node) for node in unions if id(node) not in inside]
    return [union for union in found if "{" not in union and types & set(union.split(" | "))]


def test_no_union_of_types_is_evaluated_at_run_time() -> None:
    found = {file: unions_at_run_time(Path(file).read_text()) for file in trainer_files()}
    assert {file: unions for file, unions in found.items() if unions} == {}
    assert unions_at_run_time("x = f(float | None)\ndef g(a: int | None) -> str | None: ...") == ["float | None"]


class TestAnnotations:
    """Settings are declared as `int | None`, which Python 3.9 evaluates with a stand-in."""

    @pytest.mark.parametrize("kind", [D2Config, *(hook.config for hook in HOOKS.values())])
    def test_the_stand_in_reads_what_newer_pythons_read(self, kind: type) -> None:
        pytest.importorskip("eval_type_backport", reason="needs eval-type-backport")
        assert older.backported_hints(kind) == older.hints_of(kind)

    def test_unions_are_known_in_both_spellings(self) -> None:
        @dataclass(frozen=True)
        class Old(Settings):
            share: Optional[Annotated[float, Range(0, 1)]] = None  # noqa: UP045  as the stand-in evaluates it

        with pytest.raises(D2Error, match=r"Old.share"):
            Old(share=2.0)
        assert declared(Old)[0].default is None

    def test_a_missing_stand_in_is_named_with_its_command(self) -> None:
        with pytest.raises(D2Error, match=r"cannot read TOML by itself: run `pip install tomli`"):
            older.stand_in("no_such_module", "tomli", "read TOML")


def test_entry_points_are_found_in_the_shape_of_python_3_9(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {point.name: point for point in registry.entry_points(group=registry.ADAPTERS)}
    monkeypatch.setattr(registry.sys, "version_info", (3, 9, 2))
    monkeypatch.setattr(registry, "entry_points", lambda: {registry.ADAPTERS: tuple(found.values())})
    assert registry.names(registry.ADAPTERS) == sorted(found)
    assert registry.names("d2_plugin.no_such_group") == []


def test_the_command_line_says_which_python_it_needs(
    refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`d2` is for the environment where priors are built; a trainer's may be older and needs the three lines alone."""
    monkeypatch.setattr(sys, "version_info", (3, 9, 2, "final", 0))
    assert "the commands need Python 3.11 or later, this is 3.9: run them in another environment" in refused("plan")
