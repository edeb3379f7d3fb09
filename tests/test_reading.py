"""Files that somebody else wrote: a valid content comes out, or one sentence."""

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d2_plugin import arrays
from d2_plugin.arrays import read_array
from d2_plugin.errors import D2Error, unknown_name
from d2_plugin.reading import (
    NoSuchFile,
    field,
    json_text,
    parse_json,
    parsing,
    reaching,
    read_bytes,
    read_json,
    read_text,
    read_toml,
    shown_path,
)
from d2_plugin.settings import Positive


def refusal(call: Any, *given: Any, **more: Any) -> str:
    """The one line in which a call is refused."""
    with pytest.raises(D2Error) as caught:
        call(*given, **more)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert text.endswith(": restore the file"), text
    return text


class TestOpening:
    def test_what_is_not_there_is_also_a_file_not_found(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match="there is no such file.: write it first") as caught:
            read_text(tmp_path / "gone", "write it first")
        assert isinstance(caught.value, NoSuchFile)
        assert isinstance(caught.value, D2Error)

    def test_a_folder_a_pipe_and_a_device_are_no_files(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        assert "is a folder, expected a file" in refusal(read_bytes, tmp_path)
        assert "is a pipe, expected a file" in refusal(read_bytes, tmp_path / "pipe")
        assert "is a device, expected a file" in refusal(read_bytes, "/dev/zero")

    @pytest.mark.parametrize(
        "name", ["a\0b", "\ud800", "x" * 5000, "file/below"], ids=["zero", "half", "long", "below"]
    )
    def test_impossible_names(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "file").write_text("")
        text = refusal(read_bytes, str(tmp_path / name))
        text.encode()

    def test_a_file_that_is_too_large_is_not_read(self, tmp_path: Path) -> None:
        with (tmp_path / "large").open("wb") as file:
            file.truncate(1 << 40)
        assert "has more than 1000 bytes" in refusal(read_bytes, tmp_path / "large", most=1000)
        assert "has more than" in refusal(read_json, tmp_path / "large")

    def test_a_name_is_shown_on_one_line(self) -> None:
        assert shown_path("a\nb\x1b[31m") == "a\\nb\\x1b[31m"

    def test_what_the_system_says_names_the_file(self, tmp_path: Path) -> None:
        def listing() -> None:
            with reaching(tmp_path, "restore the file"):
                list((tmp_path / "gone").iterdir())

        assert f"cannot read {tmp_path / 'gone'} (No such file or directory)" in refusal(listing)


class TestText:
    def test_a_byte_order_mark_is_no_letter(self, tmp_path: Path) -> None:
        (tmp_path / "marked").write_bytes(b'\xef\xbb\xbf{"a": 1}')
        assert read_json(tmp_path / "marked") == {"a": 1}

    def test_other_encodings_are_refused(self, tmp_path: Path) -> None:
        (tmp_path / "latin").write_bytes("é".encode("latin-1"))
        assert "is no UTF-8 text" in refusal(read_text, tmp_path / "latin")

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("", "as JSON (Expecting value"),
            ('{"a": NaN}', "NaN, which is not finite and no number of JSON"),
            ('{"a": [-Infinity]}', "-Infinity, which is not finite"),
            ('{"a": 1e999}', "1e999 is beyond every number"),
            ('{"a": ' + "9" * 400 + "}", "400 digits"),
            ('{"a": 1, "a": 2}', "the name 'a' stands twice"),
            ("[" * 100_000, "recursion"),
            (r'{"a": "\ud800"}', "surrogates not allowed"),
            ("[1, 2]", "holds a list, expected a JSON object"),
        ],
    )
    def test_json_is_strict(self, tmp_path: Path, text: str, says: str) -> None:
        (tmp_path / "file.json").write_text(text)
        assert says in refusal(read_json, tmp_path / "file.json")

    def test_json_of_a_line_names_the_line(self) -> None:
        assert parse_json(r'{"smile": "\ud83d\ude00"}', "line 1") == {"smile": "😀"}
        assert refusal(parse_json, "{", "line 3 of rows.jsonl").startswith("cannot read line 3 of rows.jsonl as JSON (")

    def test_json_that_is_written_is_strict_too(self) -> None:
        assert json_text({"a": [1.5, None]}, "x.json") == '{"a": [1.5, null]}'
        with pytest.raises(D2Error, match=r"x.json would hold a number at test.psnr.1 that is not finite"):
            json_text({"test": {"psnr": [1.0, float("inf")]}}, "x.json")

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("a = ", "as TOML (Invalid value"),
            ("a = 2026-13-45", "TOML"),
            ("a = " + "[" * 5000, "recursion"),
            ("a = " + "9" * 5000, "as TOML (Exceeds the limit"),
        ],
        ids=["broken", "day", "deep", "digits"],
    )
    def test_toml(self, tmp_path: Path, text: str, says: str) -> None:
        (tmp_path / "file.toml").write_text(text)
        assert says in refusal(read_toml, tmp_path / "file.toml")

    def test_a_field_has_its_kind_and_range(self) -> None:
        assert field({"fx": 3}, "fx", Positive, "camera 00") == 3.0
        assert field({}, "fx", Positive, "camera 00", default=None) is None
        assert refusal(field, {}, "fx", Positive, "camera 00") == "camera 00 has no fx: restore the file"
        assert "fx of camera 00 must be above 0, got -1" in refusal(field, {"fx": -1}, "fx", Positive, "camera 00")
        assert "fx of camera 00 must be a number, got 'a'" in refusal(field, {"fx": "a"}, "fx", float, "camera 00")


class TestParsersOfOthers:
    @pytest.mark.parametrize("failure", [KeyError("x"), RuntimeError("two\nlines"), MemoryError(), RecursionError()])
    def test_whatever_they_raise_is_a_sentence(self, failure: Exception) -> None:
        def parse() -> None:
            with parsing("the file"):
                raise failure

        assert "the file" in refusal(parse)

    def test_a_sentence_passes(self) -> None:
        with pytest.raises(D2Error, match="^already said$"), parsing("the file"):
            raise D2Error("already said")


def npy(header: str, data: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + version + len(text).to_bytes(2, "little") + text + data


class TestArrays:
    @pytest.mark.parametrize("dtype", ["<f4", ">f8", "|b1"])
    @pytest.mark.parametrize("order", ["C", "F"])
    def test_arrays_come_back_bitwise(self, tmp_path: Path, dtype: str, order: str) -> None:
        array = np.asarray(np.arange(6).reshape(2, 3), dtype, order)
        np.save(tmp_path / "a.npy", array)
        np.savez_compressed(tmp_path / "a.npz", depth=array)
        for found in (read_array(tmp_path / "a.npy"), read_array(tmp_path / "a.npz", key="depth")):
            assert found.dtype == array.dtype
            assert np.array_equal(found, array)

    def test_an_empty_array_has_its_shape(self, tmp_path: Path) -> None:
        np.save(tmp_path / "a.npy", np.zeros((0, 3)))
        assert read_array(tmp_path / "a.npy").shape == (0, 3)

    @pytest.mark.parametrize(
        ("content", "says"),
        [
            (b"", "is no array of numpy"),
            (b"PK\x03\x04" + bytes(60), "is no array of numpy"),
            (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }"), "but 0 follow"),
            (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", bytes(4)), "8 bytes, but 4 follow"),
            (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }", bytes(8)), "4 bytes, but 8 follow"),
            (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }", bytes(8)), "lengths of 0 or more"),
            (npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", bytes(4)), "plain numbers"),
            (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", bytes(4)), "expected plain numbers"),
            (npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1,), ", bytes(4)), "cannot read"),
            (npy("(" * 5000), "cannot read"),
            (npy("{}", version=b"\x07\x00"), "version 1 or 2"),
        ],
    )
    def test_what_is_not_what_it_says(self, tmp_path: Path, content: bytes, says: str) -> None:
        (tmp_path / "a.npy").write_bytes(content)
        assert says in refusal(read_array, tmp_path / "a.npy")

    def test_too_many_bytes(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(arrays, "MOST_BYTES", 40)
        np.save(tmp_path / "a.npy", np.zeros((2, 3)))
        assert "48 bytes of numbers, more than 40" in refusal(read_array, tmp_path / "a.npy")

    def test_archives_that_are_not_what_they_say(self, tmp_path: Path) -> None:
        path = tmp_path / "a.npz"
        np.savez(path, other=np.zeros(3))
        assert "has no array 'depth', it has other" in refusal(read_array, path, key="depth")
        np.savez(path, depth=np.arange(1000))
        whole = path.read_bytes()
        path.write_bytes(whole[:3000] + bytes([whole[3000] ^ 1]) + whole[3001:])
        assert "Bad CRC-32" in refusal(read_array, path, key="depth")
        path.write_bytes(whole[:-10])
        assert "cannot read" in refusal(read_array, path, key="depth")
        np.save(tmp_path / "b.npy", np.zeros(3))
        assert "not a zip file" in refusal(read_array, tmp_path / "b.npy", key="depth")

    def test_a_zip_bomb_takes_no_memory(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(arrays, "MOST_BYTES", 1000)
        header = npy("{'descr': '|u1', 'fortran_order': False, 'shape': (1000000,), }")
        with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("depth.npy", header + bytes(10**6))
        assert "more than 1000" in refusal(read_array, tmp_path / "a.npz", key="depth")


def test_an_unknown_name_is_repeated_up_to_a_hundred_letters_on_one_line() -> None:
    text = str(unknown_name("setting", "a\nb" + "1" * 5000, ["ab"]))
    assert len(text) < 200
    assert "\n" not in text


def test_a_number_without_its_zeros_is_told_the_name_with_them() -> None:
    names = [f"{number:02}" for number in range(40)]
    assert str(unknown_name("camera", "0", names)).endswith("did you mean '00'?")
    assert str(unknown_name("camera", "3", names)).endswith("did you mean '03'?")
