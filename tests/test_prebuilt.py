"""Kernels that came compiled with a wheel: the right ones for this CPU, whole ones only, and no compiler needed."""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path

import pytest

from d2_plugin import compiler
from d2_plugin.compiler import NoCompiler, find_compiler, load_library, prebuilt
from d2_plugin.errors import D2Error

try:
    find_compiler()
except NoCompiler as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    file = tmp_path / "answer.cpp"
    file.write_text('extern "C" int answer() { return 42; }\n')
    return file


@pytest.fixture
def folder(tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with a library for each level; each says which it is."""
    folder = tmp_path / "compiled"
    folder.mkdir()
    monkeypatch.setattr(prebuilt, "FOLDER", folder)
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", "")
    checksums = {}
    for number, level in enumerate(prebuilt.LEVELS):
        path = folder / prebuilt.file_name("answer", level, [source], [], [])
        text = f'extern "C" int answer() {{ return {number}; }}\n'
        command = ["/usr/bin/env", "PATH=/usr/local/bin:/usr/bin:/bin", "c++", "-shared", "-fPIC", "-x", "c++", "-"]
        subprocess.run([*command, "-o", path], input=text, text=True, check=True)
        checksums[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / prebuilt.CHECKSUMS).write_text(json.dumps(checksums))
    prebuilt._checksums.cache_clear()
    compiler._loaded.clear()
    return folder


def have(monkeypatch: pytest.MonkeyPatch, level: str) -> None:
    """Let this be a CPU with that level and no more."""
    monkeypatch.setattr(prebuilt, "_cpu_flags", lambda: prebuilt.LEVELS[level].needs)
    monkeypatch.setattr(prebuilt.platform, "machine", lambda: "x86_64")


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("level", prebuilt.LEVELS)
def test_each_cpu_gets_the_best_it_can_run_without_a_compiler(
    source: Path, monkeypatch: pytest.MonkeyPatch, level: str
) -> None:
    have(monkeypatch, level)
    assert load_library("answer", [source]).answer() == list(prebuilt.LEVELS).index(level)


@pytest.mark.usefixtures("folder")
def test_a_lower_level_may_be_asked_for(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    have(monkeypatch, "avx512")
    monkeypatch.setenv("D2_CPU", "avx2")
    assert load_library("answer", [source]).answer() == 1
    monkeypatch.setenv("D2_CPU", "sse9")
    with pytest.raises(D2Error, match=r"sse9.*avx2, avx512, scalar"):
        load_library("answer", [source])


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("change", ["source", "flags", "name"])
def test_a_library_of_another_version_is_never_taken(
    source: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    have(monkeypatch, "avx2")
    if change == "source":
        source.write_text('extern "C" int answer() { return 43; }\n')
    name, flags = ("other" if change == "name" else "answer"), (["-DX"] if change == "flags" else [])
    with pytest.raises(NoCompiler):
        load_library(name, [source], flags=flags)


@pytest.mark.parametrize("damage", ["truncated", "garbage", "gone"])
def test_a_damaged_library_is_not_loaded_and_a_lower_level_takes_its_place(
    source: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    have(monkeypatch, "avx512")
    path = folder / prebuilt.file_name("answer", "avx512", [source], [], [])
    whole = path.read_bytes()
    path.unlink()
    if damage != "gone":
        path.write_bytes(whole[:3000] if damage == "truncated" else b"?" * len(whole))
    assert load_library("answer", [source]).answer() == 1


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("variable", ["CXX", "D2_CXXFLAGS"])
def test_who_chooses_a_compiler_or_flags_gets_a_compilation(
    source: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    have(monkeypatch, "avx2")
    monkeypatch.setenv("PATH", "/usr/local/bin:/usr/bin:/bin")
    monkeypatch.setenv(variable, "c++" if variable == "CXX" else "-DX")
    assert load_library("answer", [source]).answer() == 42


def test_another_processor_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prebuilt.platform, "machine", lambda: "aarch64")
    assert prebuilt.usable() == []


def test_a_checkout_has_none() -> None:
    assert not prebuilt.FOLDER.exists()
