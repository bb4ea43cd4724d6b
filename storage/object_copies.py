"""The working copy of an archive in a bucket: a folder of this machine, and what of it stands in the bucket.

Manifests known to stand there are marked; a store without a mark waits for its upload. Files are fetched when they are
asked for, and a file of another size than its manifest says is fetched again.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.addresses import published_runs, published_stores
from storage.lineage import Catalogue
from storage.manifests import check_files, manifest_sha256, read_manifest, try_manifest
from storage.object_stores import Objects, some_at_a_time
from storage.object_transfers import fetch_folder, is_address, is_here, lay_manifest, send_folder
from storage.records import RECEIPT, read_run
from storage.staging import MANIFEST_NAME, refusals, retire, sync_path, take_lock

KNOWN = ".known"  # address -> SHA-256 of the manifest that stands in the bucket


class WorkingCopy:
    """A folder with the addresses of an archive, and the bucket that it is a copy of."""

    def __init__(self, root: Path, objects: Objects) -> None:
        self.root, self.objects = root, objects

    # --- one store ----------------------------------------------------------------------------------------------------

    def look_up(self, uri: str) -> bool:
        """Ask the bucket for a store that is not here, or is damaged here; whether its manifest is here then.

        Raises
        ------
        IncompleteStoreError : the manifest that stands in the bucket is damaged.
        """
        if try_manifest(self.root / uri)[1] is not None:
            dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
            if dated is None:
                return False
            self._take(uri, *dated)
            read_manifest(self.root / uri)
        return True

    def send(self, uri: str) -> None:
        """Upload a store; where another came first, take that one.

        Raises
        ------
        IncompleteStoreError : a file of it is not as it was published.
        """
        check_files(self.root / uri, hashes=False)
        with self._alone(f"send-{uri}"):
            if self.is_known(uri):
                return
            ours = (self.root / uri / MANIFEST_NAME).read_bytes()
            if send_folder(self.objects, uri, self.root / uri) == ours:
                self._note(uri)
            elif (dated := self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")) is not None:
                self._take(uri, *dated)

    def fetch(self, uri: str) -> None:
        """Have a store or run here whole; of one of which nothing is known, a reader says what it finds."""
        folder = self.root / uri
        if (folder / MANIFEST_NAME).is_file() and not is_here(folder):
            with refusals(self.root, "fetch into the working copy"), self._alone(f"fetch-{uri}"):
                fetch_folder(self.objects, self.root, uri)

    def remove(self, uri: str) -> None:
        """Take a store out of the bucket, its manifest first."""
        self._mark(uri).unlink(missing_ok=True)
        self.objects.remove([f"{uri}/{MANIFEST_NAME}"])
        self.objects.remove(self.objects.listing(uri))

    def ensure(self, uris: Iterable[str]) -> None:
        """See that stores stand in the bucket as they are known here; those that do not are uploaded, or forgotten.

        Raises
        ------
        IncompleteStoreError : one is neither in the bucket nor whole here.
        """
        wanted = list(uris)
        standing = some_at_a_time(lambda uri: self.objects.read_dated(f"{uri}/{MANIFEST_NAME}"), wanted)
        for uri, dated in zip(wanted, standing, strict=True):
            if dated is not None:
                if hashlib.sha256(dated[0]).hexdigest() != manifest_sha256(self.root / uri):
                    self._take(uri, *dated)
                self._note(uri)
            elif is_here(self.root / uri):
                self._mark(uri).unlink(missing_ok=True)
                self.send(uri)
            else:
                self._forget(uri)
                url = self.objects.place.url
                raise IncompleteStoreError(f"{url}/{uri} was removed meanwhile; run again, and it is made again")

    # --- all of it ----------------------------------------------------------------------------------------------------

    def send_run(self, uri: str) -> None:
        """Upload a run, and before it whatever it rests on that is not known to be in the bucket.

        Raises
        ------
        ArchiveError : another run of this name is there.
        """
        rests_on = read_run(self.root / uri, {}).recorded
        self.ensure(one for one in rests_on if not self.is_known(one))
        if send_folder(self.objects, uri, self.root / uri) != (self.root / uri / MANIFEST_NAME).read_bytes():
            raise ArchiveError(f"{self.objects.place.url}/{uri} is another run than {self.root / uri}: move yours away")
        self._note(uri)

    def send_waiting(self) -> None:
        """Upload what an earlier run could not: stores first, then runs."""
        stores = [ref.uri for ref in published_stores(self.root)]
        runs = [f"runs/{folder.name}" for folder in published_runs(self.root)]
        for work, uris in ((self.send, stores), (self.send_run, runs)):
            for uri in uris:
                if not self.is_known(uri) and try_manifest(self.root / uri)[1] is None:
                    work(uri)

    def mirror(self) -> None:
        """Bring the manifests of all stores and runs, and the receipts; forget what was cleared away in the bucket.

        What a run names is not: it was lost there, and may be restored from here.
        """
        stages = [f"stages/{stage}" for stage in self.objects.children("stages")]
        found = {f"{folder}/{name}" for folder in (*stages, "runs") for name in self.objects.children(folder)}
        some_at_a_time(self._mirror_one, filter(is_address, sorted(found)))
        here = Catalogue.read(self.root)
        for uri in here.stores.keys() - found:
            if self.is_known(uri) and not here.named_by(uri) and not here.is_only_copy(uri):
                self._forget(uri)

    def _mirror_one(self, uri: str) -> None:
        if not self.is_known(uri):
            dated = self.objects.read_dated(f"{uri}/{MANIFEST_NAME}")
            if dated is None:  # an upload under way, or what was left of one
                return
            waits = try_manifest(self.root / uri)[1] is None  # another of the same key, for its upload
            if not waits or (self.root / uri / MANIFEST_NAME).read_bytes() == dated[0]:
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
        with refusals(self.root, "write to the working copy"):
            lay_manifest(self.root, uri, manifest, changed)
        if try_manifest(self.root / uri)[1] is None:
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

    def _mark(self, uri: str) -> Path:
        return self.root / KNOWN / uri

    @contextmanager
    def _alone(self, name: str) -> Iterator[None]:
        release: Callable[[], None] | None = take_lock(self.root / ".locks" / f"{name.replace('/', '-')}.lock")
        try:
            yield
        finally:
            if release is not None:
                release()
