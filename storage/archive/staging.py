"""How folders come into an archive and leave it: names, refusals of the disk, syncing, renaming, locks."""

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
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.plain_files import NotPlainError, plain_reader

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
    """Whether this can be one folder's or file's name in an archive."""
    return _NAME.fullmatch(name) is not None and not name.endswith(PART_SUFFIX)


def check_name(name: str) -> None:
    """Refuse what cannot be one folder's or file's name in an archive (ArchiveError)."""
    if not is_name(name):
        raise ArchiveError(f"{name!r} cannot be a name in an archive; use letters, digits, '_', '-' and '.'")


@contextmanager
def refusals(path: Path, doing: str) -> Iterator[None]:
    """Turn a disk's refusal under ``path`` into an ArchiveError that says what to do; other errors pass."""
    try:
        yield
    except ArchiveError:
        raise
    except NotPlainError as error:
        raise ArchiveError(f"cannot {doing} {path}: {error.filename}: {error.strerror}; take it out") from error
    except OSError as error:
        advice = disk_advice(error)
        named = error.filename
        elsewhere = isinstance(named, str) and Path(named).is_absolute() and not Path(named).is_relative_to(path)
        if advice is None or elsewhere:
            raise
        raise ArchiveError(f"cannot {doing} {path}: {advice} (nothing published was changed)") from error


def disk_advice(error: OSError) -> str | None:
    """What to do about a disk's refusal; None where the error is another."""
    return _ADVICE.get(error.errno or 0)


def remove_tree(path: Path) -> None:
    """Remove a folder if it is there; one that cannot be removed is left for the next run to reclaim."""
    if path.is_symlink():  # what it points at is not the archive's
        with suppress(OSError):
            path.unlink()
        return
    shutil.rmtree(path, ignore_errors=True)


def retire(path: Path) -> None:
    """Take a published folder away in one step: first its name, then its files."""
    if os.path.lexists(path):
        away = path.with_name(f"{path.name}-{secrets.token_hex(4)}{PART_SUFFIX}")
        path.rename(away)
        sync_path(path.parent)  # or a power cut leaves the name, and not the files
        remove_tree(away)


def sync_path(path: Path) -> None:
    """Ask the disk to have a file's content, or a folder's names, before going on."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename_into_place(part: Path, final: Path) -> None:
    """Give a finished folder its final name, for good."""
    sync_path(final.parent.parent)  # the parent may be new: without its own name what it holds is lost
    part.rename(final)
    sync_path(final.parent)


def files_below(folder: Path) -> list[Path]:
    """Every file under a folder but its manifest, in a fixed order."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME)


def bytes_below(folder: Path) -> int:
    """Bytes of a folder's files, as far as they are there; none of a link to one."""
    if folder.is_symlink():
        return 0
    sizes = [path.lstat().st_size for path in files_below(folder) if path.exists()]
    manifest = folder / MANIFEST_NAME
    return sum(sizes) + (manifest.lstat().st_size if manifest.is_file() else 0)


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hex (NotPlainError: it is a link, a pipe, or whatever else is no file)."""
    digest = hashlib.sha256()
    with plain_reader(path) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def take_lock(path: Path, *, wait: bool = True, shared: bool = False, words: str = "") -> Callable[[], None] | None:
    """Hold ``path`` against other processes and threads until the function returned is called, or the process dies.

    None where another holds it and ``wait`` is false. Holders of a ``shared`` lock keep out only those that want it for
    themselves. The file goes away with a lock that is not shared; letting go twice is harmless. ``words`` are written
    into it for others to read, as far as the disk takes them. Raises ArchiveError: a link, or something else than a
    file, is in its place: what it leads to is not touched.
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
                if words:
                    _write_words(descriptor, words)
                return held.pop_all().close


def _open_lock(path: Path) -> int:
    """Open a lock's file, made where it is missing, and never through a link."""
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


def _write_words(descriptor: int, words: str) -> None:
    """Replace what a lock's file says; one that has another name too may be somebody's file, and is left as it is."""
    with suppress(OSError):  # a full disk keeps nobody from holding a lock
        if os.fstat(descriptor).st_nlink == 1:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, words.encode(), 0)


def _drop_name(path: Path) -> None:
    """Take a lock's file away; where the disk refuses it stays, and holds nobody up."""
    with suppress(OSError):
        path.unlink()


def _is_still(descriptor: int, path: Path) -> bool:
    """Whether an open file has its name yet: whoever held the lock before may have taken it away."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
