"""Open and verify archives in a folder of this machine or below a prefix of a bucket."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.maintenance.verification import Finding, Progress, verify_everything
from storage.remote.object_archive import MARK, ObjectArchive, open_object_archive
from storage.remote.object_stores import Objects, is_remote, parse_place


def open_archive(address: str | Path, *, create: bool = True, write: bool = True) -> Archive:
    """Open the archive at a folder or ``s3://bucket/prefix``, or create it with ``create``.

    Raises ArchiveError: the path is a file, is missing, or cannot be written to (``write``), or obstore is not
    installed, or the objects of a bucket were copied to a folder or the other way round; SettingsError: the address on
    S3 is not valid.
    """
    if is_remote(address):
        return open_object_archive(address, create=create, write=write)
    if (Path(address) / MARK).is_file():
        raise ArchiveError(
            f"{address} is a copy of the objects of a bucket, where stores lie otherwise than in a folder: put them "
            "back into a bucket to use them"
        )
    return Archive.open(address, create=create, write=write)


def is_archive(address: str | Path) -> bool:
    """Return whether there is an archive to open, or a file that will be refused.

    Raises UnreachableError: a bucket does not answer.
    """
    if is_remote(address):
        return Objects(parse_place(address)).read(MARK) is not None
    return (Path(address) / "stages").is_dir() or Path(address).is_file()


def verify_archive(archive: Archive, progress: Progress | None = None) -> list[Finding]:
    """Check every store and every run; each file and shard that is broken has a finding of its own.

    Every object of an archive in a bucket is read again. Findings are named as in a folder.
    """
    if isinstance(archive, ObjectArchive):
        return archive.verify_everything(progress)
    return verify_everything(archive.root, progress)
