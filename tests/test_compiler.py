"""Kernels compile themselves at first use, once, whatever else happens."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from d2_plugin import compiler
from d2_plugin.compiler import CompileError, NoCompiler, cache_folder, find_compiler, load_library
from d2_plugin.errors import D2Error

try:
    find_compiler()
except NoCompiler as error:
    pytest.skip(str(error), allow_module_level=True)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """An empty cache for every test."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("D2_CACHE", str(folder))
    return folder


@pytest.fixture
def source(tmp_path) -> Path:
    file = tmp_path / "answer.cpp"
    file.write_text('#include "number.h"\nextern "C" int answer() { return NUMBER; }\n')
    (tmp_path / "number.h").write_text("#define NUMBER 42\n")
    return file


def load(source: Path, **options: object) -> ctypes.CDLL:
    return load_library("answer", [source], [source.with_name("number.h")], **options)


@pytest.fixture
def builds(monkeypatch) -> list[str]:
    """What is compiled during the test."""
    names = []
    build = compiler._compile

    def counted(library: Path, *rest: object) -> ctypes.CDLL:
        names.append(library.name)
        return build(library, *rest)

    monkeypatch.setattr(compiler, "_compile", counted)
    return names


def forget() -> None:
    """As a new process would: nothing is loaded yet."""
    compiler._loaded.clear()


def test_a_source_is_compiled_once_and_then_taken_from_the_cache(source, builds, cache):
    assert load(source).answer() == 42
    forget()
    assert load(source).answer() == 42
    assert len(builds) == 1
    assert [path.suffix for path in sorted(cache.iterdir())] == [".lock", ".sha256", ".so"], "nothing temporary is left"


def test_a_changed_header_or_flag_compiles_anew(source, builds):
    load(source)
    source.with_name("number.h").write_text("#define NUMBER 43\n")
    assert load(source).answer() == 43
    load(source, flags=["-DUNUSED"])
    assert len(set(builds)) == 3


def test_the_users_own_flags_come_last_and_count(source, builds, monkeypatch):
    load(source)
    source.with_name("number.h").write_text("#ifndef NUMBER\n#define NUMBER 1\n#endif\n")
    monkeypatch.setenv("D2_CXXFLAGS", "-DNUMBER=7")
    assert load(source).answer() == 7
    assert len(builds) == 2


@pytest.mark.parametrize("damage", ["truncated", "garbage", "empty", "no checksum"])
def test_a_broken_cache_entry_is_rebuilt(source, builds, cache, damage):
    load(source)
    forget()
    (library,) = cache.glob("*.so")
    whole = library.read_bytes()
    # A new file, as a crash would leave it: the old one is still mapped by this process.
    library.unlink()
    library.write_bytes({"truncated": whole[:5000], "garbage": b"?" * len(whole), "empty": b""}.get(damage, whole))
    if damage == "no checksum":
        library.with_suffix(".sha256").unlink()
    assert load(source).answer() == 42
    assert len(builds) == 2


def test_a_mistake_in_the_source_is_told_in_the_compilers_own_words(source):
    source.write_text('extern "C" int answer() { return no_such_name; }\n')
    with pytest.raises(CompileError, match=r"compiling answer\.cpp failed(.|\n)*no_such_name"):
        load(source)


def test_flags_that_the_compiler_does_not_know_are_told_too(source):
    with pytest.raises(CompileError, match="no-such-flag"):
        load(source, flags=["-fno-such-flag-at-all"])


def test_no_compiler_is_an_error_of_its_own(source, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(NoCompiler, match="CXX names 'no-such-compiler'"):
        load(source)
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(NoCompiler, match=r"install g\+\+ or clang\+\+"):
        load(source)


def test_a_compiler_from_before_2017_counts_as_none(source, monkeypatch, tmp_path):
    old = tmp_path / "old-c++"
    old.write_text("#!/bin/sh\necho \"unrecognized command line option '-std=c++17'\" >&2\nexit 1\n")
    old.chmod(0o755)
    monkeypatch.setenv("CXX", str(old))
    with pytest.raises(NoCompiler, match=r"does not compile C\+\+17"):
        load(source)


def test_cxx_may_carry_arguments(source, monkeypatch):
    monkeypatch.setenv("CXX", f"{find_compiler()[0]} -DEXTRA")
    assert find_compiler()[1:] == ["-DEXTRA"]
    assert load(source).answer() == 42


def test_a_cache_that_cannot_be_written_is_named(source, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(D2Error, match="set D2_CACHE to a writable folder"):
        load(source)


def test_the_cache_is_where_the_user_says_then_where_the_system_says(monkeypatch, tmp_path):
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("D2_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "d2-4dgs"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "d2-4dgs"


def test_processes_that_start_together_all_get_the_library(source, cache):
    # compiler.py alone needs no torch; loading it as a module of a bare package keeps eight starts quick.
    code = (
        "import sys, types\n"
        "from pathlib import Path\n"
        f"package = types.ModuleType('d2_plugin'); package.__path__ = [{str(Path(compiler.__file__).parent)!r}]\n"
        "sys.modules['d2_plugin'] = package\n"
        "from d2_plugin.compiler import load_library\n"
        f"source = Path({str(source)!r})\n"
        "assert load_library('answer', [source], [source.with_name('number.h')]).answer() == 42\n"
    )
    started = [subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE) for _ in range(8)]
    for process in started:
        assert process.wait(60) == 0, process.stderr.read().decode()
        process.stderr.close()
    assert len(list(cache.glob("*.so"))) == 1


def test_importing_the_package_compiles_nothing(cache):
    code = "import d2_plugin.rasterizer, d2_plugin.compiler"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ)
    assert not cache.exists()
