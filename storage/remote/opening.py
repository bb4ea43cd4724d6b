"""Archives of either kind, a folder of this machine or a prefix of a bucket: what differs is chosen here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from storage.archive.archive import Archive
from storage.archive.folder import is_folder_archive
from storage.maintenance.repair import Repaired, Rerun, put_back, repair
from storage.maintenance.verification import Finding
from storage.remote.object_places import is_remote, need_obstore


def open_archive(address: str | Path, *, create: bool = True, write: bool = True) -> Archive:
    """Open the archive at a folder or ``s3://bucket/prefix``, or make it where ``create``.

    Raises
    ------
    ArchiveError : the path is a file, is not there, or does not let itself be written to (``write``).
    SettingsError : an address on S3 that is none, or obstore is not installed.
    """
    if not is_remote(address):
        return Archive.open(address, create=create, write=write)
    need_obstore(address)
    from storage.remote.object_archive import open_object_archive  # needs obstore

    return open_object_archive(address, create=create, write=write)


def is_archive(address: str | Path) -> bool:
    """Whether there is something to open: an archive, or a file that will be refused."""
    if not is_remote(address):
        return is_folder_archive(Path(address))
    need_obstore(address)
    from storage.remote.object_archive import is_object_archive

    return is_object_archive(address)


def repair_archive(
    archive: Archive, findings: Iterable[Finding], rerun: Rerun, *, versions: Mapping[str, int | str] | None = None
) -> Repaired:
    """Make an archive whole again; see `storage.maintenance.repair.repair`."""
    if not archive.in_bucket:
        return repair(archive, findings, rerun, versions=versions)
    from storage.remote.object_repairs import repair_objects

    return repair_objects(archive, findings, rerun, versions=versions)


def put_back_archive(archive: Archive) -> list[str]:
    """Put back what a repair that was killed had set aside; gives the addresses."""
    if not archive.in_bucket:
        return put_back(archive.root)
    from storage.remote.object_repairs import put_back_objects

    return put_back_objects(archive)
