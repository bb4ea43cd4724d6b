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
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, in_text, open_folder, store_at
from storage.archive.manifests import check_files, is_cleared, read_manifest
from storage.archive.run_folders import RunDraft
from storage.archive.staging import refusals
from storage.remote.object_checks import Lease, find_leftovers, find_lost_runs, take_lease
from storage.remote.object_copies import KNOWN, WorkingCopy
from storage.remote.object_stores import Objects, UnreachableError, connect, parse_place
from storage.remote.object_transfers import BEGUN

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
        """The published store, or None: here, or in the bucket, unless its files were cleared away.

        What waits here for its upload is uploaded.

        Raises IncompleteStoreError: it is there, but its manifest is damaged, or a file that is nowhere else.
        """
        ref = self.ref(stage, key)
        folder = self.root / ref.uri
        if not self.copy.is_whole(ref.uri) and not self._while_answering(lambda: self.copy.look_up(ref.uri), False):
            if not folder.exists() or self.copy.is_known(ref.uri):  # cleared away there, or not to be had now
                return None
            check_files(folder, hashes=False)
        if is_cleared(read_manifest(folder)):
            return None
        self._send(ref.uri)
        return ref

    def _send(self, uri: str) -> None:
        """Upload a store that waits; within `in_use` a bucket that does not answer is told of at the end of it."""
        if self.writes and not self.copy.is_known(uri):
            self._while_answering(lambda: self.copy.send(uri), None)

    def _put_in_place(self, part: Path, final: Path) -> None:
        uri = final.relative_to(self.root).as_posix()
        self.copy.put_in_place(part, uri)
        self._send(uri)
        if self._lease is not None:
            self._while_answering(self._lease.renew, None)

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

    def clear(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Take a store's files away, here and in the bucket; see `Archive.clear`."""
        self.copy.ensure([ref.uri])
        cleared = super().clear(store_at(self.root, ref.stage, ref.key), wait=wait)
        if cleared:
            self.copy.send_cleared(ref.uri)
        return cleared

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[bool]:
        """Keep others, on other machines too, from clearing stores away while the block runs.

        Raises UnreachableError: at the end, where the bucket stopped answering: all is kept here, and what to do is
        said.
        """
        with super().in_use(alone=alone) as free:
            lease = self._take_lease(alone=alone) if free and self.trouble is None else None
            outer, self._lease = self._lease, lease or self._lease
            try:
                if alone and lease is not None:  # what others have published since this was opened counts
                    self.copy.forget_all_but(self.copy.mirror())
                yield free and (lease is not None or (self.trouble is not None and not alone))
            finally:
                self._lease = outer
                if lease is not None:
                    with suppress(UnreachableError):
                        lease.end()
        if self.trouble is not None:
            raise UnreachableError(
                f"{self.trouble}; what was made is kept in {self.root}: the same command uploads it and goes on",
                passing=self.trouble.passing,
            )

    def _take_lease(self, *, alone: bool) -> Lease | None:
        with refusals(self.root, "write to the working copy"):
            try:
                return take_lease(self.objects, self.root, alone=alone)
            except UnreachableError as error:
                if alone or not error.passing:
                    raise
                self.go_on_without(error)
                return None

    def go_on_without(self, error: UnreachableError) -> None:
        """Ask nothing of the bucket any more, but work on in the working copy."""
        self.trouble = error
        log.warning("%s; going on in %s", error, self.root)

    def _while_answering(self, work: Callable[[], Result], otherwise: Result) -> Result:
        """Do what needs the bucket; while the archive is in use, go on without it once it does not answer."""
        if self.trouble is not None:
            return otherwise
        try:
            return work()
        except UnreachableError as error:
            if self._lease is None:
                raise
            self.go_on_without(error)
            return otherwise

    def now(self) -> datetime:
        """Time by the clock that dates the objects, as far as a lease tells it."""
        return super().now() if self._lease is None or self._lease.taken is None else self._lease.taken

    def catch_up(self, *, send: bool, mirror: bool) -> None:
        """Upload what waits here where ``send``; bring manifests and receipts, and forget what is gone, where asked."""
        if send and self.copy.waiting():
            with self.in_use():  # or gc elsewhere may take what of it is there for an upload that was broken off
                self.copy.send_waiting()
        if mirror:
            found = self.copy.mirror()
            with super().in_use(alone=True) as free:
                if free:  # or somebody here may be reading what would be forgotten
                    self.copy.forget_all_but(found)

    # --- runs ---------------------------------------------------------------------------------------------------------

    def _begin_run(self, run_id: str) -> RunDraft | None:
        claim = secrets.token_hex(8).encode()
        standing = self._while_answering(lambda: self.objects.claim(f"runs/{run_id}/{BEGUN}", claim), None)
        if self.trouble is not None:  # a name that nobody else takes meanwhile
            run_id = f"{run_id}-{claim.decode()}"
        elif standing != claim:  # another machine began a run of this name
            return None
        return self._sending(super()._begin_run(run_id))

    def extend_run(self, run_id: str, *, wait: bool = True) -> RunDraft | None:
        """Begin to add to a run that is published here or in the bucket; see `Archive.extend_run`."""
        return self._sending(super().extend_run(run_id, wait=wait))

    def _sending(self, draft: RunDraft | None) -> RunDraft | None:
        """Have a run uploaded once it is published in the working copy."""
        if draft is not None:
            draft.send = lambda uri: self._while_answering(lambda: self.copy.send_run(uri), None)
        return draft

    # --- verification and clearing up ---------------------------------------------------------------------------------

    def size_of(self, uri: str) -> int:
        """Bytes of all objects of a store."""
        return sum(one.size for one in self.objects.listing(uri).values())

    def lost_runs(self) -> list[str]:
        """Addresses of runs in the bucket of which there are files, but no manifest, neither there nor here."""
        here = {f"runs/{folder.name}" for folder in self.runs()}
        return [uri for uri in find_lost_runs(self.objects.listing("runs")) if uri not in here]

    def leftovers(self, keep_days: float) -> dict[str, int]:
        """What was broken off and has been in the bucket for ``keep_days``: address and bytes."""
        return find_leftovers(self.objects, keep_days)

    def drop_leftover(self, uri: str) -> None:
        """Remove one of `leftovers`."""
        self.objects.remove(self.objects.listing(uri))


def open_object_archive(text: str | Path, *, create: bool = True, write: bool = True) -> ObjectArchive:
    """Open the archive at ``s3://bucket/prefix``, or begin it where ``create``.

    Without ``create`` all manifests and receipts are brought, for verbs that read the whole of it. Raises
    SettingsError: the address is none. UnreachableError: the bucket refuses, or does not answer and there is no working
    copy to go on with. ArchiveError: there is no archive, the store has no conditional puts, or the working copy cannot
    be written.
    """
    place = parse_place(text)
    root, objects = place.working_copy(), Objects(place, connect(place))
    archive = ObjectArchive(root, objects, writes=write)
    can_go_on = create and write and (root / KNOWN).is_dir()
    try:
        _find_mark(objects, create=create)
        _open_working_copy(root)
        archive.catch_up(send=write, mirror=not create)
    except UnreachableError as error:
        if not (can_go_on and error.passing):
            raise
        _open_working_copy(root)
        archive.go_on_without(error)
    return archive


def _open_working_copy(root: Path) -> None:
    open_folder(root, create=True, write=True)
    with refusals(root, "write to the working copy"):
        (root / KNOWN).mkdir(exist_ok=True)


def is_object_archive(text: str | Path) -> bool:
    """Whether there is an archive at ``s3://bucket/prefix`` (UnreachableError: that cannot be told)."""
    place = parse_place(text)
    return Objects(place, connect(place)).read(MARK) is not None


def _find_mark(objects: Objects, *, create: bool) -> None:
    """See that a prefix has the mark that makes it an archive; where ``create``, write it if need be.

    A store that lets anybody overwrite it is refused.
    """
    name = objects.place.url
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
        raise ArchiveError(f"{name}/{MARK} is not as expected: what answers is no archive, or one of a later version")


@dataclass(frozen=True, eq=False, repr=False)
class RemoteRef(StageRef):
    """A store that may not be on this machine yet: whoever asks for its path has it fetched, and waits."""

    fetch: Callable[[str], None]

    def __getattribute__(self, name: str) -> Any:
        if name == "path":
            object.__getattribute__(self, "fetch")(self.uri)
        return object.__getattribute__(self, name)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StageRef) and (self.stage, self.key) == (other.stage, other.key)

    def __hash__(self) -> int:
        return hash((self.stage, self.key))

    def __repr__(self) -> str:
        return f"RemoteRef({self.uri!r})"
