"""Files that are kept: written whole or not at all, and known again when they are read back.

    write(path, ...)         under a temporary name, synchronised, renamed: a kill or a full disk leaves the old file
    write_table, read_table  a JSON object that names its format and carries a checksum of everything else in it
    write_archive, opened_archive  the same for files that are zip archives (.npz, .pt), in the comment of the archive

Whatever the operating system refuses becomes one sentence that names the file, the reason and what to do.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from d2_plugin.errors import D2Error
from d2_plugin.reading import MOST_TEXT, json_text, opened, parsing, read_bytes
from d2_plugin.values import shown

LEFTOVER = ".part"
"""How the temporary names end; what a killed process left behind is found by it."""

ARCHIVE_SEAL = b"d2-4dgs sha256 "
"""What stands before the checksum in the comment of an archive."""

FULL = (errno.ENOSPC, errno.EDQUOT)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)
NO_PLACE = (errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP)


class CannotWrite(D2Error):
    """The operating system refused to write; nothing that was there before was changed."""


class Damaged(D2Error):
    """A file that was kept is not what was written."""


class OtherFormat(D2Error):
    """A file that was kept by another version of this package."""


class Kind(NamedTuple):
    """A kind of table that is kept: what it is called, the version of its format, what to do about a damaged one."""

    name: str
    format: int
    remedy: str


def cannot_write(path: Path, error: OSError) -> CannotWrite:
    """The sentence for a write that failed."""
    advice = "check the disk"
    if error.errno in FULL:
        advice = "make room"
    elif error.errno in FORBIDDEN:
        advice = "make it writable or choose a folder that you may write"
    reason = error.strerror or str(error)
    if error.errno in NO_PLACE:
        return CannotWrite(f"cannot write {path} ({reason}): choose another place")
    return CannotWrite(f"cannot write {path} ({reason}): {advice} and give the same command again, which goes on")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Within it, an `OSError` is the sentence that `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from None


def make_folder(path: Path) -> Path:
    """The folder at `path`, made with those above it where they are missing."""
    if path.is_file():
        raise CannotWrite(f"{path} is a file, expected a folder: choose another place")
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    return path


def refuse_unwritable(folder: Path) -> None:
    """Refuse an existing folder in which no file can be made, before the work whose results it would get."""
    with writing(folder):
        descriptor, probe = tempfile.mkstemp(LEFTOVER, ".", folder)
        os.close(descriptor)
        os.unlink(probe)


def write(path: Path, *parts: bytes | memoryview, synced: bool = True) -> None:
    """Make `path` hold the parts one after the other; its folder is made where it is missing.

    `synced` waits for the disk, so that a power cut leaves the old file or the new one as well; what is not read back,
    or whoever finds it damaged makes again, need not wait.

    Raises:
        CannotWrite: the disk is full, broken or not ours; what was there before is there still.
    """
    make_folder(path.parent)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    with replacing(path) as temporary:
        descriptor = os.open(temporary, flags, 0o666)
        try:
            for part in parts:
                rest = memoryview(part).cast("B") if memoryview(part).nbytes else memoryview(b"")
                while rest:
                    rest = rest[os.write(descriptor, rest) :]
            if synced:
                os.fsync(descriptor)  # before the rename, or a power cut may leave the new name with nothing in it
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`: what is written there takes its place if the block ends without an error."""
    temporary = path.with_name(f".{secrets.token_hex(8)}{LEFTOVER}")
    with writing(path):
        try:
            yield temporary
            os.replace(temporary, path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str, synced: bool = True) -> None:
    """`write` for text, in UTF-8."""
    write(path, text.encode(), synced=synced)


def append(path: Path, text: str) -> None:
    """Add whole lines at the end of a file, which is made where it is missing: all of them, or none if that fails."""
    make_folder(path.parent)
    with writing(path), path.open("ab+", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        cut_off = size > 0 and file.read(1) != b"\n"  # somebody was killed in the middle of a line
        rest = memoryview((("\n" if cut_off else "") + text).encode())
        try:
            while rest:
                rest = rest[file.write(rest) :]
        except BaseException:
            file.truncate(size)
            raise


def refuse_inside_images(path: Path) -> None:
    """Refuse a place inside the images of a recording: a folder more would be a camera without a calibration."""
    real = Path(os.path.realpath(path))
    for folder in (real, *real.parents):
        if folder.name == "images" and (folder.parent / "cameras.json").is_file():
            raise D2Error(f"{path} is in {folder}, where every folder is a camera: choose another place")


def refuse_foreign(path: Path, sign: str, command: str) -> None:
    """Refuse to replace a file without the sign, among its first 1000 bytes, of the command that writes it."""
    if path.exists():
        with opened(path, "choose another place") as file:
            if sign.encode() not in file.read(1000):
                raise D2Error(f"{path} was not written by `{command}` and is kept: choose another place")


def remove_leftovers(folder: Path, below: bool = True) -> None:
    """Delete what killed writers left in a folder, and below it; only while no other process writes there."""
    pattern = f".*{LEFTOVER}"
    for path in folder.rglob(pattern) if below else folder.glob(pattern):
        with contextlib.suppress(OSError):
            path.unlink()


def is_leftover(path: Path) -> bool:
    """Whether a killed writer left this file behind."""
    return path.name.startswith(".") and path.name.endswith(LEFTOVER)


def write_table(path: Path, values: Mapping[str, Any], kind: Kind, synced: bool = True) -> None:
    """Write a JSON object with the version of its format and its checksum.

    NaN and infinity are refused by the name that leads to them, since JSON has neither.
    """
    sealed = {**values, "format": kind.format}
    sealed["seal"] = _seal(sealed)
    write_text(path, json_text(sealed, str(path), indent=1, sort_keys=True), synced)


def read_table(path: Path, kind: Kind) -> dict[str, Any]:
    """What `write_table` wrote, without version and checksum.

    Raises:
        NoSuchFile: there is none.
        OtherFormat: another version wrote it.
        Unreadable: it cannot be read, or is no table.
        Damaged: its content is not what was written.
    """
    with parsing(f"the {kind.name} {path}", kind.remedy):
        table = json.loads(read_bytes(path, kind.remedy, MOST_TEXT))
        if not isinstance(table, dict):
            raise ValueError("it is no table")
    if table.get("format") != kind.format:
        raise OtherFormat(
            f"the {kind.name} {path} has format {shown(table.get('format'))} but this version reads format "
            f"{kind.format}: {kind.remedy}"
        )
    if table.pop("seal", None) != _seal(table):
        raise Damaged(f"the {kind.name} {path} is damaged (its content differs from its checksum): {kind.remedy}")
    del table["format"]
    return table


def refuse_no_file(path: Path) -> None:
    """Raise `OSError` where something else than a plain file lies: opening a pipe would wait for ever."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is no plain file")


def _seal(table: Mapping[str, Any]) -> str:
    """SHA-256 of the values, whatever the order and the spaces of the file."""
    plain = json.dumps(table, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(plain.encode()).hexdigest()


def write_archive(path: Path, content: io.BytesIO) -> None:
    """Write a zip archive (of `torch.save` or `np.savez`) with SHA-256 of all its bytes in its comment.

    Every reader of zip skips a comment, so that torch and numpy open the file as it is.
    """
    data = content.getbuffer()
    data[-2:] = (len(ARCHIVE_SEAL) + 32).to_bytes(2, "little")  # length of the comment, last field of a bare archive
    write(path, data, ARCHIVE_SEAL, hashlib.sha256(data).digest())


@contextlib.contextmanager
def opened_archive(path: Path, kind: str, remedy: str) -> Iterator[BinaryIO]:
    """What `write_archive` wrote, open at its begin, once every byte was compared with the checksum.

    zip's own checksums are of the contents alone: a flipped bit in its tables makes torch read memory that nobody
    wrote.

    Raises:
        Damaged: it is not what was written; nothing but its bytes was looked at.
    """
    with opened(path, remedy) as file:
        left = os.fstat(file.fileno()).st_size - len(ARCHIVE_SEAL) - 32
        digest = hashlib.sha256()
        while left > 0 and (block := file.read(min(left, 1 << 20))):
            digest.update(block)
            left -= len(block)
        if file.read() != ARCHIVE_SEAL + digest.digest():
            raise Damaged(f"the {kind} {path} is damaged (its content differs from its checksum): {remedy}")
        file.seek(0)
        yield file
