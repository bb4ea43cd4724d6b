"""Files opened as what they should be: no link is followed, and nothing else that can be opened waits.

A pipe without a writer would hold a reader for ever, a device may give bytes without end, a link leads elsewhere. TOML
that people write is read whole or refused in one sentence, whatever it holds.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
import tomllib
from pathlib import Path
from typing import Any, BinaryIO

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

    Raises NotPlainError: it is a link, a pipe, or whatever else is no file. FileNotFoundError, OSError.
    """
    found = path.lstat()
    _check(path, found.st_mode)
    return found.st_size


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Give a descriptor of a file, which the caller closes.

    Raises NotPlainError: it is a link, a pipe, or whatever else is no file. FileNotFoundError, OSError.
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


MOST_BYTES = 10_000_000  # settings are a page long


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file; a byte order mark, as some editors write it, is passed over.

    Raises FileNotFoundError: there is no such file. ValueError: it cannot be read as TOML; the message says why.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise ValueError("it is no plain file")
            if found.st_size > MOST_BYTES:
                raise ValueError(f"it has {found.st_size} bytes, settings have a few thousand")
            text = file.read().decode("utf-8-sig")
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(str(error)) from error
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its lists or tables are nested too deeply") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # int() of very many digits
        raise ValueError(f"it has a number of more than {sys.get_int_max_str_digits()} digits") from error
