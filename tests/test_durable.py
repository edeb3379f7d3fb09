"""Files that are kept: whole or not there, known again, and with one writer at a time."""

import errno
import io
import json
import os
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from d2_plugin import durable
from d2_plugin.durable import (
    CannotWrite,
    Damaged,
    Kind,
    OtherFormat,
    append,
    opened_archive,
    read_table,
    remove_leftovers,
    write,
    write_archive,
    write_table,
)
from d2_plugin.errors import D2Error
from d2_plugin.locks import Busy, in_turn, one_of_many, only_writer

KIND = Kind("table", 3, "make it anew")

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=25)  # each writes twice
@given(st.dictionaries(st.text().filter(lambda name: name not in ("format", "seal")), JSON, max_size=5))
def test_what_is_read_is_what_was_written(tmp_path_factory: pytest.TempPathFactory, values: dict[str, Any]) -> None:
    path = tmp_path_factory.mktemp("table") / "table.json"
    write_table(path, values, KIND)
    assert read_table(path, KIND) == values
    path.write_text(json.dumps(json.loads(path.read_text())))  # spaces and the order of names are nobody's content
    assert read_table(path, KIND) == values


@pytest.mark.parametrize(
    "content",
    [b"", b"[1]", b"\xff\xfe\x00", b"[" * 200_000, b'{"format": 3}'],
    ids=["empty", "a list", "no text", "too deep", "no seal"],
)
def test_what_is_no_table_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "table.json").write_bytes(content)
    with pytest.raises(D2Error, match=r"the table .*table.json (is damaged )?\(.*\): make it anew") as told:
        read_table(tmp_path / "table.json", KIND)
    assert len(str(told.value)) < 400


def test_a_folder_or_a_pipe_in_the_place_of_a_file_is_one_sentence(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        refuses("expected a file: make it anew|pipe.*: make it anew", read_table, path, KIND)


def test_another_version_is_named_before_anything_else(tmp_path: Path) -> None:
    write_table(tmp_path / "t.json", {"a": 1}, KIND._replace(format=7))
    with pytest.raises(OtherFormat, match="has format 7 but this version reads format 3: make it anew"):
        read_table(tmp_path / "t.json", KIND)


@pytest.mark.parametrize("name", ["write", "fsync", "replace"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EACCES])
def test_a_write_that_fails_changes_nothing_and_leaves_nothing(tmp_path, monkeypatch, name: str, number: int) -> None:
    write(tmp_path / "kept", b"before")

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(durable.os, name, fail)
    with pytest.raises(CannotWrite, match=rf"cannot write .*kept \({os.strerror(number)}\): .*the same command again"):
        write(tmp_path / "kept", b"after")
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert (tmp_path / "kept").read_bytes() == b"before"


def test_a_file_where_a_folder_belongs_and_a_folder_where_a_file_belongs(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "below", tmp_path, tmp_path / ("x" * 300)):
        refuses("cannot write|is a file, expected a folder", write, path, b"content", error=CannotWrite)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_link_in_the_place_of_a_file_is_replaced_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "file").symlink_to(tmp_path / "precious")
    write(tmp_path / "file", b"new")
    assert (tmp_path / "precious").read_text() == "mine"
    assert not (tmp_path / "file").is_symlink()


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "below").mkdir()
    for name in (".0123.part", "below/.4567.part", "below/part", ".hidden", "a.part"):
        (tmp_path / name).write_text("")
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.rglob("*")} == {"below", "part", ".hidden", "a.part"}


def test_lines_are_added_whole_and_a_line_that_was_cut_off_stays_alone(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    append(path, "1\n2\n")
    path.write_text("1\n2\n3")
    append(path, "4\n")
    assert path.read_text() == "1\n2\n3\n4\n"
    with pytest.raises(CannotWrite):
        append(tmp_path, "5\n")


def archive(path: Path, state: Any) -> Path:
    """What `torch.save` makes of a state, with its checksum."""
    content = io.BytesIO()
    torch.save(state, content)
    write_archive(path, content)
    return path


def test_an_archive_opens_for_torch_and_zip_as_it_is(tmp_path: Path) -> None:
    path = archive(tmp_path / "whole.pt", {"a": torch.arange(40.0)})
    with opened_archive(path, "archive", "make it anew") as file:
        assert torch.equal(torch.load(file, weights_only=True)["a"], torch.arange(40.0))
    assert torch.equal(torch.load(path, weights_only=True)["a"], torch.arange(40.0))
    with zipfile.ZipFile(path) as opened:
        assert opened.testzip() is None


def test_a_flipped_bit_of_an_archive_is_seen_before_anybody_reads_it(tmp_path: Path) -> None:
    path = archive(tmp_path / "whole.pt", {"a": torch.arange(9.0), "b": "text"})
    whole = path.read_bytes()
    directory = whole.index(b"PK\x01\x02")  # zip's own checksums are not of what stands from here on
    for place in [*range(0, 8 * directory, 1997), *range(8 * directory, 8 * len(whole), 19)]:
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(Damaged, match="differs from its checksum"), opened_archive(path, "archive", "make it anew"):
            pass
    torch.save({}, path)  # and so is one that another program wrote
    with pytest.raises(Damaged), opened_archive(path, "archive", "make it anew"):
        pass


def test_many_may_write_beside_each_other_and_the_first_tidies(tmp_path: Path) -> None:
    tidied = []
    first, second = (one_of_many(tmp_path, lambda number=number: tidied.append(number)) for number in (1, 2))
    with first, second, pytest.raises(Busy):
        only_writer(tmp_path).__enter__()
    assert tidied == [1]
    with only_writer(tmp_path):
        assert list(tmp_path.iterdir()) == [], "a lock is no file"


def test_turns_are_taken_one_after_the_other(tmp_path: Path) -> None:
    inside = []

    def turn(number: int) -> int:
        with in_turn(tmp_path):
            inside.append(number)
            time.sleep(0.01)
            most = len(inside)
            inside.pop()
            return most

    with ThreadPoolExecutor(6) as threads:
        assert list(threads.map(turn, range(6))) == [1] * 6


def test_a_folder_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(D2Error, match="cannot open the folder"), only_writer(tmp_path / "absent"):
        pass
