"""Kernels: compiled at first use, once, from a cache with nobody else's hands in it, or taken from a wheel."""

import ctypes
import hashlib
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refuses

from d2_plugin import cache, compiler
from d2_plugin.cache import Untrusted, cache_lock, check_private, private_cache
from d2_plugin.compiler import CompileError, NoCompiler, cache_folder, find_compiler, load_library, prebuilt

pytestmark = pytest.mark.usefixtures("compiler")

posix = pytest.mark.skipif(os.name == "nt", reason="owners and modes are those of POSIX")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    file = tmp_path / "answer.cpp"
    file.write_text('#include "number.h"\nextern "C" int answer() { return NUMBER; }\n')
    (tmp_path / "number.h").write_text("#define NUMBER 42\n")
    return file


def load(source: Path, **options: object) -> ctypes.CDLL:
    return load_library("answer", [source], [source.with_name("number.h")], **options)


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    names, build = [], compiler._compile

    def counted(library: Path, *rest: object) -> ctypes.CDLL:
        names.append(library.name)
        return build(library, *rest)

    monkeypatch.setattr(compiler, "_compile", counted)
    return names


def forget() -> None:
    """As a new process would: nothing is loaded yet."""
    compiler._loaded.clear()


def script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


class TestBuilding:
    def test_a_source_is_compiled_once_and_then_taken_from_the_cache(self, source, builds, folder) -> None:
        for _ in range(2):
            assert load(source).answer() == 42
            forget()
        assert len(builds) == 1
        left = [path.suffix for path in sorted(folder.iterdir())]
        assert left == [".lock", ".sha256", ".so"], "nothing temporary is left"

    def test_a_changed_header_or_flag_compiles_anew_and_the_users_come_last(self, source, builds, monkeypatch) -> None:
        load(source)
        source.with_name("number.h").write_text("#define NUMBER 43\n")
        assert load(source).answer() == 43
        load(source, flags=["-DUNUSED"])
        source.with_name("number.h").write_text("#ifndef NUMBER\n#define NUMBER 1\n#endif\n")
        monkeypatch.setenv("D2_CXXFLAGS", "-DNUMBER=7")
        assert load(source).answer() == 7
        assert len(set(builds)) == 4

    @pytest.mark.parametrize("damage", ["truncated", "no checksum"])
    def test_a_broken_cache_entry_is_rebuilt(self, source, builds, folder, damage) -> None:
        load(source)
        forget()
        (library,) = folder.glob("*.so")
        whole = library.read_bytes()
        # A new file, as a crash would leave it: the old one is still mapped by this process.
        library.unlink()
        library.write_bytes(whole[:5000] if damage == "truncated" else whole)
        if damage == "no checksum":
            library.with_suffix(".sha256").unlink()
        assert load(source).answer() == 42
        assert len(builds) == 2

    def test_the_compilers_own_words_are_in_the_error(self, source) -> None:
        with pytest.raises(CompileError, match="no-such-flag"):
            load(source, flags=["-fno-such-flag-at-all"])
        source.write_text('extern "C" int answer() { return no_such_name; }\n')
        with pytest.raises(CompileError, match=r"compiling answer\.cpp failed(.|\n)*no_such_name"):
            load(source)

    def test_no_compiler_is_an_error_of_its_own_as_is_one_from_before_2017(self, source, monkeypatch, tmp_path) -> None:
        monkeypatch.setenv("CXX", "no-such-compiler")
        refuses("CXX names 'no-such-compiler'", load, source, error=NoCompiler)
        old = script(tmp_path / "old", "echo \"unrecognized command line option '-std=c++17'\" >&2\nexit 1")
        monkeypatch.setenv("CXX", old)
        refuses(r"does not compile C\+\+17", load, source, error=NoCompiler)
        monkeypatch.setenv("CXX", script(tmp_path / "silent", "exit 0"))
        refuses("without an error and without a library", load, source, error=CompileError)
        monkeypatch.delenv("CXX")
        monkeypatch.setenv("PATH", "")
        refuses(r"install g\+\+ or clang\+\+", load, source, error=NoCompiler)

    def test_cxx_may_carry_arguments(self, source, monkeypatch) -> None:
        monkeypatch.setenv("CXX", f"{find_compiler()[0]} -DEXTRA")
        assert find_compiler()[1:] == ["-DEXTRA"]
        assert load(source).answer() == 42

    @pytest.mark.parametrize("variable", ["CXX", "D2_CXXFLAGS"])
    def test_an_open_quote_is_one_sentence(self, source, monkeypatch, variable: str) -> None:
        monkeypatch.setenv(variable, 'g++ "-O2')
        refuses(f"{variable} is .*, which no shell reads .*: correct or unset it", load, source)

    def test_processes_that_start_together_all_get_the_library(self, source, folder) -> None:
        # compiler.py alone needs no torch; loading it as a module of a bare package keeps the starts quick.
        code = (
            "import sys, types\n"
            "from pathlib import Path\n"
            f"package = types.ModuleType('d2_plugin'); package.__path__ = [{str(Path(cache.__file__).parent)!r}]\n"
            "sys.modules['d2_plugin'] = package\n"
            "from d2_plugin.compiler import load_library\n"
            f"source = Path({str(source)!r})\n"
            "assert load_library('answer', [source], [source.with_name('number.h')]).answer() == 42\n"
        )
        started = [subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE) for _ in range(3)]
        for process in started:
            assert process.wait(600) == 0, process.stderr.read().decode()
            process.stderr.close()
        assert len(list(folder.glob("*.so"))) == 1


@posix
class TestCache:
    def test_it_is_where_the_user_says_then_where_the_system_says(self, folder, monkeypatch, tmp_path, source) -> None:
        assert cache_folder() == folder
        (tmp_path / "file").write_text("not a folder")
        monkeypatch.setenv("D2_CACHE", str(tmp_path / "file" / "cache"))
        refuses("set D2_CACHE to a writable folder", load, source)
        monkeypatch.delenv("D2_CACHE")
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert cache_folder() == tmp_path / "d2-4dgs"
        monkeypatch.delenv("XDG_CACHE_HOME")
        assert cache_folder() == Path.home() / ".cache" / "d2-4dgs"

    def test_it_is_made_for_the_user_alone(self, folder: Path) -> None:
        assert private_cache() == folder
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700

    @pytest.mark.parametrize("mode", [0o777, 0o1777, 0o703, 0o772])
    def test_one_that_others_may_write_is_refused(self, folder: Path, mode: int) -> None:
        folder.mkdir()
        folder.chmod(mode)
        with pytest.raises(Untrusted, match=r"others may write .*: delete .* or set D2_CACHE to a folder of your own"):
            private_cache()

    def test_one_below_a_folder_that_others_may_write_needs_one_where_only_owners_rename(self, folder: Path) -> None:
        folder.mkdir(mode=0o700)
        folder.parent.chmod(0o777)
        refuses(f"others may write {folder.parent}", check_private, folder, error=Untrusted)
        folder.parent.chmod(0o1777)
        check_private(folder)

    def test_one_of_another_user_is_refused(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir(mode=0o700)
        monkeypatch.setattr(cache.os, "geteuid", lambda: 4711)
        if os.getuid() == 0:
            os.chown(folder, 1234, 1234)
        refuses("belongs to another user", check_private, folder, error=Untrusted)

    def test_a_group_that_is_the_user_alone_is_nobody_else(self, folder, monkeypatch) -> None:
        folder.mkdir()
        folder.chmod(0o770)
        monkeypatch.setattr(cache, "_own_group", lambda found: True)
        check_private(folder)
        monkeypatch.setattr(cache, "_own_group", lambda found: False)
        with pytest.raises(Untrusted):
            check_private(folder)

    def test_a_library_and_its_checksum_that_others_planted_are_not_loaded(self, source: Path, folder: Path) -> None:
        """Both were replaced together, in the time in which the folder was open to all."""
        load(source)
        (library,) = folder.glob("*.so")
        forget()
        folder.chmod(0o777)
        refuses("could replace compiled code", load, source, error=Untrusted)
        folder.chmod(0o700)
        library.unlink()  # written over, it would end this process, which has it loaded
        library.write_bytes(b"evil")
        library.with_suffix(".sha256").write_text(compiler._checksum(library))
        library.chmod(0o722)
        assert load(source).answer() == 42
        assert not stat.S_IMODE(library.stat().st_mode) & 0o022

    def test_a_planted_lock_leaves_what_it_points_to_alone_and_blocks_nobody(self, source, folder, tmp_path) -> None:
        (tmp_path / "precious").write_text("do not truncate me")
        load(source)
        (lock,) = folder.glob("*.lock")
        for path in [*folder.glob("*.so"), *folder.glob("*.sha256"), lock]:
            path.unlink()
        forget()
        lock.symlink_to(tmp_path / "precious")
        refuses("is no plain file", load, source, error=Untrusted)
        assert (tmp_path / "precious").read_text() == "do not truncate me"
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(Untrusted, match="is no plain file"), cache_lock(tmp_path / "pipe"):
            pass


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One for each level; each says which it is."""
    found = {}
    for number, level in enumerate(prebuilt.LEVELS):
        path = tmp_path_factory.mktemp("levels") / level
        text = f'extern "C" int answer() {{ return {number}; }}\n'
        subprocess.run(["c++", "-shared", "-fPIC", "-x", "c++", "-", "-o", path], input=text, text=True, check=True)
        found[level] = path.read_bytes()
    return found


class TestPrebuilt:
    """Kernels that came compiled with a wheel: the right ones for this CPU, whole ones only, no compiler needed."""

    @pytest.fixture(autouse=True)
    def wheel(self, tmp_path: Path, source: Path, libraries: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> Path:
        """A package with a library for each level."""
        source.write_text('extern "C" int answer() { return 42; }\n')
        wheel = tmp_path / "compiled"
        wheel.mkdir()
        monkeypatch.setattr(prebuilt, "FOLDER", wheel)
        monkeypatch.setenv("PATH", "")
        monkeypatch.delenv("CXX", raising=False)
        checksums = {}
        for level, library in libraries.items():
            path = wheel / prebuilt.file_name("answer", level, [source], [], [])
            path.write_bytes(library)
            checksums[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        (wheel / prebuilt.CHECKSUMS).write_text(json.dumps(checksums))
        prebuilt._checksums.cache_clear()
        forget()
        return wheel

    def answer(self, source: Path, monkeypatch: pytest.MonkeyPatch, level: str, **options: object) -> int:
        """On a CPU with that level and no more."""
        monkeypatch.setattr(prebuilt, "_cpu_flags", lambda: prebuilt.LEVELS[level].needs)
        monkeypatch.setattr(prebuilt.platform, "machine", lambda: "x86_64")
        return load_library(options.pop("name", "answer"), [source], **options).answer()

    @pytest.mark.parametrize("level", prebuilt.LEVELS)
    def test_each_cpu_gets_the_best_it_can_run(self, source, monkeypatch, level: str) -> None:
        assert self.answer(source, monkeypatch, level) == list(prebuilt.LEVELS).index(level)

    def test_a_lower_level_may_be_asked_for(self, source, monkeypatch) -> None:
        monkeypatch.setenv("D2_CPU", "avx2")
        assert self.answer(source, monkeypatch, "avx512") == 1
        monkeypatch.setenv("D2_CPU", "sse9")
        refuses(r"sse9.*avx2, avx512, scalar", self.answer, source, monkeypatch, "avx512")

    @pytest.mark.parametrize("change", [{}, {"flags": ["-DX"]}, {"name": "other"}], ids=["source", "flags", "name"])
    def test_a_library_of_another_version_is_never_taken(self, source, monkeypatch, change: dict) -> None:
        if not change:
            source.write_text('extern "C" int answer() { return 43; }\n')
        with pytest.raises(NoCompiler):
            self.answer(source, monkeypatch, "avx2", **change)

    @pytest.mark.parametrize("damage", ["truncated", "gone"])
    def test_in_the_place_of_a_damaged_library_comes_a_lower_level(self, source, wheel, monkeypatch, damage) -> None:
        path = wheel / prebuilt.file_name("answer", "avx512", [source], [], [])
        whole = path.read_bytes()
        path.unlink()
        if damage == "truncated":
            path.write_bytes(whole[:3000])
        assert self.answer(source, monkeypatch, "avx512") == 1

    @pytest.mark.parametrize(("variable", "value"), [("CXX", "c++"), ("D2_CXXFLAGS", "-DX")])
    def test_who_chooses_a_compiler_or_flags_gets_a_compilation(self, source, monkeypatch, variable, value) -> None:
        monkeypatch.setenv("PATH", "/usr/local/bin:/usr/bin:/bin")
        monkeypatch.setenv(variable, value)
        assert self.answer(source, monkeypatch, "avx2") == 42

    def test_another_processor_has_none(self, monkeypatch) -> None:
        monkeypatch.setattr(prebuilt.platform, "machine", lambda: "aarch64")
        assert prebuilt.usable() == []
