"""The folder of an archive: whether it is one, can be one, and lets itself be written to."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.staging import refusals, sync_path

PARTS = ("stages", "runs", "spool", "schedule", ".aside", ".locks")


def open_folder(path: Path, *, create: bool, write: bool) -> None:
    """Make an archive's folder where ``create``, and see whether it can be used.

    Raises
    ------
    ArchiveError : the path is a file, is not there, or does not let itself be read or written to (``write``).
    """
    with _any_refusal(path), refusals(path, "use the archive"):
        if path.exists() and not path.is_dir():
            raise ArchiveError(f"{path} is a file, expected a folder for the archive; choose another --out")
        if not create and not (path / "stages").is_dir():
            state = "is a folder but no archive (it has no folder stages)" if path.is_dir() else "is not there"
            raise ArchiveError(f"{path} {state}; check the name, or make an archive with survey --out")
        _refuse_links(path)
        _make_and_probe(path, create=create, write=write)
        if not os.access(path, os.R_OK | os.X_OK):
            raise ArchiveError(f"cannot read the archive {path}: permission is denied; change the folder's rights")


def _refuse_links(path: Path) -> None:
    """Links within an archive are not followed, so its own folders cannot be any; the archive's name may be one."""
    for part in (*(path / name for name in PARTS), *(path / "stages").glob("*")):
        if part.is_symlink():
            raise ArchiveError(
                f"{part} is a link, which is not followed; put the folder that it leads to in its place, or "
                f"mount it there"
            )


def is_folder_archive(path: Path) -> bool:
    """Whether a path is an archive's folder, or a file, which `open_folder` refuses."""
    return (path / "stages").is_dir() or path.is_file()


@contextmanager
def _any_refusal(path: Path) -> Iterator[None]:
    """At the door whatever the system answers means that this is no place for an archive."""
    try:
        yield
    except ArchiveError:
        raise
    except OSError as error:
        raise ArchiveError(f"cannot use {path} as an archive: {error.strerror}; choose another --out") from error


def _make_and_probe(path: Path, *, create: bool, write: bool) -> None:
    try:
        if create and not (path / "stages").is_dir():
            (path / "stages").mkdir(parents=True, exist_ok=True)
            for named in (path, path.parent):
                sync_path(named)
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(
            f"{error.filename} is or lies below a file, expected a folder; choose another --out"
        ) from error
    if write:
        _probe(path)


def _probe(path: Path) -> None:
    """Write and remove a small file: rights alone do not tell of a read-only or full disk."""
    probe = path / f".probe-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        probe.write_bytes(b"written to see whether this can be written to")
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
