"""Exchanging two folders in one step, so that there is no moment at which either name leads to nothing.

Linux does that (renameat2 with RENAME_EXCHANGE) on its local file systems; network file systems mostly do not.
"""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.staging import sync_path

_AT_FDCWD = -100  # names are absolute, or of the working folder
_RENAME_EXCHANGE = 2
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP)


def exchange(one: Path, other: Path) -> None:
    """Give two folders of one file system each other's name in one step, and have the disk know it.

    Raises
    ------
    ArchiveError : the file system cannot do that; both are as they were.
    """
    if not try_exchange(one, other):
        raise ArchiveError(
            f"the file system of {one.parent} cannot exchange two folders in one step (renameat2), so a store could "
            "be lost half-way: nothing was changed; pack a copy of the archive on a local disk"
        )


def try_exchange(one: Path, other: Path) -> bool:
    """Exchange two folders' names as `exchange` does; False, with nothing changed, where the file system cannot."""
    error = _renameat2(one, other)
    if error in _UNSUPPORTED:
        return False
    if error:
        raise OSError(error, os.strerror(error), str(one))
    for parent in {one.parent, other.parent}:
        sync_path(parent)
    return True


def _renameat2(one: Path, other: Path) -> int:
    """0, or the error's number."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return errno.ENOSYS
    failed = call(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_RENAME_EXCHANGE))
    return ctypes.get_errno() if failed else 0
