"""The cache folder of compiled code: ours alone, or not used.

What lies there is loaded into the process, and a checksum beside it says nothing about who wrote both. So the folder,
those above it and each file must belong to the user (or to root) and be closed to everybody else's writing.

Environment:
    D2_CACHE       the cache folder; otherwise ``$XDG_CACHE_HOME/d2-4dgs`` or ``~/.cache/d2-4dgs``
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from d2_plugin.errors import D2Error


class Untrusted(D2Error):
    """Somebody else can write what would be loaded."""


def cache_folder() -> Path:
    """Where compiled libraries are kept (neither made nor looked at here)."""
    chosen, base = os.environ.get("D2_CACHE"), os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        return Path(chosen).expanduser() if chosen else Path(base).expanduser() / "d2-4dgs"
    except RuntimeError:  # a user that this machine does not know
        raise D2Error(f"there is no home folder of {chosen or base}: set D2_CACHE to a folder of your own") from None


def private_cache() -> Path:
    """The cache folder, made for this user alone where it is missing.

    Raises:
        Untrusted: it, or a folder above it, can be written by others.
        OSError: it cannot be made.
    """
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_private(folder)
    return folder


def check_private(folder: Path) -> None:
    """Refuse a folder that others may write, or replace by writing above it; one that is not there is not refused."""
    if os.name == "nt" or not folder.exists():
        return
    if not folder.is_dir():
        raise Untrusted(f"the cache {folder} is no folder: set D2_CACHE to a folder of your own")
    real = folder.resolve()
    for place in (real, *real.parents):
        found = place.stat()
        sticky = place != real and found.st_mode & stat.S_ISVTX  # as /tmp: only the owner renames what lies there
        if not _is_ours(found) or (_others_write(found) and not sticky):
            what = f"{place} belongs to another user" if not _is_ours(found) else f"others may write {place}"
            raise Untrusted(
                f"the cache {folder} is not used, because {what} and could replace compiled code there: delete "
                f"{folder} and `chmod go-w {place}`, or set D2_CACHE to a folder of your own"
            )


def is_trusted(path: Path) -> bool:
    """Whether a file of the cache is a plain file that nobody else wrote or may write; False where it is absent."""
    if os.name == "nt":
        return path.is_file()
    try:
        found = path.lstat()
    except OSError:
        return False
    return stat.S_ISREG(found.st_mode) and _is_ours(found) and not _others_write(found)


@contextlib.contextmanager
def cache_lock(path: Path) -> Iterator[None]:
    """Hold an exclusive lock on a file between processes; the system releases it if the process dies.

    Raises:
        Untrusted: a link or something else than a plain file lies at `path`, which is not touched.
    """
    import fcntl

    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise Untrusted(_PLANTED.format(path)) from None
        raise
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise Untrusted(_PLANTED.format(path))
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


_PLANTED = "{} is no plain file, as a lock has to be, and was not opened: find out who made it, then delete it"


def _is_ours(found: os.stat_result) -> bool:
    return found.st_uid in (os.geteuid(), 0)


def _others_write(found: os.stat_result) -> bool:
    """Whether anybody but the owner may write; a group of which the owner is the only member is nobody else."""
    if found.st_mode & stat.S_IWOTH:
        return True
    return bool(found.st_mode & stat.S_IWGRP) and not _own_group(found)


def _own_group(found: os.stat_result) -> bool:
    """Whether a group is the user's private one, which many systems make with each user (and umask 002 goes by)."""
    import grp
    import pwd

    try:
        group, user = grp.getgrgid(found.st_gid), pwd.getpwuid(os.geteuid())
    except KeyError:
        return False
    return group.gr_name == user.pw_name and group.gr_gid == user.pw_gid and set(group.gr_mem) <= {user.pw_name}
