"""One writer at a time, by the operating system's advisory locks on folders.

A lock belongs to the process: the system gives it back however the process ends, so there is no stale lock and no lock
file. Readers take none and need no right to write. Where a file system has no locks (some network mounts), a warning
says so once and the work goes on.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from d2_plugin.errors import D2Error

logger = logging.getLogger(__name__)

NO_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)
"""What a file system answers that cannot lock a folder."""


class Busy(D2Error):
    """Another process writes there."""


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only one that writes into an existing folder.

    Raises:
        Busy: somebody else is.
    """
    with _opened(folder) as descriptor:
        if _lock(descriptor, folder, exclusive=True, wait=False) is False:
            raise Busy(f"another process is writing {folder}: wait until it has ended, or give another --output")
        yield


@contextlib.contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """Wait until no other process is within `in_turn` of this folder; for changes that take no time."""
    with _opened(folder) as descriptor:
        _lock(descriptor, folder, exclusive=True, wait=True)
        yield


@contextlib.contextmanager
def one_of_many(folder: Path, tidy: Callable[[], None]) -> Iterator[None]:
    """Write into a folder beside other processes that do; the only one there calls `tidy` first."""
    with _opened(folder) as descriptor:
        if _lock(descriptor, folder, exclusive=True, wait=False):
            tidy()
        _lock(descriptor, folder, exclusive=False, wait=True)
        yield


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int | None]:
    """A descriptor of the folder; None on Windows, which has no such locks."""
    if os.name == "nt":
        yield None
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise D2Error(f"cannot open the folder {folder} ({error.strerror}): give a folder that you may read") from None
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _lock(descriptor: int | None, folder: Path, *, exclusive: bool, wait: bool) -> bool | None:
    """Whether the lock is held; None where there are no locks."""
    if descriptor is None:
        return None
    import fcntl

    operation = (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | (0 if wait else fcntl.LOCK_NB)
    try:
        fcntl.flock(descriptor, operation)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise D2Error(f"cannot lock {folder} ({error.strerror}): give a folder on another disk") from None
        logger.warning("%s is on a file system without locks: let one process at a time write there", folder)
        return None
    return True
