"""The archive: immutable stores, one for each stage and key, and one folder for each run.

::

    stages/<stage>/<key>/     what a stage made, with manifest.json
    runs/<run id>/            receipt.json, report.html, quicklook.png
    spool/<key>/              lines of a capture under way
    .locks/                   held while something is made

A folder whose name ends in ``.part`` is not finished: the next process that makes the same thing removes it. An archive
in a bucket (`storage.remote.object_archive`) has the same addresses.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.keys import (
    StageRef,
    in_text,
    open_folder,
    plain,
    published_runs,
    published_stores,
    stage_key,
    store_at,
    without_manifest,
)
from storage.archive.lineage import Catalogue, rests_on
from storage.archive.manifests import (
    check_files,
    cleared_facts,
    is_cleared,
    made_bytes,
    manifest_sha256,
    read_manifest,
    write_manifest,
)
from storage.archive.records import Run
from storage.archive.run_folders import RunDraft, finish_extensions, take_its_place
from storage.archive.staging import (
    PART_SUFFIX,
    bytes_below,
    check_name,
    refusals,
    remove_tree,
    rename_into_place,
    retire,
    take_lock,
)
from storage.arrays.layout import consolidate_stores

__all__ = ["Archive", "RunDraft", "StageRef", "StagedStore", "stage_key"]


@dataclass(frozen=True)
class StagedStore:
    """A store being made. ``done`` says that another run published it while this one waited: nothing is to be made."""

    path: Path  # folder to write into
    ref: StageRef
    done: bool


class Archive:
    """A folder of immutable stores. Kill the process anywhere: what has a final name is whole."""

    in_bucket = False  # whether `root` is a working copy alone

    def __init__(self, root: Path, *, writes: bool = True) -> None:
        self.root, self.writes = root, writes
        self._spooled = 0

    @classmethod
    def open(cls, root: str | Path, *, create: bool = True, write: bool = True) -> Archive:
        """Open the archive in a folder, or make it where ``create``; `storage.remote.opening` knows buckets as well.

        Raises ArchiveError: the path is a file, is not there, or does not let itself be written to (``write``).
        """
        path = Path(root).absolute()
        open_folder(path, create=create, write=write)
        if write:
            with refusals(path, "write to the archive"):
                finish_extensions(path)
        return cls(path, writes=write)

    @property
    def name(self) -> str:
        """Return the address by which a person opens it again."""
        return str(self.root)

    @property
    def around(self) -> Path:
        """Folder in which what belongs beside the archive is put."""
        return self.root.parent

    # --- stages -------------------------------------------------------------------------------------------------------

    def ref(self, stage: str, key: str) -> StageRef:
        """Return the address of a store, whether it is there or not."""
        return store_at(self.root, stage, key)

    def locate(self, address: str) -> Path:
        """Return the path on this machine of a product, by its address relative to the archive, as a receipt gives it.

        Raises IncompleteStoreError: the store is not there, or its files were cleared away. So does a file that is
        missing, cut short, a link or no plain file.
        """
        uri = in_text(address)
        if uri is not None:
            check_files(self.root / uri, hashes=False)
            if is_cleared(read_manifest(self.root / uri)):
                raise IncompleteStoreError(
                    f"{self.name}/{uri}: its files were cleared away by gc; run its survey again (explain tells the"
                    " command): only what was cleared is made again"
                )
        return self.root / address

    def find(self, stage: str, key: str) -> StageRef | None:
        """Return the published store; None where there is none or its files were cleared away.

        Sizes are compared with the manifest, content only by `verify`. Raises IncompleteStoreError: it is there, but
        its manifest or a file is missing, or has another size.
        """
        ref = store_at(self.root, stage, key)
        if not os.path.lexists(ref.path):
            return None
        check_files(ref.path, hashes=False)
        return None if is_cleared(read_manifest(ref.path)) else ref

    def is_there(self, uri: str) -> bool:
        """Return whether a store's files are there, not only what tells of them."""
        path = self.root / uri
        return path.is_dir() and not is_cleared(read_manifest(path))

    def is_known(self, ref: StageRef) -> bool:
        """Return whether a store was published here, also where its files were cleared away since."""
        return (self.root / ref.uri).is_dir()

    @contextmanager
    def publish(
        self,
        stage: str,
        key: str,
        *,
        version: int | str = 1,
        params: Mapping[str, Any] | None = None,
        inputs: Sequence[str] = (),
    ) -> Iterator[StagedStore]:
        """Yield a folder to write into, and publish it when the block ends well.

        One process at a time makes a key; the others wait and then find ``done``. When the block fails, the folder is
        removed and the archive is unchanged. Raises ArchiveError: the disk refuses; the message names the path and what
        to do.
        """
        ref = self.ref(stage, key)
        final = self.root / ref.uri
        facts = {"stage": stage, "key": key, "version": version, "params": plain(params or {}), "inputs": plain(inputs)}
        with refusals(self.root, "write to the archive"), self._locked(f"{stage}-{key}"):
            done = self.find(stage, key) is not None
            part = final.with_name(key + PART_SUFFIX)
            remove_tree(part)
            part.mkdir(parents=True)
            try:
                yield StagedStore(part, ref, done)
                if not done:
                    consolidate_stores(part)
                    write_manifest(part, facts)
                    self._put_in_place(part, final)
            finally:
                remove_tree(part)

    def _put_in_place(self, part: Path, final: Path) -> None:
        if final.exists():  # its files were cleared away
            take_its_place(part, final)
        else:
            rename_into_place(part, final)

    def produce(
        self,
        stage: str,
        build: Callable[[Path], None],
        *,
        version: int | str,
        params: Mapping[str, Any],
        inputs: Sequence[str] = (),
    ) -> tuple[StageRef, bool]:
        """Find the store of these facts, or have ``build`` write it; the second value says whether it was built."""
        key = stage_key(stage, version, params, inputs)
        found = self.find(stage, key)
        if found is not None:
            return found, False
        with self.publish(stage, key, version=version, params=params, inputs=inputs) as staged:
            if not staged.done:
                build(staged.path)
        return staged.ref, not staged.done

    def manifest(self, ref: StageRef) -> dict[str, Any]:
        """Return the facts of a store: stage, key, version, params, inputs, created, libraries, files."""
        return read_manifest(self.root / ref.uri)

    def stored_bytes(self, ref: StageRef) -> int:
        """Return the size of a store's files by its manifest, as they were made.

        Files that were cleared away count too.
        """
        return made_bytes(self.manifest(ref))

    def manifest_hash(self, ref: StageRef) -> str:
        """Return the SHA-256 of a store's manifest.json, and so of every byte of the store."""
        return manifest_sha256(self.root / ref.uri)

    def manifest_hashes(self, refs: Iterable[StageRef]) -> dict[str, str]:
        """Return the `manifest_hash` of stores and of all they rest on, by address.

        See ``RunDraft.publish(rests_on=...)``.
        """
        plain = [store_at(self.root, ref.stage, ref.key) for ref in refs]
        return {ref.uri: manifest_sha256(ref.path) for ref in rests_on(self.root, plain)}

    def refs(self, stage: str | None = None) -> list[StageRef]:
        """Return every published store (of one stage), by stage and key."""
        return published_stores(self.root, stage)

    def discard(self, ref: StageRef, *, wait: bool = True, unnamed: bool = False) -> bool:
        """Take one store away, for good; a key that is asked for again is made again.

        False where another process works on it and ``wait`` is false. ``unnamed`` says that no run may name it, which
        in a bucket is looked after once more: here the process that clears up is alone.
        """
        with refusals(self.root, "remove from the archive"), self._locked(f"{ref.stage}-{ref.key}", wait=wait) as held:
            if held:
                retire(ref.path)
        return held

    def clear(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Take a store's files away and keep what its manifest tells; asked for again, it is made again.

        False where another process works on it and ``wait`` is false. Raises IncompleteStoreError: its manifest is
        damaged.
        """
        final = self.root / ref.uri
        part = final.with_name(ref.key + PART_SUFFIX)
        with refusals(self.root, "clear up the archive"), self._locked(f"{ref.stage}-{ref.key}", wait=wait) as held:
            if held and not is_cleared(before := read_manifest(final)):
                try:
                    remove_tree(part)
                    part.mkdir()
                    write_manifest(part, cleared_facts(before))
                    take_its_place(part, final)
                finally:
                    remove_tree(part)
        return held

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[bool]:
        """Keep others from clearing stores away while the block runs; many may do so at a time.

        ``alone`` asks to be the only one, and gives False at once where another process uses the archive.
        """
        with refusals(self.root, "write to the archive"):
            release = take_lock(self._lock_path("use"), wait=not alone, shared=not alone)
        try:
            yield release is not None
        finally:
            if release is not None:
                release()

    # --- verification and clearing up ---------------------------------------------------------------------------------

    def reclaim(self) -> list[str]:
        """Remove unfinished folders that no living process works on; gives their addresses."""
        removed: list[str] = []
        with refusals(self.root, "clear up the archive"):
            finish_extensions(self.root)
            for part in sorted((*self.root.glob(f"stages/*/*{PART_SUFFIX}"), *self.root.glob(f"runs/*{PART_SUFFIX}"))):
                release = take_lock(self._lock_path(f"{part.parent.name}-{part.stem}"), wait=False)
                if release is not None:
                    remove_tree(part)
                    removed.append(part.relative_to(self.root).as_posix())
                    release()
        return removed

    def now(self) -> datetime:
        """Return the time by the clock that the age of stores is counted by."""
        return datetime.now(UTC)

    def size_of(self, uri: str) -> int:
        """Return the bytes of all files of a store or run, manifest included, as they are there now."""
        return bytes_below(self.root / uri)

    def sizes(self, uris: Iterable[str]) -> dict[str, int]:
        """Return the sizes of stores and runs, as `size_of` counts them, by address."""
        return {uri: self.size_of(uri) for uri in uris}

    def kept_bytes(self, run: Run, catalogue: Catalogue) -> int:
        """Return the bytes kept for a run: of its folder, of the stores that it names and of those they rest on.

        Manifests count, and a store whose files were cleared away has its manifest alone.
        """
        return sum(self.sizes([run.uri, *catalogue.named_and_below[run.uri]]).values())

    def all_sizes(self, catalogue: Catalogue) -> dict[str, int]:
        """Return the bytes of all files of every store and run, by address, also of stores that are only named."""
        below = catalogue.named_and_below
        return self.sizes(sorted({*catalogue.stores, *below, *(uri for uris in below.values() for uri in uris)}))

    def take_moved(self) -> int:
        """Return the bytes that went to and from a bucket since the last call, or since the archive was opened."""
        return 0

    def lost_runs(self) -> list[str]:
        """Return the addresses of runs that have lost their manifest, so that their stores are unknown."""
        return [
            f"runs/{path.name}" for path in without_manifest(self.root) if path.parent.name == "runs" and path.is_dir()
        ]

    def leftovers(self, keep_days: float) -> dict[str, int]:
        """Return address and bytes of files that broken-off uploads left in a bucket for ``keep_days``.

        None in a folder.
        """
        return {}

    def drop_leftover(self, uri: str) -> None:
        """Remove one of `leftovers`."""

    def drop_run(self, uri: str) -> None:
        """Take a damaged run away."""
        with refusals(self.root, "remove from the archive"):
            retire(self.root / uri)

    # --- runs and spools ----------------------------------------------------------------------------------------------

    def new_run(self, name: str) -> RunDraft:
        """Create the folder of one run; it is not seen under ``runs`` before :meth:`RunDraft.publish`."""
        stem = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{run_stem(name)}"
        run_id, number = stem, 1
        with refusals(self.root, "write to the archive"):
            while (draft := self._begin_run(run_id)) is None:  # another run of the same second takes the next number
                number += 1
                run_id = f"{stem}-{number}"
        return draft

    def _begin_run(self, run_id: str) -> RunDraft | None:
        """Take a run's name and make its folder, empty; None where the name is taken."""
        return self._draft(run_id, wait=False, extends=False)

    def extend_run(self, run_id: str, *, wait: bool = True) -> RunDraft | None:
        """Open a published run to add to it; it stays as it is until :meth:`RunDraft.publish` of the draft returned.

        One process at a time does so; None where another does and ``wait`` is false. Raises ArchiveError: there is no
        run of this name.
        """
        check_name(run_id)
        with refusals(self.root, "write to the archive"):
            draft = self._draft(run_id, wait=wait, extends=True)
        if draft is not None and not draft.published.is_dir():
            draft.abandon()
            raise ArchiveError(f"there is no run {run_id} in {self.name}; see ls")
        return draft

    def _draft(self, run_id: str, *, wait: bool, extends: bool) -> RunDraft | None:
        """Make an empty folder for a run, once it is held; None where another holds it, or has just published it."""
        folder = self.root / "runs" / (run_id + PART_SUFFIX)
        release = take_lock(self._lock_path(f"runs-{run_id}"), wait=wait)
        if release is None:
            return None
        try:
            if not extends and folder.with_name(run_id).exists():
                release()
                return None
            remove_tree(folder)  # of a process that was killed
            folder.mkdir(parents=True)
        except BaseException:
            release()
            raise
        return RunDraft(run_id, folder, self.root, release, extends=extends)

    def runs(self) -> list[Path]:
        """Return the folders of the published runs, oldest first."""
        return published_runs(self.root)

    def spool_folder(self, key: str) -> Path:
        """Return the folder for the lines of a capture under way; it outlives the process, unlike a staged store."""
        check_name(key)
        folder = self.root / "spool" / key
        with refusals(self.root, "write to the archive"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def drop_spool(self, key: str) -> None:
        """Remove a spool whose lines are published; an archive opened for reading keeps it."""
        check_name(key)
        if self.writes:
            self._spooled += bytes_below(self.root / "spool" / key)
            remove_tree(self.root / "spool" / key)

    def take_spooled(self) -> int:
        """Return the bytes of the spools that were removed since the last call, or since the archive was opened."""
        taken, self._spooled = self._spooled, 0
        return taken

    def _lock_path(self, name: str) -> Path:
        return self.root / ".locks" / f"{name}.lock"

    @contextmanager
    def _locked(self, name: str, *, wait: bool = True) -> Iterator[bool]:
        """Hold a lock while the block runs; gives False where another holds it and ``wait`` is false."""
        release = take_lock(self._lock_path(name), wait=wait)
        try:
            yield release is not None
        finally:
            if release is not None:
                release()


def run_stem(name: str) -> str:
    """Return what the folder of a run is called by its survey's name, after its time."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:60] or "run"
