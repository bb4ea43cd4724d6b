"""How a folder becomes part of an archive: staged aside, synced, hashed, renamed."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import importlib.metadata
import json
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError, IncompleteStoreError

MANIFEST_NAME = "manifest.json"
PART_SUFFIX = ".part"
_BLOCK = 1 << 22
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_DISTRIBUTIONS = ("spectralzoom", "numpy", "torch", "xarray", "zarr", "numcodecs")
_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space and run again",
    errno.EDQUOT: "the disk quota is used up: free some space and run again",
    errno.EROFS: "the file system is read-only: mount it for writing or choose another --out",
    errno.EACCES: "permission is denied: change the folder's rights or choose another --out",
    errno.EPERM: "permission is denied: change the folder's rights or choose another --out",
    errno.EIO: "the disk reports an error: check the disk, then run again",
    errno.EMFILE: "too many files are open: raise ulimit -n",
    errno.ENOLCK: "the file system has no locks: choose an --out on a local disk",
}

log = logging.getLogger(__name__)


def check_name(name: str) -> None:
    """Refuse what cannot be one folder's or file's name in an archive (ArchiveError)."""
    if not _NAME.fullmatch(name) or name.endswith(PART_SUFFIX):
        raise ArchiveError(f"{name!r} cannot be a name in an archive; use letters, digits, '_', '-' and '.'")


@contextmanager
def refusals(path: Path, doing: str) -> Iterator[None]:
    """Turn a disk's refusal under ``path`` into an ArchiveError that says what to do; other errors pass."""
    try:
        yield
    except ArchiveError:
        raise
    except OSError as error:
        advice = _ADVICE.get(error.errno or 0)
        named = error.filename
        elsewhere = isinstance(named, str) and Path(named).is_absolute() and not Path(named).is_relative_to(path)
        if advice is None or elsewhere:
            raise
        raise ArchiveError(f"cannot {doing} {path}: {advice} (nothing published was changed)") from error


def remove_tree(path: Path) -> None:
    """Remove a folder if it is there; one that cannot be removed is left for the next run to reclaim."""
    shutil.rmtree(path, ignore_errors=True)


def sync_path(path: Path) -> None:
    """Ask the disk to have a file's content, or a folder's names, before going on."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> None:
    """Sync every file of a staged folder and write ``manifest.json`` with their hashes and sizes beside ``facts``."""
    files: dict[str, dict[str, Any]] = {}
    for path in files_below(folder):
        sync_path(path)
        files[path.relative_to(folder).as_posix()] = {"sha256": file_hash(path), "size": path.stat().st_size}
    content = {
        **facts,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "libraries": library_versions(),
        "files": files,
    }
    manifest = folder / MANIFEST_NAME
    manifest.write_text(json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
    sync_path(manifest)
    for inner in sorted(path for path in folder.rglob("*") if path.is_dir()):
        sync_path(inner)
    sync_path(folder)


def rename_into_place(part: Path, final: Path) -> None:
    """Give a finished folder its final name, for good."""
    part.rename(final)
    sync_path(final.parent)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Content of a published folder's manifest.

    Raises
    ------
    IncompleteStoreError : there is none, or it cannot be read.
    """
    path = folder / MANIFEST_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["files"], dict):
            raise TypeError("files is no table")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise IncompleteStoreError(
            f"{folder} has no valid {MANIFEST_NAME} ({error}); remove the folder and run again"
        ) from error
    return dict(content)


def check_files(folder: Path, *, hashes: bool) -> None:
    """Compare a published folder with its manifest: names and sizes, and every byte where ``hashes``.

    Raises
    ------
    IncompleteStoreError : names the first file that is missing, has another size or content, or is not listed.
    """
    listed = read_manifest(folder)["files"]
    for name, entry in listed.items():
        _check_file(folder / name, entry, hashes=hashes)
    if hashes:
        found = {path.relative_to(folder).as_posix() for path in files_below(folder)}
        extra = sorted(found - set(listed))
        if extra:
            raise IncompleteStoreError(f"{folder / extra[0]} is not in the manifest; take it out of the archive")


def _check_file(path: Path, entry: Mapping[str, Any], *, hashes: bool) -> None:
    try:
        size = path.stat().st_size
        content = file_hash(path) if hashes and size == entry["size"] else entry["sha256"]
    except OSError as error:
        raise IncompleteStoreError(f"{path} cannot be read: {error.strerror}; {_CURE}") from error
    if size != entry["size"]:
        raise IncompleteStoreError(f"{path} has {size} bytes, expected {entry['size']}; {_CURE}")
    if content != entry["sha256"]:
        raise IncompleteStoreError(f"{path} has changed since it was published (its SHA-256 differs); {_CURE}")


_CURE = "restore it from a copy, or remove its store and run again"


def files_below(folder: Path) -> list[Path]:
    """Every file under a folder but its manifest, in a fixed order."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST_NAME)


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def library_versions() -> dict[str, str]:
    """Versions of the libraries that a stored result may depend on, as installed."""
    found: dict[str, str] = {}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def take_lock(path: Path, *, wait: bool = True) -> Callable[[], None] | None:
    """Hold ``path`` against other processes and threads until the function returned is called, or the process dies.

    None where another holds it and ``wait`` is false. The file goes away with the lock; letting go twice is harmless.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with ExitStack() as held:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            held.callback(os.close, descriptor)
            if not _lock(descriptor, path, wait=wait):
                return None
            if _is_still(descriptor, path):
                held.callback(path.unlink, missing_ok=True)  # called before the lock is let go
                return held.pop_all().close


def _is_still(descriptor: int, path: Path) -> bool:
    """Whether an open file has its name yet: whoever held the lock before may have taken it away."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _lock(descriptor: int, path: Path, *, wait: bool) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        if not wait:
            return False
        log.info("waiting for another run that makes %s", path.stem)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    return True
