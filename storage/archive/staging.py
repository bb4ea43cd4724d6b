"""Handle the files and folders of an archive: names, errors of the disk, syncing, locks, and settings in TOML.

Only plain files are opened. A pipe without a writer would block a reader, a device may have no end, and a link leads
outside the archive.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import os
import re
import secrets
import shutil
import stat
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.errors import ArchiveError

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
    """A link, a pipe or another special file where a plain file is expected; ``strerror`` names its kind."""


def kind_of(path: Path) -> str | None:
    """Return the kind of what lies at a path, such as "a link", not following it; None where there is nothing."""
    try:
        return _kind(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return None


def plain_size(path: Path) -> int:
    """Return the size of a file in bytes.

    Raises NotPlainError: it is a link, a pipe or another special file. FileNotFoundError, OSError.
    """
    found = path.lstat()
    _check(path, found.st_mode)
    return found.st_size


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Return an open descriptor of a file; the caller closes it.

    Raises NotPlainError: it is a link, a pipe or another special file. FileNotFoundError, OSError.
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
    """Return all bytes of a file; raises as `open_plain`."""
    with plain_reader(path) as file:
        return file.read()


def _check(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise NotPlainError(errno.EINVAL, f"it is {_kind(mode)}, expected a file", str(path))


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "something unknown")


MOST_BYTES = 10_000_000  # settings are a page long


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, with or without a byte order mark.

    Raises FileNotFoundError: there is no such file. ValueError: it cannot be read as TOML.
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


MANIFEST_NAME = "manifest.json"
PART_SUFFIX = ".part"
_BLOCK = 1 << 22
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again",
    errno.EROFS: "the file system is read-only: mount it for writing or choose another --out",
    errno.EACCES: "permission is denied: change the folder's rights or choose another --out",
    errno.EPERM: "permission is denied: change the folder's rights or choose another --out",
    errno.EIO: "the disk reports an error: check the disk, then run again",
    errno.EFBIG: "a file may not grow so large here: raise ulimit -f, or choose an --out on another file system",
    errno.EMFILE: "too many files are open: raise ulimit -n",
    errno.ENOLCK: "the file system has no locks: choose an --out on a local disk",
    errno.ELOOP: "a link stands where a file of its own belongs: see where it leads, remove it and run again",
}
_OF_LOCKS = (".locks", ".in-use")  # folders of an archive that hold nothing else

log = logging.getLogger(__name__)


def is_name(name: str) -> bool:
    """Return whether this can be one folder's or file's name in an archive."""
    return _NAME.fullmatch(name) is not None and not name.endswith(PART_SUFFIX)


def check_name(name: str) -> None:
    """Raise ArchiveError for a name that no folder or file of an archive can have."""
    if not is_name(name):
        raise ArchiveError(f"{name!r} cannot be a name in an archive; use letters, digits, '_', '-' and '.'")


@contextmanager
def refusals(path: Path, doing: str) -> Iterator[None]:
    """Turn a disk error below ``path`` into an ArchiveError with advice; other errors pass."""
    try:
        yield
    except ArchiveError:
        raise
    except NotPlainError as error:
        raise ArchiveError(f"cannot {doing} {path}: {error.filename}: {error.strerror}; take it out") from error
    except OSError as error:
        named = error.filename
        elsewhere = isinstance(named, str) and Path(named).is_absolute() and not Path(named).is_relative_to(path)
        advice = disk_advice(error)
        if advice is None or elsewhere:
            raise
        raise ArchiveError(f"cannot {doing} {path}: {advice} (nothing published was changed)") from error


def disk_advice(error: OSError) -> str | None:
    """Return the meaning of a disk error and what to do; None for other errors."""
    return _ADVICE.get(error.errno or 0)


def format_disk_error(error: OSError) -> str:
    """Return `disk_advice`, or the system's message."""
    return disk_advice(error) or f"{error.strerror or error}; free space or rights and run again"


def write_all(descriptor: int, content: bytes) -> None:
    """Write every byte, in several calls if need be."""
    view = memoryview(content)
    while view:
        view = view[os.write(descriptor, view) :]


def remove_tree(path: Path) -> None:
    """Remove a folder if it exists; a folder that cannot be removed is left for the next run."""
    if path.is_symlink():  # what it points at is not the archive's
        with suppress(OSError):
            path.unlink()
        return
    shutil.rmtree(path, ignore_errors=True)


def retire(path: Path) -> None:
    """Remove a published folder: first its name, in one step, then its files."""
    if os.path.lexists(path):
        away = path.with_name(f"{path.name}-{secrets.token_hex(4)}{PART_SUFFIX}")
        path.rename(away)
        sync_path(path.parent)  # or a power cut leaves the name, and not the files
        remove_tree(away)


def sync_path(path: Path) -> None:
    """Sync a file's content, or a folder's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename_into_place(part: Path, final: Path) -> None:
    """Give a complete folder its final name, and sync it."""
    sync_path(final.parent.parent)  # the parent may be new: without its own name what it holds is lost
    part.rename(final)
    sync_path(final.parent)


def files_below(folder: Path) -> list[Path]:
    """Return every file under a folder but its manifest, in a fixed order."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME)


def bytes_below(folder: Path) -> int:
    """Return the bytes of a folder's files; 0 for a link to a folder."""
    if folder.is_symlink():
        return 0
    sizes = [path.lstat().st_size for path in files_below(folder) if path.exists()]
    manifest = folder / MANIFEST_NAME
    return sum(sizes) + (manifest.lstat().st_size if manifest.is_file() else 0)


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hex.

    Raises NotPlainError: it is a link, a pipe or another special file.
    """
    digest = hashlib.sha256()
    with plain_reader(path) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def take_lock(path: Path, *, wait: bool = True, shared: bool = False) -> Callable[[], None] | None:
    """Hold ``path`` against other processes and threads until the function returned is called, or the process dies.

    None where another holds it and ``wait`` is false. A ``shared`` lock excludes only exclusive ones. An exclusive
    lock's file is removed on release; a second release does nothing. Raises ArchiveError: the path is no plain file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with ExitStack() as held:
            descriptor = _open_lock(path)
            held.callback(os.close, descriptor)
            kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
            try:
                fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            except BlockingIOError:
                if not wait:
                    return None
                log.info("waiting for another run that holds %s", path.stem)
                fcntl.flock(descriptor, kind)
            if _is_still(descriptor, path):
                if not shared:  # else another may hold it yet
                    held.callback(_drop_name, path)  # called before the lock is let go
                return held.pop_all().close


def _open_lock(path: Path) -> int:
    """Open or create a lock's file, never through a link."""
    if path.parent.name in _OF_LOCKS and path.parent.is_symlink():
        raise _misplaced(path.parent, "a folder")
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _misplaced(path, "a lock file") from error
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ArchiveError(f"{path} is no file, expected a lock file; see what it is, remove it and run again")
    return descriptor


def _misplaced(path: Path, expected: str) -> ArchiveError:
    return ArchiveError(
        f"{path} is a link, expected {expected} of its own; see where it leads and who made it, remove it and run again"
    )


def _drop_name(path: Path) -> None:
    """Remove a lock's file; if the disk refuses, it stays and blocks no process."""
    with suppress(OSError):
        path.unlink()


def _is_still(descriptor: int, path: Path) -> bool:
    """Return whether an open file still has its name, which the last holder of the lock may have removed."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
