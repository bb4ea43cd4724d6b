"""Archives of either kind, a folder of this machine or a prefix of a bucket: what differs is chosen here.

In a bucket an archive is made whole from this machine's working copy where that is whole, else by surveys. What is to
be made anew is withdrawn: its manifest is kept below ``.withdrawn/``, its files stay. What a survey does not make again
is put back; killed in between, the next repair, on whichever machine, begins by putting back.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.manifests import file_problem, try_manifest
from storage.archive.staging import MANIFEST_NAME, retire
from storage.maintenance.repair import Repaired, Rerun, plan_repair, put_back, repair, run_again
from storage.maintenance.verification import Finding, Progress, verify_everything, verify_growing
from storage.remote.object_archive import ObjectArchive, is_object_archive, open_object_archive
from storage.remote.object_checks import verify_objects
from storage.remote.object_stores import is_remote
from storage.remote.object_transfers import WITHDRAWN, files_at


def open_archive(address: str | Path, *, create: bool = True, write: bool = True) -> Archive:
    """Open the archive at a folder or ``s3://bucket/prefix``, or make it where ``create``.

    Raises ArchiveError: the path is a file, is not there, or does not let itself be written to (``write``); obstore,
    which an archive on S3 needs, is not installed. SettingsError: an address on S3 that is none.
    """
    if is_remote(address):
        return open_object_archive(address, create=create, write=write)
    return Archive.open(address, create=create, write=write)


def is_archive(address: str | Path) -> bool:
    """Whether there is something to open: an archive, or a file that will be refused."""
    if is_remote(address):
        return is_object_archive(address)
    return (Path(address) / "stages").is_dir() or Path(address).is_file()


def verify_archive(archive: Archive, progress: Progress | None = None) -> list[Finding]:
    """Check every store and every run; each file and shard that is broken has a finding of its own.

    Of an archive in a bucket every object is read again, and what grows in the working copy; findings are named as in a
    folder.
    """
    if isinstance(archive, ObjectArchive):
        return [*verify_objects(archive.objects, progress), *verify_growing(archive.root)]
    return verify_everything(archive.root, progress)


def repair_archive(
    archive: Archive, findings: Iterable[Finding], rerun: Rerun, *, versions: Mapping[str, int | str] | None = None
) -> Repaired:
    """Make an archive whole again; see `storage.maintenance.repair.repair`."""
    if isinstance(archive, ObjectArchive):
        return repair_objects(archive, findings, rerun, versions=versions)
    return repair(archive, findings, rerun, versions=versions)


def put_back_archive(archive: Archive) -> list[str]:
    """Put back what a repair that was killed had set aside; gives the addresses."""
    return put_back_objects(archive) if isinstance(archive, ObjectArchive) else put_back(archive.root)


def repair_objects(
    archive: ObjectArchive,
    findings: Iterable[Finding],
    rerun: Rerun,
    *,
    versions: Mapping[str, int | str] | None = None,
) -> Repaired:
    """Write broken objects again from the working copy; withdraw what it lacks, and run the surveys that name it.

    Raises ArchiveError: somebody else uses the archive, or the bucket refuses.
    """
    with archive.in_use(alone=True) as alone:
        if not alone:
            raise ArchiveError(f"{archive.name} is in use; run verify --repair again when the survey there has ended")
        put_back_objects(archive)
        broken = list(findings)
        wanted = dict.fromkeys(one.uri for one in broken if one.kind in ("broken", "missing"))
        cured = [uri for uri in wanted if _cure(archive, uri)]
        plan = plan_repair(archive, [one for one in broken if one.uri not in cured], versions=versions)
        for uri in plan.remade:
            _withdraw(archive, uri)
    done = Repaired(plan, remade=cured)
    try:
        ran = run_again(plan.surveys, rerun, done)
    except BaseException:
        put_back_objects(archive)
        raise
    _settle(archive, done)
    for uri, text in plan.broken_runs.items():
        if text in ran:
            archive.copy.remove(uri)
            retire(archive.root / uri)
            done.remade.append(uri)
        else:
            done.failed.setdefault(uri, "it cannot be read: run that survey again by hand, then remove its objects")
    return done


def put_back_objects(archive: ObjectArchive) -> list[str]:
    """Put back what a broken-off repair had withdrawn, unless it has been made again; gives the addresses."""
    back: list[str] = []
    for name in archive.objects.listing(WITHDRAWN):
        uri = name.removeprefix(f"{WITHDRAWN}/").removesuffix(f"/{MANIFEST_NAME}")
        if _put_back(archive, uri):
            back.append(uri)
    return back


def _put_back(archive: ObjectArchive, uri: str) -> bool:
    kept = archive.objects.read(f"{WITHDRAWN}/{uri}/{MANIFEST_NAME}")
    back = kept is not None and archive.objects.create(f"{uri}/{MANIFEST_NAME}", kept)
    archive.objects.remove([f"{WITHDRAWN}/{uri}/{MANIFEST_NAME}"])
    return back


def _cure(archive: ObjectArchive, uri: str) -> bool:
    """Write what is broken of a store or run again, if the working copy has it as it was published.

    False where that is not what is wrong with it.
    """
    folder, objects = archive.root / uri, archive.objects
    manifest, problem = try_manifest(folder)
    if problem is not None or not archive.copy.is_known(uri):
        return False
    ours, standing = (folder / MANIFEST_NAME).read_bytes(), objects.read(f"{uri}/{MANIFEST_NAME}")
    place, files = files_at(uri, ours), manifest["files"]
    broken = [name for name, entry in files.items() if not _is_whole(archive, f"{place}/{name}", entry["sha256"])]
    if standing not in (None, ours) and len(broken) == len(files):  # ours was cleared away, and another made since
        return False
    if any(file_problem(folder / name, files[name], hashes=True) is not None for name in broken):
        return False
    for name in broken:
        objects.write(f"{place}/{name}", folder / name)
    if standing != ours:
        objects.write(f"{uri}/{MANIFEST_NAME}", ours)
    return bool(broken) or standing != ours


def _is_whole(archive: ObjectArchive, name: str, sha256: str) -> bool:
    try:
        return archive.objects.measure(name)[1] == sha256
    except FileNotFoundError:
        return False


def _withdraw(archive: ObjectArchive, uri: str) -> None:
    """Take a manifest away, and remember it; nothing of the working copy's stays either."""
    standing = archive.objects.read(f"{uri}/{MANIFEST_NAME}")
    if standing is not None:
        archive.objects.write(f"{WITHDRAWN}/{uri}/{MANIFEST_NAME}", standing)
        archive.objects.remove([f"{uri}/{MANIFEST_NAME}"])
    retire(archive.root / uri)


def _settle(archive: ObjectArchive, done: Repaired) -> None:
    """Say of each store whether it was made again; what was not is put back, unless nobody named it."""
    catalogue = Catalogue.read(archive.root)
    for uri in reversed(done.plan.remade):
        if archive.objects.read(f"{uri}/{MANIFEST_NAME}") is not None:
            done.remade.append(uri)
        elif not catalogue.named_by(uri):
            done.dropped.append(uri)
        else:
            done.put_back[uri] = "; ".join(done.failed.values()) or "its survey ran again and did not make it"
            _put_back(archive, uri)
        archive.objects.remove([f"{WITHDRAWN}/{uri}/{MANIFEST_NAME}"])
