"""The working copy of an archive in a bucket: a folder of this machine, and what of it stands in the bucket.

Manifests known to stand there are marked; a store without a mark waits for its upload. Files are fetched when they are
asked for, and a file of another size than its manifest says is fetched again.
"""

from __future__ import annotations

import hashlib
import logging
import secrets
import shutil
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.keys import published_runs, published_stores
from storage.archive.lineage import Catalogue
from storage.archive.manifests import (
    extended_from,
    is_cleared,
    manifest_sha256,
    parse_manifest,
    read_manifest,
    try_manifest,
    write_manifest,
)
from storage.archive.records import RECEIPT, RESTS_ON, read_run
from storage.archive.staging import (
    MANIFEST_NAME,
    refusals,
    remove_tree,
    rename_into_place,
    retire,
    sync_path,
    take_lock,
)
from storage.remote.object_stores import Objects, some_at_a_time
from storage.remote.object_transfers import (
    aside_in,
    attempt_of,
    attempts_in,
    fetch_folder,
    is_address,
    is_here,
    lay_manifest,
    send_extension,
    send_folder,
)

KNOWN = ".known"  # address -> SHA-256 of the manifest that stands in the bucket

log = logging.getLogger(__name__)


class WorkingCopy:
    """A folder with the addresses of an archive, and the bucket that it is a copy of."""

    def __init__(self, root: Path, objects: Objects) -> None:
        self.root, self.objects = root, objects

    # --- one store ----------------------------------------------------------------------------------------------------

    def is_whole(self, uri: str) -> bool:
        """Whether all of a store is here, by its manifest and the sizes of its files; no, where those were cleared."""
        manifest, problem = try_manifest(self.root / uri)
        return problem is None and not is_cleared(manifest) and is_here(self.root / uri)

    def look_up(self, uri: str) -> bool:
        """Ask the bucket for a store that is not whole here; whether it stands there, and its manifest is here then.

        Raises IncompleteStoreError: the manifest that stands in the bucket is damaged.
        """
        dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
        if dated is None:
            return False
        with self._alone(uri):
            self._take(uri, *dated)
            read_manifest(self.root / uri)
        return True

    def send(self, uri: str) -> None:
        """Upload a store; where another came first, take that one, unless its files were cleared away.

        Raises IncompleteStoreError: a file of it is not as it was published.
        """
        with self._alone(uri):
            if self.is_known(uri):
                return
            ours = (self.root / uri / MANIFEST_NAME).read_bytes()
            standing = send_folder(self.objects, uri, self.root / uri)
            if _was_cleared(standing) and not _was_cleared(ours):
                send_extension(self.objects, uri, self.root / uri, standing)
                standing = ours
            if standing == ours:
                self._note(uri)
            elif (dated := self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")) is not None:
                self._take(uri, *dated)

    def send_cleared(self, uri: str) -> None:
        """Have the files of a store go from the bucket too, once they have gone here; nobody may be reading them."""
        with self._alone(uri):
            standing = self.objects.read(f"{uri}/{MANIFEST_NAME}")
            if standing is not None and not _was_cleared(standing):
                send_extension(self.objects, uri, self.root / uri, standing)
                self._note(uri)

    def fetch(self, uri: str) -> None:
        """Have a store or run here whole; of one of which nothing is known, a reader says what it finds.

        Raises IncompleteStoreError: an object of it is missing or has changed, or all of it was removed since.
        """
        folder = self.root / uri
        if not (folder / MANIFEST_NAME).is_file() or is_here(folder):
            return
        with self._alone(uri):
            try:
                fetch_folder(self.objects, self.root, uri)
            except IncompleteStoreError:
                dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
                if dated is not None and dated[0] == (folder / MANIFEST_NAME).read_bytes():
                    raise
                if dated is None:
                    self._give_up(uri)
                self._take(uri, *dated)  # cleared away, and made again since
                fetch_folder(self.objects, self.root, uri)

    def put_in_place(self, part: Path, uri: str) -> None:
        """Give a store that was made here its name, unless another process has brought it from the bucket meanwhile."""
        with self._alone(uri):
            if self.is_whole(uri):
                remove_tree(part)
            else:
                retire(self.root / uri)
                rename_into_place(part, self.root / uri)

    def remove(self, uri: str) -> None:
        """Take a store out of the bucket, its manifest first."""
        self._mark(uri).unlink(missing_ok=True)
        self.objects.remove([f"{uri}/{MANIFEST_NAME}"])
        self.objects.remove(self.objects.listing(uri))

    def ensure(self, uris: Iterable[str]) -> None:
        """See that stores stand in the bucket as they are known here; those that do not are uploaded, or forgotten.

        Raises IncompleteStoreError: one is neither in the bucket nor whole here.
        """
        wanted = list(uris)
        standing = some_at_a_time(lambda uri: self.objects.read_dated(f"{uri}/{MANIFEST_NAME}"), wanted)
        for uri, dated in zip(wanted, standing, strict=True):
            if dated is not None and not (_was_cleared(dated[0]) and self.is_whole(uri)):
                with self._alone(uri):
                    self._take(uri, *dated)
            elif self.is_whole(uri):
                self._mark(uri).unlink(missing_ok=True)
                self.send(uri)
            else:
                self._give_up(uri)

    # --- all of it ----------------------------------------------------------------------------------------------------

    def send_run(self, uri: str) -> None:
        """Upload a run, whose stores are in the bucket; where it stands there without what was added here, with that.

        What another machine has added before is taken instead. Raises ArchiveError: another run of this name is there.
        """
        folder = self.root / uri
        ours, standing = (folder / MANIFEST_NAME).read_bytes(), send_folder(self.objects, uri, folder)
        if _extends(ours, standing):
            send_extension(self.objects, uri, folder, standing)
        elif standing != ours:
            dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
            if dated is None or not _is_of_one_run(dated[0], ours):
                raise ArchiveError(f"{self.objects.place.url}/{uri} is another run than {folder}: move yours away")
            with self._alone(uri):
                self._take(uri, *dated)
                fetch_folder(self.objects, self.root, uri)
            return
        self._note(uri)

    def waiting(self) -> list[str]:
        """What an earlier run could not upload: stores, then runs."""
        stores = [ref.uri for ref in published_stores(self.root)]
        runs = [f"runs/{folder.name}" for folder in published_runs(self.root)]
        return [uri for uri in (*stores, *runs) if not self.is_known(uri) and try_manifest(self.root / uri)[1] is None]

    def send_waiting(self) -> None:
        """Upload what is `waiting`; what is damaged, or rests on what is nowhere any more, is told of and stays."""
        for uri in self.waiting():
            try:
                if uri.startswith("runs/"):
                    self.ensure(read_run(self.root / uri, {}).recorded)
                    self._record_anew(uri)
                    self.send_run(uri)
                else:
                    self.send(uri)
            except IncompleteStoreError as error:
                log.warning("%s/%s waits for its upload, which is not possible: %s", self.root, uri, error)

    def _record_anew(self, uri: str) -> None:
        """Let a run name the manifests that stand now: while it waited, others may have published the same stores."""
        facts, recorded = read_manifest(self.root / uri), read_run(self.root / uri, {}).recorded
        found = {one: manifest_sha256(self.root / one) for one in recorded}
        if found == recorded:
            return
        with aside_in(self.root) as aside:
            shutil.copytree(self.root / uri, aside / "run")
            kept = {name: value for name, value in facts.items() if name not in ("files", "seal", "format")}
            write_manifest(aside / "run", kept | {RESTS_ON: found})
            text = (aside / "run" / MANIFEST_NAME).read_bytes()
        written = (self.root / uri / MANIFEST_NAME).stat().st_mtime
        lay_manifest(self.root, uri, text, datetime.fromtimestamp(written, UTC))

    def mirror(self) -> set[str]:
        """Bring the manifests of all stores and runs, and the receipts; gives what there is in the bucket."""
        stages = [f"stages/{stage}" for stage in self.objects.children("stages")]
        found = {f"{folder}/{name}" for folder in stages for name in self.objects.children(folder)}
        runs = attempts_in(self.objects.listing("runs"))
        found |= set(runs)
        with refusals(self.root, "write to the working copy"):
            some_at_a_time(
                lambda uri: self._mirror_one(uri, runs.get(uri, frozenset())), filter(is_address, sorted(found))
            )
        return found

    def forget_all_but(self, found: Container[str]) -> None:
        """Forget stores that were cleared away in the bucket; nobody may be reading them.

        What a run names is not forgotten: it was lost there, and may be restored from here.
        """
        here = Catalogue.read(self.root)
        for uri in here.stores:
            if uri not in found and self.is_known(uri) and not here.named_by(uri) and not here.is_only_copy(uri):
                self._forget(uri)

    def _mirror_one(self, uri: str, attempts: frozenset[str]) -> None:
        """Bring one manifest; of a run ``attempts`` are those that have left files, of which the last one may count."""
        known = self.is_known(uri)
        if not known or attempts - {attempt_of((self.root / uri / MANIFEST_NAME).read_bytes())}:
            dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
            if dated is None:  # an upload under way, or what was left of one
                return
            waits = not known and try_manifest(self.root / uri)[1] is None  # another of the same key, for its upload
            ours = (self.root / uri / MANIFEST_NAME).read_bytes() if known or waits else b""
            if not (known or waits) or dated[0] == ours or _extends(dated[0], ours):
                with self._alone(uri):
                    self._take(uri, *dated)
        if uri.startswith("runs/"):
            with suppress(IncompleteStoreError):  # whoever reads it says so
                fetch_folder(self.objects, self.root, uri, [RECEIPT])

    # --- marks --------------------------------------------------------------------------------------------------------

    def is_known(self, uri: str) -> bool:
        """Whether the manifest here is known to stand in the bucket."""
        try:
            return self._mark(uri).read_text() == manifest_sha256(self.root / uri)
        except (OSError, IncompleteStoreError):
            return False

    def _take(self, uri: str, manifest: bytes, changed: datetime) -> None:
        """Have the manifest that stands in the bucket here, and known as such unless it is damaged."""
        if try_manifest(self.root / uri)[1] is not None or (self.root / uri / MANIFEST_NAME).read_bytes() != manifest:
            lay_manifest(self.root, uri, manifest, changed)
        if not self.is_known(uri) and try_manifest(self.root / uri)[1] is None:
            self._note(uri)

    def _note(self, uri: str) -> None:
        mark, aside = self._mark(uri), self.root / KNOWN / f".{secrets.token_hex(6)}"
        mark.parent.mkdir(parents=True, exist_ok=True)
        aside.write_text(manifest_sha256(self.root / uri))
        sync_path(aside)
        aside.replace(mark)

    def _forget(self, uri: str) -> None:
        self._mark(uri).unlink(missing_ok=True)
        retire(self.root / uri)

    def _give_up(self, uri: str) -> NoReturn:
        """Say of what is neither whole here nor in the bucket that it is gone; a store can be made again then."""
        if not self.is_known(uri) and (self.root / uri).exists():
            raise IncompleteStoreError(
                f"{self.root / uri} is damaged and was never uploaded: restore it from a copy, or move it away and run "
                "again"
            )
        if not uri.startswith("runs/"):
            self._forget(uri)
        url = self.objects.place.url
        raise IncompleteStoreError(f"{url}/{uri} was removed meanwhile; run again, and it is made again")

    def _mark(self, uri: str) -> Path:
        return self.root / KNOWN / uri

    @contextmanager
    def _alone(self, uri: str) -> Iterator[None]:
        """Let nobody else change what lies here at an address; a disk that refuses says so in words."""
        with refusals(self.root, "write to the working copy"):
            release = take_lock(self.root / ".locks" / f"copy-{uri.replace('/', '-')}.lock")
            try:
                yield
            finally:
                if release is not None:
                    release()


def _was_cleared(manifest: bytes) -> bool:
    """Whether a manifest is of a store whose files were cleared away."""
    return is_cleared(parse_manifest(manifest)[0])


def _extends(later: bytes, earlier: bytes) -> bool:
    """Whether the manifest ``later`` is of the run of ``earlier`` once something was added to it."""
    return hashlib.sha256(earlier).hexdigest() in extended_from(parse_manifest(later)[0])


def _is_of_one_run(standing: bytes, ours: bytes) -> bool:
    """Whether both manifests come of one: another machine has added to the same run."""
    theirs, mine = (extended_from(parse_manifest(text)[0]) for text in (standing, ours))
    return _extends(standing, ours) or not set(theirs).isdisjoint(mine)
