"""An archive in a bucket, with the same stores, keys and runs as in a folder, and a working copy on this machine.

A store's or run's manifest has the same address in the bucket. Its files lie below ``<address>/<attempt>/``. The
attempt is the beginning of the SHA-256 of their manifest, so that two writers never mix their files. A store is
published in the working copy first, then uploaded. A conditional put of its manifest publishes it: the first writer
wins, and others take its store. Files are fetched when their path is used.

If the bucket stops answering, results stay in the working copy, and the same command uploads them. The uploaded part of
a working copy may be deleted while no process uses it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, in_text, open_folder, store_at
from storage.archive.manifests import (
    CLEARED,
    check_files,
    clear_files,
    file_problem,
    is_cleared,
    parse_manifest,
    read_manifest,
    try_manifest,
)
from storage.archive.records import RECEIPT, read_run
from storage.archive.run_folders import RunDraft
from storage.archive.staging import MANIFEST_NAME, is_name, refusals, remove_tree, rename_into_place, retire, sync_path
from storage.maintenance.verification import Finding, Progress, verify_everything
from storage.remote.object_stores import Listed, Objects, parse_place, some_at_a_time

MARK = "archive.json"  # marks a prefix as an archive
MARK_TEXT = b'{"archive": "spectralzoom", "layout": 1}\n'
ATTEMPT = re.compile(r"((?:stages/[^/]+|runs)/[^/]+)/([0-9a-f]{16})/.+")  # a file's address, and its upload
ASIDE = ".fetch-"  # prefix of folders of the working copy for incomplete files
DAY_S = 86400.0
LOG = logging.getLogger(__name__)


class ObjectArchive(Archive):
    """An archive below ``s3://bucket/prefix``. ``root`` is its working copy."""

    in_bucket = True

    def __init__(self, root: Path, objects: Objects, *, writes: bool = True) -> None:
        super().__init__(root, writes=writes)
        self.objects = objects
        self._standing: dict[str, bytes] = {}  # manifests found in the bucket since this was opened
        self._later_runs: set[Path] = set()  # that were published since it was mirrored first

    def __reduce__(self) -> tuple[Callable[[str], ObjectArchive], tuple[str]]:
        """Travel to workers as an address."""
        return _at_worker, (self.name,)

    @property
    def name(self) -> str:
        """Return the address of the archive."""
        return self.objects.place.url

    # --- stores -------------------------------------------------------------------------------------------------------

    def ref(self, stage: str, key: str) -> StageRef:
        """Return the address of a store, whether it exists or not; its path fetches the store."""
        return StageRef(stage, key, store_at(self.root, stage, key).folder, self._fetch)

    def find(self, stage: str, key: str) -> StageRef | None:
        """Return the published store, None without one or where it was cleared; upload it if it is only here.

        Raises IncompleteStoreError: its manifest in the bucket is damaged.
        """
        ref = self.ref(stage, key)
        if ref.uri not in self._standing and not self._find(ref.uri):
            if not self._is_whole(ref.uri):
                return None
            if self.writes:
                self._send(ref.uri)
        return None if is_cleared(self.root / ref.uri) else ref

    def is_known(self, ref: StageRef) -> bool:
        """Return whether a store was published, even if its files were cleared away; fetch its manifest.

        Raises IncompleteStoreError: its manifest in the bucket is damaged.
        """
        return super().is_known(ref) or self._find(ref.uri)

    def manifest_hashes(self, refs: Iterable[StageRef]) -> dict[str, str]:
        """Upload stores and all their inputs, and return the SHA-256 of their manifests by address."""
        given = list(refs)
        self._ensure(super().manifest_hashes(given))
        return super().manifest_hashes(given)

    def locate(self, address: str) -> Path:
        """Fetch a product and return its path on this machine, by its address in a receipt."""
        self._fetch(in_text(address) or "/".join(address.split("/")[:2]))
        return super().locate(address)

    def url(self, path: Path) -> str:
        """Return the address in the bucket of a file or store, by its path in the working copy."""
        address = path.relative_to(self.root).as_posix()
        uri = in_text(address) or "/".join(address.split("/")[:2])
        place = _files_at(uri, (self.root / uri / MANIFEST_NAME).read_bytes())
        return f"{self.name}/{place}{address.removeprefix(uri)}"

    def discard(self, ref: StageRef, *, wait: bool = True, unnamed: bool = False) -> bool:
        """Remove one store here and in the bucket; see `Archive.discard`.

        Its manifest is removed first. An ``unnamed`` store is put back if a run that names it was published since this
        archive was opened. Publishing a run looks for its stores after that, and puts back what it lacks; that stays.
        """
        manifest = f"{ref.uri}/{MANIFEST_NAME}"
        standing = self.objects.read(manifest)
        there = self.objects.listing(ref.uri)
        self.objects.remove([manifest])
        if unnamed:
            self.refresh()
            if any(ref.uri in read_run(folder).names for folder in self._later_runs):
                if standing is not None:
                    self.objects.create(manifest, standing)
                return False
        self._standing.pop(ref.uri, None)
        gone = super().discard(store_at(self.root, ref.stage, ref.key), wait=wait)
        if gone and self.objects.read(manifest) is not None:
            return False  # another machine has put it back, or made it anew
        if gone:
            self.objects.remove(path for path in there if path != manifest)
        elif standing is not None:
            self.objects.create(manifest, standing)
        return gone

    def clear(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Mark a store as cleared and remove its files, here and in the bucket; see `Archive.clear`."""
        self._ensure([ref.uri])
        cleared = super().clear(store_at(self.root, ref.stage, ref.key), wait=wait)
        if cleared:
            kept = {f"{ref.uri}/{name}" for name in (MANIFEST_NAME, CLEARED)}
            self.objects.write(f"{ref.uri}/{CLEARED}", b"")
            self.objects.remove(self.objects.listing(ref.uri).keys() - kept)
        return cleared

    def drop_run(self, uri: str) -> None:
        """Remove a damaged run here and in the bucket."""
        super().drop_run(uri)
        self.objects.remove(self.objects.listing(uri))

    # --- runs ---------------------------------------------------------------------------------------------------------

    def _begin_run(self, run_id: str) -> RunDraft | None:
        """Create a draft under a name that no other machine takes; its run is uploaded once it is published here."""
        draft = super()._begin_run(f"{run_id}-{secrets.token_hex(3)}")
        if draft is not None:
            draft.send = self._send_run
        return draft

    def _send_run(self, uri: str) -> None:
        """Upload a run, and then check its stores in the bucket."""
        self._upload(uri, first=True)
        names = read_run(self.root / uri).names
        self._standing = {one: text for one, text in self._standing.items() if one not in names}
        self._ensure(names)

    def refresh(self) -> None:
        """Fetch manifests and receipts of new runs; drop those that other machines removed."""
        here = [f"runs/{folder.name}" for folder in self.runs()]  # before the bucket's: others here may add some
        found = _manifests(self.objects.listing("runs"))
        self._drop_removed(here, found)
        changed = [uri for uri, one in found.items() if not self._is_dated(uri, one)]
        some_at_a_time(self._bring, changed)
        self._later_runs |= {self.root / uri for uri in changed}

    def send_runs(self) -> None:
        """Upload runs that a killed command has left in the working copy.

        A run stays here alone while its stores are neither here nor in the bucket.
        """
        here = [f"runs/{folder.name}" for folder in self.runs()]
        there = _manifests(self.objects.listing("runs"))
        self._drop_removed(here, there)
        for folder in self.runs():
            uri = f"runs/{folder.name}"
            if uri in there or try_manifest(folder)[1] is not None:
                continue
            try:
                self._ensure(read_run(folder).names)
            except IncompleteStoreError:
                LOG.warning("%s stays on this machine until its survey runs again: a store of it was removed", uri)
            else:
                self._upload(uri, first=True)

    def is_there(self, uri: str) -> bool:
        """Return whether a store has its files, by its manifest in the bucket."""
        return (uri in self._standing or self._find(uri) or self._is_whole(uri)) and super().is_there(uri)

    # --- the whole of it ----------------------------------------------------------------------------------------------

    def mirror(self) -> None:
        """Fetch the manifests of all stores, and of runs the receipts too; drop those that other machines removed."""
        here = [ref.uri for ref in self.refs()]
        stages = [f"stages/{stage}" for stage in self.objects.children("stages")]
        found = [f"{folder}/{key}" for folder in stages for key in self.objects.children(folder)]
        with refusals(self.root, "write to the working copy"):
            some_at_a_time(self._bring, [uri for uri in found if not (self.root / uri / MANIFEST_NAME).is_file()])
            self._drop_removed(here, set(found))
            self.refresh()
        self._later_runs.clear()

    def _drop_removed(self, here: Iterable[str], there: Container[str]) -> None:
        """Drop what is not in the bucket and known here by manifest and receipt alone; files may not have been sent."""
        for uri in here:
            manifest, problem = try_manifest(self.root / uri)
            files = [] if problem is not None else [name for name in manifest["files"] if name != RECEIPT]
            known = problem is None and not any((self.root / uri / name).exists() for name in files)
            if uri not in there and known and self._lacks(uri, manifest):
                retire(self.root / uri)

    def _bring(self, uri: str) -> None:
        with suppress(IncompleteStoreError):  # its reader says so
            if _is_address(uri) and self._find(uri) and uri.startswith("runs/"):
                self._fetch_files(uri, [RECEIPT])

    def now(self) -> datetime:
        """Return the time of the clock that dates the objects, rounded up to whole seconds."""
        if not self.writes:
            return super().now()
        self.objects.write(".now", b"")
        dated = self.objects.read_dated(".now")
        return super().now() if dated is None else dated[1] + timedelta(seconds=1)

    def size_of(self, uri: str) -> int:
        """Return the bytes of all objects of a store or run."""
        return sum(one.size for one in self.objects.listing(uri).values())

    def sizes(self, uris: Iterable[str]) -> dict[str, int]:
        """Return the sizes of stores and runs, as `size_of` counts them, by address."""
        names = list(uris)
        return dict(zip(names, some_at_a_time(self.size_of, names), strict=True))

    @property
    def moved_bytes(self) -> int:
        """Return the bytes of objects sent and received."""
        return self.objects.moved_bytes

    def leftovers(self, keep_days: float) -> dict[str, int]:
        """Return what killed processes left here, and incomplete uploads that are older than ``keep_days``."""
        there = self.objects.listing()
        latest = max((one.changed for one in there.values()), default=None)
        uploads: dict[str, list[Listed]] = {}
        for path, one in there.items():
            if found := ATTEMPT.fullmatch(path):
                uploads.setdefault(f"{found[1]}/{found[2]}", []).append(one)
        old = super().leftovers(keep_days)
        for folder, files in sorted(uploads.items()):
            assert latest is not None
            if (latest - max(one.changed for one in files)).total_seconds() >= keep_days * DAY_S:
                uri = folder.rpartition("/")[0]
                text = self.objects.read(f"{uri}/{MANIFEST_NAME}")
                if text is None or _files_at(uri, text) != folder or f"{uri}/{CLEARED}" in there:
                    old[folder] = sum(one.size for one in files)
        return old

    def drop_leftover(self, uri: str) -> bool:
        """Remove one of `leftovers`; False where a process holds it, or the disk refuses."""
        if not ATTEMPT.fullmatch(f"{uri}/-"):
            return super().drop_leftover(uri)
        self.objects.remove(self.objects.listing(uri))
        return True

    def verify_everything(self, progress: Progress | None = None) -> list[Finding]:
        """Check every store and run in the bucket, not in the working copy."""
        there = self.objects.listing()
        with TemporaryDirectory(prefix="spectralzoom-verify-") as named, refusals(Path(named), "read manifests into"):
            root = Path(named)
            (root / "stages").mkdir()
            some_at_a_time(lambda uri: _lay_out(self.objects, there, root, uri), _manifests(there))

            def problems(folder: Path) -> Iterator[str]:
                uri = folder.relative_to(root).as_posix()
                text = (folder / MANIFEST_NAME).read_bytes()
                found = list(_problems(self.objects, there, folder, _files_at(uri, text)))
                if found and self.objects.read(f"{uri}/{MANIFEST_NAME}") == text:  # else it has gone, or was made anew
                    yield from found

            return verify_everything(root, progress, problems)

    # --- the working copy ---------------------------------------------------------------------------------------------

    def _put_in_place(self, part: Path, final: Path) -> None:
        uri = final.relative_to(self.root).as_posix()
        with self._locked(f"copy-{uri.replace('/', '-')}"):
            if self._is_whole(uri):  # brought from the bucket meanwhile
                remove_tree(part)
            else:
                retire(final)
                rename_into_place(part, final)
        self._send(uri)

    def _is_whole(self, uri: str) -> bool:
        """Return whether a store is complete here by the sizes of its files, and not cleared."""
        manifest, problem = try_manifest(self.root / uri)
        return problem is None and not is_cleared(self.root / uri) and not self._lacks(uri, manifest)

    def _is_marked(self, uri: str) -> bool:
        """Return whether a store is marked as cleared in the bucket."""
        return uri.startswith("stages/") and self.objects.read(f"{uri}/{CLEARED}") is not None

    def _lacks(self, uri: str, manifest: Mapping[str, Any]) -> list[str]:
        return [name for name, one in manifest["files"].items() if _size(self.root / uri / name) != one["size"]]

    def _is_dated(self, uri: str, listed: Listed) -> bool:
        """Return whether the manifest here has the size and date of the object in the bucket."""
        path = self.root / uri / MANIFEST_NAME
        return _size(path) == listed.size and int(path.stat().st_mtime) == int(listed.changed.timestamp())

    def _find(self, uri: str) -> bool:
        """Fetch a manifest from the bucket; False without one. Raises IncompleteStoreError: it is damaged."""
        dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
        if dated is None:
            return False
        if parse_manifest(dated[0])[1] is None or try_manifest(self.root / uri)[1] is not None:
            self._lay(uri, *dated)  # a damaged one does not replace a valid one
        read_manifest(self.root / uri)
        if self._is_marked(uri):
            clear_files(self.root / uri)
        self._standing[uri] = dated[0]
        return True

    def _lay(self, uri: str, manifest: bytes, changed: datetime) -> None:
        """Write a manifest here with the date of its object; remove files that do not match it."""
        folder = self.root / uri
        with self._locked(f"copy-{uri.replace('/', '-')}"), self._aside() as aside:
            before, problem = try_manifest(folder)
            made = aside / folder.name
            made.mkdir()
            (made / MANIFEST_NAME).write_bytes(manifest)
            os.utime(made / MANIFEST_NAME, (changed.timestamp(), changed.timestamp()))
            sync_path(made / MANIFEST_NAME)
            is_same = problem is None and before["files"] == parse_manifest(manifest)[0].get("files")
            if is_same and not is_cleared(folder):
                (made / MANIFEST_NAME).replace(folder / MANIFEST_NAME)
                sync_path(folder)
            else:
                folder.parent.mkdir(parents=True, exist_ok=True)
                retire(folder)
                made.rename(folder)
            sync_path(folder.parent)

    @contextmanager
    def _aside(self) -> Iterator[Path]:
        """Yield a temporary folder of the working copy for incomplete files."""
        with (
            refusals(self.root, "write to the working copy"),
            TemporaryDirectory(prefix=ASIDE, dir=self.root, ignore_cleanup_errors=True) as named,
        ):
            yield Path(named)

    def _fetch(self, uri: str) -> Path:
        """Fetch a store or run, and return its folder, which is missing where there is none.

        Raises IncompleteStoreError: an object of it is missing or has changed.
        """
        known = (self.root / uri / MANIFEST_NAME).is_file() or self._find(uri)
        if known and self._lacks(uri, read_manifest(self.root / uri)):
            self._fetch_files(uri)
        return self.root / uri

    def _fetch_files(self, uri: str, only: Iterable[str] | None = None) -> None:
        """Fetch the missing files (``only`` these names), each checked by its hash."""
        folder = self.root / uri
        manifest = read_manifest(folder)
        place = _files_at(uri, (folder / MANIFEST_NAME).read_bytes())
        with self._locked(f"fetch-{uri.replace('/', '-')}"), self._aside() as aside:

            def fetch(name: str) -> None:
                sha256 = manifest["files"][name]["sha256"]
                self.objects.fetch(f"{place}/{name}", folder / name, sha256, aside / secrets.token_hex(8))

            some_at_a_time(fetch, [name for name in self._lacks(uri, manifest) if only is None or name in only])

    def _send(self, uri: str) -> None:
        """Upload a store that is published here, or take the one in the bucket unless that is cleared.

        Raises IncompleteStoreError: a file of it has changed since it was published.
        """
        dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
        if dated is None or self._is_marked(uri):
            self._upload(uri, first=dated is None)
        else:
            self._lay(uri, *dated)
            self._standing[uri] = dated[0]

    def _upload(self, uri: str, *, first: bool) -> None:
        """Upload a folder's files, then its manifest: ``first`` by a conditional put, or over a cleared one."""
        folder = self.root / uri
        text = (folder / MANIFEST_NAME).read_bytes()
        files = read_manifest(folder)["files"]
        check_files(folder, hashes=True)
        place = _files_at(uri, text)
        there = self.objects.listing(uri)
        sizes = {path: one.size for path, one in there.items()}
        waiting = [name for name, one in files.items() if sizes.get(f"{place}/{name}") != one["size"]]
        some_at_a_time(lambda name: self.objects.write(f"{place}/{name}", folder / name), waiting)
        if not first and self._is_marked(uri):
            self.objects.write(f"{uri}/{MANIFEST_NAME}", text)
            self.objects.remove([f"{uri}/{CLEARED}"])
        elif not first or not self.objects.create(f"{uri}/{MANIFEST_NAME}", text):
            self._find(uri)  # another writer was first, or the answer to this put was lost
            return
        self._standing[uri] = text
        if uri.startswith("runs/") and (dated := self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")) is not None:
            self._lay(uri, *dated)  # with the date of the object

    def _ensure(self, uris: Iterable[str]) -> None:
        """Upload the stores that are missing in the bucket.

        Raises IncompleteStoreError: one is neither in the bucket nor complete here.
        """

        def ensure(uri: str) -> None:
            if uri not in self._standing and not self._find(uri):
                if not self._is_whole(uri):
                    raise IncompleteStoreError(f"{self.name}/{uri} was removed meanwhile. Run again: it is built again")
                self._send(uri)

        some_at_a_time(ensure, list(uris))


@cache
def _at_worker(url: str) -> ObjectArchive:
    """Return the archive to a worker, which fetches the stores that it reads into its own machine's working copy."""
    place = parse_place(url)
    archive = ObjectArchive(place.working_copy(), Objects(place), writes=False)
    open_folder(archive.root, create=True, write=True)
    return archive


def _is_address(uri: str) -> bool:
    """Return whether an object's name can be an address in an archive."""
    return all(is_name(part) for part in uri.split("/"))


def _files_at(uri: str, manifest: bytes) -> str:
    """Return the address of the files that a manifest lists."""
    return f"{uri}/{hashlib.sha256(manifest).hexdigest()[:16]}"


def _manifests(there: Mapping[str, Listed]) -> dict[str, Listed]:
    """Return the published stores and runs, by address."""
    depths = {"stages": 4, "runs": 3}
    named = {
        path.removesuffix(f"/{MANIFEST_NAME}"): one
        for path, one in there.items()
        if path.endswith(f"/{MANIFEST_NAME}") and _is_address(path)
    }
    return {uri: one for uri, one in named.items() if depths.get(uri.split("/")[0]) == uri.count("/") + 2}


def _lay_out(objects: Objects, there: Container[str], root: Path, uri: str) -> None:
    """Write the manifest at an address into a folder with its mark, and of a run the receipt, damaged or not."""
    text = objects.read(f"{uri}/{MANIFEST_NAME}")
    if text is None:
        return
    (root / uri).mkdir(parents=True)
    (root / uri / MANIFEST_NAME).write_bytes(text)
    if f"{uri}/{CLEARED}" in there:
        (root / uri / CLEARED).touch()
    if uri.startswith("runs/") and (receipt := objects.read(f"{_files_at(uri, text)}/{RECEIPT}")) is not None:
        (root / uri / RECEIPT).write_bytes(receipt)


def _problems(objects: Objects, there: Mapping[str, Listed], folder: Path, place: str) -> Iterator[str]:
    """Yield the problems of one published folder whose files lie at ``place``, object by object."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} is damaged: {problem}"
    if problem is not None or is_cleared(folder):
        return
    for name, entry in manifest["files"].items():
        file = folder / name
        try:
            objects.save(f"{place}/{name}", file)
        except FileNotFoundError:
            file.unlink()
        if (problem := file_problem(file, entry, hashes=True)) is not None:
            yield f"{name} {problem}"
        file.unlink(missing_ok=True)
    extra = {path.removeprefix(f"{place}/") for path in there if path.startswith(f"{place}/")} - set(manifest["files"])
    yield from (f"{name} is not in the manifest: take it out of the archive" for name in sorted(extra))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1


def open_object_archive(text: str | Path, *, create: bool = True, write: bool = True) -> ObjectArchive:
    """Open the archive at ``s3://bucket/prefix``, or create it with ``create``.

    Without ``create`` all manifests and receipts are fetched. Raises SettingsError: the address is not valid;
    UnreachableError: the bucket refuses or does not answer; ArchiveError: there is no archive, the store has no
    conditional puts, or the working copy cannot be written.
    """
    place = parse_place(text)
    archive = ObjectArchive(place.working_copy(), Objects(place), writes=write)
    _find_mark(archive.objects, create=create)
    open_folder(archive.root, create=True, write=True)
    for old in archive.root.glob(f"{ASIDE}*"):  # of a process that was killed
        if time.time() - old.stat().st_mtime > DAY_S:
            remove_tree(old)
    if write:
        archive.send_runs()
    if create:
        archive.refresh()
    else:
        archive.mirror()
    return archive


def _find_mark(objects: Objects, *, create: bool) -> None:
    """Check the mark of an archive, or write it with ``create``; refuse a store without conditional puts."""
    name = objects.place.url
    if create and objects.read(MARK) is None and objects.listing("stages") and objects.read(MARK) is None:
        raise ArchiveError(
            f"{name} has stages and no {MARK}: this is no archive of a bucket, maybe a copy of one in a folder, whose "
            "stores lie otherwise; choose another --out"
        )
    if create and objects.create(MARK, MARK_TEXT):
        if objects.create(MARK, MARK_TEXT):
            raise ArchiveError(
                f"{name}: this store ignores conditional puts (If-None-Match), without which two surveys would "
                "overwrite each other; use one that has them"
            )
        return
    found = objects.read(MARK)
    if found is None:
        raise ArchiveError(f"{name} is not there; check the name, or make an archive with survey --out")
    if found != MARK_TEXT:
        raise ArchiveError(f"{name}/{MARK} is not as expected: this is no archive, or one of a later version")
