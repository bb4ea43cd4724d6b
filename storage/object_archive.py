"""An archive in a bucket: the same stores, keys and runs, worked on in a folder of this machine.

What is captured and made is published in the working copy first, as in any archive, then uploaded; a conditional put of
the manifest publishes it for everybody: whoever comes first wins, for ever, and others take what stands. Stores made
elsewhere are found by their manifests, and fetched when somebody asks where they lie. Where the bucket stops answering,
work goes on in the working copy, and the next run uploads what waits there. All of the working copy that is in the
bucket may be deleted at any time while nobody works on it.
"""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import ArchiveError
from storage.addresses import StageRef, in_text, store_at
from storage.archive import Archive, StagedStore
from storage.archive_folder import open_folder
from storage.manifests import check_files
from storage.object_copies import KNOWN, WorkingCopy
from storage.object_leases import Lease, take_lease
from storage.object_places import UnreachableError, connect, parse_place
from storage.object_refs import RemoteRef, RemoteRun
from storage.object_stores import Objects
from storage.run_folders import RunDraft
from storage.staging import rename_into_place, retire
from storage.verification import Finding, Progress

MARK = "archive.json"  # at the prefix: here is an archive
MARK_TEXT = b'{"archive": "spectralzoom", "layout": 1}\n'
Result = TypeVar("Result")

log = logging.getLogger(__name__)


class ObjectArchive(Archive):
    """An archive below ``s3://bucket/prefix``. ``root`` is its working copy."""

    in_bucket = True

    def __init__(self, root: Path, objects: Objects, *, writes: bool = True) -> None:
        super().__init__(root, writes=writes)
        self.objects, self.copy = objects, WorkingCopy(root, objects)
        self.trouble: UnreachableError | None = None  # why nothing is asked of the bucket any more
        self._lease: Lease | None = None

    @property
    def name(self) -> str:
        """Address of the archive, as the user gives it."""
        return self.objects.place.url

    @property
    def around(self) -> Path:
        """The folder in which the user works: there is none around a bucket."""
        return Path.cwd()

    # --- stages -------------------------------------------------------------------------------------------------------

    def ref(self, stage: str, key: str) -> StageRef:
        """Address of a store, whether it is there or not; its path fetches it."""
        plain = store_at(self.root, stage, key)
        return RemoteRef(stage, key, plain.path, self.copy.fetch)

    def find(self, stage: str, key: str) -> StageRef | None:
        """The published store, or None: here, or in the bucket. What waits here for its upload is uploaded.

        Raises
        ------
        IncompleteStoreError : it is there, but its manifest is damaged, or a file that is nowhere else.
        """
        ref = self.ref(stage, key)
        if self.copy.is_known(ref.uri):
            return ref
        if not self._while_answering(lambda: self.copy.look_up(ref.uri), False) and not self._folder(ref).exists():
            return None
        self._send(ref)
        return ref

    def _send(self, ref: StageRef) -> None:
        """Upload a store that waits; without its upload it has to be whole here."""
        if not self.copy.is_known(ref.uri):
            check_files(self._folder(ref), hashes=False)
            if self.writes:
                self._while_answering(lambda: self.copy.send(ref.uri), None)

    def _folder(self, ref: StageRef) -> Path:
        return self.root / ref.uri

    @contextmanager
    def publish(
        self,
        stage: str,
        key: str,
        *,
        version: int | str = 1,
        params: Mapping[str, Any] | None = None,
        inputs: Sequence[str] | Mapping[str, str] = (),
        work: float | None = None,
    ) -> Iterator[StagedStore]:
        """Give a folder to write into; when the block ends well publish it here, then in the bucket.

        Raises
        ------
        UnreachableError : the bucket refuses or does not answer; the store is kept, and uploaded by the next run.
            Within `in_use` this is said at the end of it.
        """
        with super().publish(stage, key, version=version, params=params, inputs=inputs, work=work) as staged:
            yield staged
        if not staged.done:
            self._send(staged.ref)
            if self._lease is not None:
                self._while_answering(self._lease.renew, None)

    def _put_in_place(self, part: Path, final: Path) -> None:
        if self.copy.is_known(final.relative_to(self.root).as_posix()):  # brought meanwhile by another process here
            retire(final)
        rename_into_place(part, final)

    def manifest_hashes(self, refs: Iterable[StageRef]) -> dict[str, str]:
        """`manifest_hash` by address, of stores and of all they rest on, each of which is in the bucket then."""
        given = list(refs)
        hashes = super().manifest_hashes(given)
        self._while_answering(lambda: self.copy.ensure(hashes), None)
        return super().manifest_hashes(given)

    def locate(self, address: str) -> Path:
        """Where on this machine a product lies by its address relative to the archive; fetched if need be."""
        self.copy.fetch(in_text(address) or "/".join(address.split("/")[:2]))
        return super().locate(address)

    def discard(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Take one store away for good, here and in the bucket."""
        gone = super().discard(store_at(self.root, ref.stage, ref.key), wait=wait)
        if gone:
            self.copy.remove(ref.uri)
        return gone

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[bool]:
        """Keep others, on other machines too, from clearing stores away while the block runs.

        Raises
        ------
        UnreachableError : at the end, where the bucket stopped answering: all is kept here, and what to do is said.
        """
        with super().in_use(alone=alone) as free:
            lease = take_lease(self.objects, self.root, alone=alone) if free and self.trouble is None else None
            outer, self._lease = self._lease, lease or self._lease
            try:
                yield free and (lease is not None or (self.trouble is not None and not alone))
            finally:
                self._lease = outer
                if lease is not None:
                    with suppress(UnreachableError):
                        lease.end()
        if self.trouble is not None:
            raise UnreachableError(
                f"{self.trouble}; what was made is kept in {self.root}: the same command uploads it and goes on"
            )

    def _while_answering(self, work: Callable[[], Result], otherwise: Result) -> Result:
        """Do what needs the bucket; while the archive is in use, go on without it once it does not answer."""
        if self.trouble is not None:
            return otherwise
        try:
            return work()
        except UnreachableError as error:
            if self._lease is None:
                raise
            self.trouble = error
            log.warning("%s; going on in %s", error, self.root)
            return otherwise

    # --- runs ---------------------------------------------------------------------------------------------------------

    def _begin_run(self, run_id: str) -> RunDraft | None:
        draft = super()._begin_run(run_id)
        if draft is None:
            return None
        claim = secrets.token_hex(8).encode()
        standing = self._while_answering(lambda: self.objects.claim(f"runs/{run_id}/begun", claim), claim)
        if standing != claim:  # another machine began a run of this name
            draft.abandon()
            return None
        run = RemoteRun(run_id, draft.folder, self.root, draft.abandon)
        run.send = self._send_run
        return run

    def _send_run(self, uri: str) -> None:
        self._while_answering(lambda: self.copy.send_run(uri), None)

    # --- verification and clearing up ---------------------------------------------------------------------------------

    def verify_all(self, progress: Progress | None = None) -> list[Finding]:
        """Read every object of the archive again; findings are named as in a folder."""
        from storage.object_checks import verify_objects

        return verify_objects(self.objects, progress)

    def size_of(self, uri: str) -> int:
        """Bytes of a store by its manifest."""
        _, stage, key = uri.split("/")
        return self.stored_bytes(store_at(self.root, stage, key))

    def leftovers(self, keep_days: float) -> dict[str, int]:
        """What uploads that were broken off left in the bucket for ``keep_days``: address and bytes."""
        from storage.object_checks import find_leftovers

        return find_leftovers(self.objects, keep_days)

    def drop_leftover(self, uri: str) -> None:
        """Remove one of `leftovers`."""
        self.objects.remove(self.objects.listing(uri))


def open_object_archive(text: str | Path, *, create: bool = True, write: bool = True) -> ObjectArchive:
    """Open the archive at ``s3://bucket/prefix``, or begin it where ``create``.

    Without ``create`` all manifests and receipts are brought, for verbs that read the whole of it.

    Raises
    ------
    SettingsError : the address is none.
    UnreachableError : the bucket refuses, or does not answer and there is no working copy to go on with.
    ArchiveError : there is no archive, the store has no conditional puts, or the working copy cannot be written.
    """
    place = parse_place(text)
    root, objects = place.working_copy(), Objects(place, connect(place))
    archive = ObjectArchive(root, objects, writes=write)
    try:
        if create:
            _begin(objects)
        elif objects.read(MARK) is None:
            raise ArchiveError(f"{place.url} is not there; check the name, or make an archive with survey --out")
    except UnreachableError as error:
        if not (create and write and error.passing and (root / KNOWN).is_dir()):
            raise
        archive.trouble = error
        log.warning("%s; going on in %s", error, root)
    open_folder(root, create=True, write=True)
    (root / KNOWN).mkdir(exist_ok=True)
    if write and archive.trouble is None:
        archive.copy.send_waiting()
    if not create:
        archive.copy.mirror()
    return archive


def is_object_archive(text: str | Path) -> bool:
    """Whether there is an archive at ``s3://bucket/prefix`` (UnreachableError: that cannot be told)."""
    place = parse_place(text)
    return Objects(place, connect(place)).read(MARK) is not None


def _begin(objects: Objects) -> None:
    """Write the mark that makes a prefix an archive, and see that the store lets nobody overwrite it."""
    if objects.create(MARK, MARK_TEXT) and objects.create(MARK, MARK_TEXT):
        raise ArchiveError(
            f"{objects.place.url}: this store ignores conditional puts (If-None-Match), without which two surveys "
            "would overwrite each other; use one that has them"
        )
