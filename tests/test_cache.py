"""The cache of compiled code: nobody else's hands in it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from d2_plugin import cache, compiler
from d2_plugin.cache import Untrusted, cache_lock, check_private, is_trusted, private_cache
from d2_plugin.compiler import CompileError, NoCompiler, find_compiler, load_library
from d2_plugin.errors import D2Error

pytestmark = pytest.mark.skipif(os.name == "nt", reason="owners and modes are those of POSIX")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("D2_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    try:
        find_compiler()
    except NoCompiler as error:
        pytest.skip(str(error))
    file = tmp_path / "answer.cpp"
    file.write_text('extern "C" int answer() { return 42; }\n')
    return file


def test_it_is_made_for_the_user_alone(folder: Path) -> None:
    assert private_cache() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o703, 0o772])
def test_one_that_others_may_write_is_refused(folder: Path, mode: int) -> None:
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(Untrusted, match=r"others may write .*: delete .* or set D2_CACHE to a folder of your own"):
        private_cache()


def test_one_below_a_folder_that_others_may_write_is_refused_unless_only_owners_rename_there(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    folder.parent.chmod(0o777)
    with pytest.raises(Untrusted, match=f"others may write {folder.parent}"):
        check_private(folder)
    folder.parent.chmod(0o1777)
    check_private(folder)


def test_one_of_another_user_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(cache.os, "geteuid", lambda: 4711)
    if os.getuid() == 0:
        os.chown(folder, 1234, 1234)
    with pytest.raises(Untrusted, match="belongs to another user"):
        check_private(folder)


def test_a_group_that_is_the_user_alone_is_nobody_else(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    folder.chmod(0o770)
    monkeypatch.setattr(cache, "_own_group", lambda found: True)
    check_private(folder)
    monkeypatch.setattr(cache, "_own_group", lambda found: False)
    with pytest.raises(Untrusted):
        check_private(folder)


def test_a_library_and_its_checksum_that_others_planted_are_not_loaded(source: Path, folder: Path) -> None:
    """Both were replaced together, in the time in which the folder was open to all."""
    load_library("answer", [source])
    (library,) = folder.glob("*.so")
    compiler._loaded.clear()
    folder.chmod(0o777)
    with pytest.raises(Untrusted, match="could replace compiled code"):
        load_library("answer", [source])
    folder.chmod(0o700)
    library.unlink()  # written over, it would end this process, which has it loaded
    library.write_bytes(b"evil")
    library.with_suffix(".sha256").write_text(compiler._checksum(library))
    library.chmod(0o722)
    assert load_library("answer", [source]).answer() == 42
    assert not stat.S_IMODE(library.stat().st_mode) & 0o022


def test_what_is_a_link_or_open_to_others_is_not_trusted(tmp_path: Path) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    assert not is_trusted(file)
    file.write_text("")
    file.chmod(0o600)
    assert is_trusted(file)
    file.chmod(0o602)
    assert not is_trusted(file)
    file.chmod(0o600)
    link.symlink_to(file)
    assert not is_trusted(link)


def test_a_planted_lock_leaves_what_it_points_to_alone(source: Path, folder: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("do not truncate me")
    library = load_library("answer", [source])
    assert library.answer() == 42
    (lock,) = folder.glob("*.lock")
    for path in [*folder.glob("*.so"), *folder.glob("*.sha256"), lock]:
        path.unlink()
    compiler._loaded.clear()
    lock.symlink_to(precious)
    with pytest.raises(Untrusted, match="is no plain file"):
        load_library("answer", [source])
    assert precious.read_text() == "do not truncate me"


def test_a_pipe_in_the_place_of_a_lock_blocks_nobody(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "lock")
    with pytest.raises(Untrusted, match="is no plain file"), cache_lock(tmp_path / "lock"):
        pass


def test_a_compiler_that_writes_nothing_is_told(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    silent = tmp_path / "silent++"
    silent.write_text("#!/bin/sh\nexit 0\n")
    silent.chmod(0o700)
    monkeypatch.setenv("CXX", str(silent))
    with pytest.raises(CompileError, match="without an error and without a library"):
        load_library("answer", [source])


@pytest.mark.parametrize("variable", ["CXX", "D2_CXXFLAGS"])
def test_an_open_quote_is_one_sentence(source: Path, monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, 'g++ "-O2')
    with pytest.raises(D2Error, match=f"{variable} is .*, which no shell reads .*: correct or unset it"):
        load_library("answer", [source])
