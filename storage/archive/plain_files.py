"""Files of an archive opened as what they should be: no link is followed, and nothing else that can be opened waits.

A pipe without a writer would hold a reader for ever, a device may give bytes without end, a link leads elsewhere.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

_KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFREG: "a file",
}
_APART = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class NotPlainError(OSError):
    """What should be a file, or a folder, is something else; ``strerror`` says what."""


def kind_of(path: Path) -> str | None:
    """What lies at a path, in words, the path's last name not followed; None where nothing does."""
    try:
        return _kind(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return None


def plain_size(path: Path) -> int:
    """Bytes of a file.

    Raises
    ------
    NotPlainError : it is a link, a pipe, or whatever else is no file. FileNotFoundError, OSError
    """
    found = path.lstat()
    _check(path, found.st_mode)
    return found.st_size


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Give a descriptor of a file, which the caller closes.

    Raises
    ------
    NotPlainError : it is a link, a pipe, or whatever else is no file. FileNotFoundError, OSError
    """
    if not flags & os.O_CREAT:
        _check(path, path.lstat().st_mode)  # before it is opened: some devices act on that
    try:
        descriptor = os.open(path, flags | _APART, 0o644)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            _check(path, path.lstat().st_mode)
        raise
    try:
        _check(path, os.fstat(descriptor).st_mode)
    except NotPlainError:
        os.close(descriptor)
        raise
    return descriptor


def plain_reader(path: Path) -> BinaryIO:
    """Open a file for reading; raises as `open_plain`."""
    return os.fdopen(open_plain(path), "rb")


def read_plain(path: Path) -> bytes:
    """All bytes of a file; raises as `open_plain`."""
    with plain_reader(path) as file:
        return file.read()


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise NotPlainError(errno.EINVAL, f"it is {_kind(mode)}, expected a file", str(path))


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "something unknown")
