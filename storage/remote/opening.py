"""Archives of either kind, a folder of this machine or a prefix of a bucket: what differs is chosen here."""

from __future__ import annotations

from pathlib import Path

from storage.archive.archive import Archive
from storage.maintenance.verification import Finding, Progress, verify_everything
from storage.remote.object_archive import MARK, ObjectArchive, open_object_archive
from storage.remote.object_stores import Objects, is_remote, parse_place


def open_archive(address: str | Path, *, create: bool = True, write: bool = True) -> Archive:
    """Open the archive at a folder or ``s3://bucket/prefix``, or make it where ``create``.

    Raises ArchiveError: the path is a file, is not there, or cannot be written to (``write``). So does a missing
    obstore, which an archive on S3 needs. SettingsError: an address on S3 that is none.
    """
    if is_remote(address):
        return open_object_archive(address, create=create, write=write)
    return Archive.open(address, create=create, write=write)


def is_archive(address: str | Path) -> bool:
    """Return whether there is something to open: an archive, or a file that will be refused.

    Raises UnreachableError: that cannot be told of an address on S3.
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
