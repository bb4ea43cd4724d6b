"""Handle the files and folders of an archive: names, errors of the disk, syncing, locks, and settings in TOML."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import os
import re
import secrets
import shutil
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.errors import ArchiveError

MOST_BYTES = 10_000_000  # settings are a page long


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file, with or without a byte order mark.

    Raises FileNotFoundError: there is no such file. ValueError: it cannot be read as TOML.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():  # a pipe would be waited for
            raise ValueError("it is no plain file")
        if size > MOST_BYTES:
            raise ValueError(f"it has {size} bytes, settings have a few thousand")
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(str(error)) from error
    except RecursionError:
        raise ValueError("its lists or tables are nested too deeply") from None


MANIFEST_NAME = "manifest.json"
PART_SUFFIX = ".part"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again",
    errno.EROFS: "the file system is read-only: mount it for writing or choose another folder",
    **dict.fromkeys((errno.EACCES, errno.EPERM), "permission is denied: change the rights or choose another folder"),
    errno.EIO: "the disk reports an error: check the disk, then run again",
    errno.EFBIG: "a file may not grow so large here: raise ulimit -f, or choose a folder on another file system",
    errno.EMFILE: "too many files are open: raise ulimit -n",
    errno.ENAMETOOLONG: "the name is too long for this file system: give a shorter one",
    errno.ENOLCK: "the file system has no locks: choose a folder on a local disk",
    errno.ELOOP: "a link stands where a file of its own belongs: see where it leads, remove it and run again",
}

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


def write_all(descriptor: int, content: bytes | memoryview) -> None:
    """Write every byte, in several calls if need be."""
    view = memoryview(content)
    while view:
        view = view[os.write(descriptor, view) :]


def remove_tree(path: Path) -> None:
    """Remove a folder if it exists; a folder that cannot be removed is left for the next run."""
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
    """Return the bytes of a folder's files, manifest included; files that go meanwhile count as 0."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):
            total += path.stat().st_size if path.is_file() else 0
    return total


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def take_lock(path: Path, *, wait: bool = True, shared: bool = False) -> Callable[[], None] | None:
    """Hold ``path`` against other processes and threads until the function returned is called, or the process dies.

    None where another holds it and ``wait`` is false. A ``shared`` lock excludes only exclusive ones. The file stays; a
    second release does nothing.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        held.callback(os.close, descriptor)
        kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                return None
            log.info("waiting for another run that holds %s", path.stem)
            fcntl.flock(descriptor, kind)
        return held.pop_all().close
