"""The archive: immutable stores, one for each stage and key, and one folder for each run.

::

    stages/<stage>/<key>/     what a stage made, with manifest.json
    runs/<run id>/            receipt.json, report.html, quicklook.png
    spool/<key>/              lines of a capture under way
    .locks/                   held while something is made

A folder whose name ends in ``.part`` is not finished: the next process that builds the same store removes it. An
archive may be copied to a bucket and back (`storage.remote.bucket`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from spectralzoom.pipeline.errors import IncompleteStoreError, NoRunError
from spectralzoom.storage.archive.keys import (
    LATEST,
    StageRef,
    in_text,
    open_folder,
    plain,
    published_runs,
    published_stores,
    stage_key,
    store_at,
)
from spectralzoom.storage.archive.lineage import rests_on
from spectralzoom.storage.archive.manifests import (
    CLEARED,
    check_files,
    clear_files,
    cleared_leftovers,
    is_cleared,
    listed_bytes,
    manifest_sha256,
    read_manifest,
    refill,
    try_manifest,
    write_manifest,
)
from spectralzoom.storage.archive.run_folders import RunDraft
from spectralzoom.storage.archive.staging import (
    PART_SUFFIX,
    bytes_below,
    check_name,
    refusals,
    remove_tree,
    rename_into_place,
    retire,
    sync_path,
    take_lock,
)
from spectralzoom.storage.arrays.layout import consolidate_stores

__all__ = ["Archive", "RunDraft", "StageRef", "StagedStore", "stage_key"]


@dataclass(frozen=True)
class StagedStore:
    """A store that is being built; ``done`` where another process has published it meanwhile."""

    path: Path  # folder to write into
    ref: StageRef
    done: bool


class Archive:
    """A folder of immutable stores. A folder with its final name is complete, wherever a process was killed."""

    def __init__(self, root: Path, *, writes: bool = True) -> None:
        self.root = root
        self.writes = writes
        self.spooled_bytes = 0  # of the spools that were removed

    @classmethod
    def open(cls, root: str | Path, *, create: bool = True, write: bool = True) -> Archive:
        """Open the archive in a folder, or create it with ``create``.

        Raises ArchiveError: the path is a file, is missing, or cannot be written to (``write``).
        """
        open_folder(Path(root), create=create, write=write)
        return cls(Path(root).absolute(), writes=write)

    @property
    def name(self) -> str:
        """Return the address that opens it again."""
        return str(self.root)

    # --- stages -------------------------------------------------------------------------------------------------------

    def ref(self, stage: str, key: str) -> StageRef:
        """Return the address of a store, whether it exists or not."""
        return store_at(self.root, stage, key)

    def locate(self, address: str) -> Path:
        """Return the path on this machine of a product, by its address in a receipt.

        Raises IncompleteStoreError: the store is missing or was cleared, or a file is missing or cut short.
        """
        if (uri := in_text(address)) is not None:
            check_files(self.root / uri, hashes=False)
            if is_cleared(self.root / uri):
                raise IncompleteStoreError(
                    f"{self.name}/{uri}: its files were cleared away. Run its survey again, for raw lines with"
                    " --keep raw (explain prints the command of the run): only cleared stores are built again"
                )
        return self.root / address

    def key(self, stage: str, version: int | str, params: Mapping[str, Any], inputs: Sequence[StageRef]) -> str:
        """Return the key of a store."""
        return stage_key(stage, version, params, [one.key for one in inputs])

    def find(self, stage: str, key: str) -> StageRef | None:
        """Return the published store; None where there is none or its files were cleared away.

        Sizes are compared with the manifest; only `verify` compares content. Raises IncompleteStoreError: its manifest
        or a file is missing, or has another size.
        """
        ref = store_at(self.root, stage, key)
        if not ref.path.exists():
            return None
        check_files(ref.path, hashes=False)
        return None if is_cleared(ref.path) else ref

    def is_there(self, uri: str) -> bool:
        """Return whether a store has its files, not its manifest alone."""
        path = self.root / uri
        return path.is_dir() and not is_cleared(path)

    def is_known(self, ref: StageRef) -> bool:
        """Return whether a store was published here, even if its files were cleared away."""
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

        One process at a time builds a key; the others wait and then find ``done``. When the block fails, the folder is
        removed and the archive is unchanged. Raises ArchiveError: the disk refuses.
        """
        ref = self.ref(stage, key)
        final = self.root / ref.uri
        part = final.with_name(key + PART_SUFFIX)
        facts = {"stage": stage, "key": key, "version": version, "params": plain(params or {}), "inputs": plain(inputs)}
        with refusals(self.root, "write to the archive"), self._locked(f"{stage}-{key}"):
            done = self.find(stage, key) is not None
            remove_tree(part)
            part.mkdir(parents=True)
            try:
                yield StagedStore(part, ref, done)
                if not done:
                    consolidate_stores(part)
                    write_manifest(part, facts)
                    (refill if final.exists() else rename_into_place)(part, final)  # there where it was cleared
            finally:
                remove_tree(part)

    def produce(
        self,
        stage: str,
        build: Callable[[Path], None],
        *,
        version: int | str,
        params: Mapping[str, Any],
        inputs: Sequence[str | StageRef] = (),
    ) -> tuple[StageRef, bool]:
        """Return the store with this key, and whether ``build`` wrote it now or it existed."""
        keys = [one if isinstance(one, str) else one.key for one in inputs]
        key = stage_key(stage, version, params, keys)
        if (found := self.find(stage, key)) is not None:
            return found, False
        with self.publish(stage, key, version=version, params=params, inputs=keys) as staged:
            if not staged.done:
                build(staged.path)
        return staged.ref, not staged.done

    def manifest(self, ref: StageRef) -> dict[str, Any]:
        """Return the manifest of a store: stage, key, version, params, inputs, created, libraries, files."""
        return read_manifest(self.root / ref.uri)

    def stored_bytes(self, ref: StageRef) -> int:
        """Return the size of a store's files as they were published; cleared files count too."""
        return listed_bytes(self.manifest(ref))

    def manifest_hashes(self, refs: Iterable[StageRef]) -> dict[str, str]:
        """Return the SHA-256 of the manifests of stores and all their inputs, and so of every byte, by address."""
        return {ref.uri: manifest_sha256(ref.path) for ref in rests_on(self.root, refs)}

    def refs(self, stage: str | None = None) -> list[StageRef]:
        """Return every published store (of one stage), by stage and key."""
        return published_stores(self.root, stage)

    def discard(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Remove one store; False where another process holds it and ``wait`` is false."""
        with refusals(self.root, "remove from the archive"), self._locked(f"{ref.stage}-{ref.key}", wait=wait) as held:
            if held:
                retire(ref.path)
        return held

    def clear(self, ref: StageRef, *, wait: bool = True) -> bool:
        """Remove a store's files and keep its manifest; a later request builds them again.

        False where another process holds it and ``wait`` is false. Raises IncompleteStoreError: its manifest is
        damaged.
        """
        final = self.root / ref.uri
        with refusals(self.root, "clear up the archive"), self._locked(f"{ref.stage}-{ref.key}", wait=wait) as held:
            if held:
                read_manifest(final)
                clear_files(final)
        return held

    @contextmanager
    def adopt(self, uri: str) -> Iterator[Path | None]:
        """Yield a folder to copy a published store or run into, with its manifest; None where it is here already."""
        final = self.root / uri
        part = final.with_name(final.name + PART_SUFFIX)
        with refusals(self.root, "write to the archive"), self._locked(self._lock_name(final)):
            if final.exists():
                yield None
                return
            remove_tree(part)
            part.mkdir(parents=True)
            try:
                yield part
                for path in (*part.rglob("*"), part):
                    sync_path(path)
                rename_into_place(part, final)
            finally:
                remove_tree(part)

    @contextmanager
    def in_use(self, *, alone: bool = False) -> Iterator[bool]:
        """Keep other processes from removing stores while the block runs; many may use an archive at a time.

        ``alone`` asks for exclusive use, and yields False at once where another process uses the archive.
        """
        with ExitStack() as held:
            with refusals(self.root, "write to the archive"):
                is_held = held.enter_context(self._locked("use", wait=not alone, shared=not alone))
            yield is_held

    # --- verification and clearing up ---------------------------------------------------------------------------------

    def reclaim(self) -> list[str]:
        """Remove what killed processes left in this folder; return the addresses."""
        with refusals(self.root, "clear up the archive"):
            return [uri for uri in self.leftovers() if self.drop_leftover(uri)]

    def leftovers(self) -> dict[str, int]:
        """Return addresses and bytes of what killed processes left.

        These are unfinished folders, spools of published captures, and stores that are marked as cleared and have
        files.
        """
        spools = [
            path
            for path in self.root.glob("spool/*")
            if any(
                try_manifest(store)[1] is None and not is_cleared(store)  # a cleared capture is being taken again
                for store in self.root.glob(f"stages/*/{path.name}")
            )
        ]
        parts = [*self.root.glob(f"stages/*/*{PART_SUFFIX}"), *self.root.glob(f"runs/*{PART_SUFFIX}")]
        marked = (mark.parent for mark in self.root.glob(f"stages/*/*/{CLEARED}"))
        found: dict[str, int] = {}
        for path in sorted((*parts, *spools, *filter(cleared_leftovers, marked))):
            lock = self._lock_path(self._lock_name(path))
            release = take_lock(lock, wait=False) if lock.exists() else lambda: None
            if release is not None:
                release()
                found[path.relative_to(self.root).as_posix()] = bytes_below(path)
        return found

    def drop_leftover(self, uri: str) -> bool:
        """Remove one of `leftovers`; False where a process holds it, or the disk refuses."""
        path = self.root / uri
        with self._locked(self._lock_name(path), wait=False) as held:
            if held and is_cleared(path):
                clear_files(path)
            elif held and (path.suffix == PART_SUFFIX or path.parent.name == "spool"):
                remove_tree(path)
        return held and (is_cleared(path) or not path.exists())

    def _lock_name(self, path: Path) -> str:
        kind = "capture" if path.parent.name == "spool" else path.parent.name
        return f"{kind}-{path.name.removesuffix(PART_SUFFIX)}"

    def size_of(self, uri: str) -> int:
        """Return the present bytes of all files of a store or run, manifest included."""
        return bytes_below(self.root / uri)

    def sizes(self, uris: Iterable[str]) -> dict[str, int]:
        """Return the sizes of stores and runs, as `size_of` counts them, by address."""
        return {uri: self.size_of(uri) for uri in uris}

    def drop_run(self, uri: str) -> None:
        """Remove a damaged run."""
        with refusals(self.root, "remove from the archive"):
            retire(self.root / uri)

    # --- runs and spools ----------------------------------------------------------------------------------------------

    def new_run(self, name: str) -> RunDraft:
        """Create the folder of one run, which `RunDraft.publish` puts below ``runs``."""
        stem = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{run_stem(name)}"
        number = 1
        with refusals(self.root, "write to the archive"):
            draft = self._begin_run(stem)
            while draft is None:  # another run of the same second takes the next number
                number += 1
                draft = self._begin_run(f"{stem}-{number}")
        return draft

    def _begin_run(self, run_id: str) -> RunDraft | None:
        """Lock a new run and create its draft; None where another process holds or has published it."""
        folder = self.root / "runs" / (run_id + PART_SUFFIX)
        release = take_lock(self._lock_path(f"runs-{run_id}"), wait=False)
        if release is None:
            return None
        try:
            if folder.with_name(run_id).exists():
                release()
                return None
            remove_tree(folder)  # of a process that was killed
            folder.mkdir(parents=True)
        except BaseException:
            release()
            raise
        return RunDraft(run_id, folder, self.root, release)

    def runs(self) -> list[Path]:
        """Return the folders of the published runs, oldest first."""
        return published_runs(self.root)

    def run_folder(self, name: str) -> Path:
        """Return the folder of a published run by name, address or ``latest``. Raises NoRunError."""
        folders = self.runs()
        called = name.rstrip("/").removeprefix("runs/")
        folder = next((one for one in reversed(folders) if called in (one.name, LATEST)), None)
        if folder is None:
            known = ", ".join(one.name for one in folders[-5:])
            there = f"has no run {name!r}; its latest are {known}" if folders else "has no run; survey into it first"
            raise NoRunError(f"{self.name} {there}")
        return folder

    def spool_folder(self, key: str) -> Path:
        """Return the folder for the lines of a running capture; unlike a staged store it outlives the process."""
        check_name(key)
        folder = self.root / "spool" / key
        with refusals(self.root, "write to the archive"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def drop_spool(self, key: str) -> None:
        """Remove a spool whose lines are published; a read-only archive keeps it."""
        check_name(key)
        if self.writes:
            self.spooled_bytes += bytes_below(self.root / "spool" / key)
            remove_tree(self.root / "spool" / key)

    def _lock_path(self, name: str) -> Path:
        return self.root / ".locks" / f"{name}.lock"

    @contextmanager
    def _locked(self, name: str, *, wait: bool = True, shared: bool = False) -> Iterator[bool]:
        """Hold a lock while the block runs; yield False where another process holds it and ``wait`` is false."""
        release = take_lock(self._lock_path(name), wait=wait, shared=shared)
        try:
            yield release is not None
        finally:
            if release is not None:
                release()


def run_stem(name: str) -> str:
    """Return a survey's name as it stands in the name of a run's folder, behind the time."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:60] or "run"
