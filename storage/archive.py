"""The archive: immutable stores, one for each stage and key, and one folder for each run.

::

    stages/<stage>/<key>/     what a stage made, with manifest.json
    runs/<run id>/            receipt.json, report.html, quicklook.png
    spool/<key>/              lines of a capture under way
    .locks/                   held while something is made

A folder whose name ends in ``.part`` is not finished: whoever makes the same thing next removes it.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.keys import plain, stage_key
from storage.run_folders import RunDraft
from storage.staging import (
    MANIFEST_NAME,
    PART_SUFFIX,
    check_files,
    check_name,
    read_manifest,
    refusals,
    remove_tree,
    rename_into_place,
    take_lock,
    write_manifest,
)

__all__ = ["Archive", "Finding", "RunDraft", "StageRef", "StagedStore", "stage_key"]


@dataclass(frozen=True)
class StageRef:
    """Address of one published store: what tasks hand to each other instead of arrays."""

    stage: str
    key: str
    path: Path

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"stages/{self.stage}/{self.key}"


@dataclass(frozen=True)
class StagedStore:
    """A store being made. ``done`` says that another run published it while this one waited: nothing is to be made."""

    path: Path  # folder to write into
    ref: StageRef
    done: bool


@dataclass(frozen=True)
class Finding:
    """What ``verify`` says of one store or run; ``problem`` is None where every byte is as published."""

    uri: str
    problem: str | None


class Archive:
    """A folder of immutable stores. Kill the process anywhere: what has a final name is whole."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @classmethod
    def open(cls, root: str | Path, *, create: bool = True, write: bool = True) -> Archive:
        """Open an archive, or make it where ``create``.

        Raises
        ------
        ArchiveError : the path is a file, is not there, or does not let itself be written to (``write``).
        """
        path = Path(root).absolute()
        with _any_refusal(path), refusals(path, "use the archive"):
            if path.exists() and not path.is_dir():
                raise ArchiveError(f"{path} is a file, expected a folder for the archive; choose another --out")
            if not create and not (path / "stages").is_dir():
                state = "is a folder but no archive (it has no folder stages)" if path.is_dir() else "is not there"
                raise ArchiveError(f"{path} {state}; check the name, or make an archive with survey --out")
            _make_and_probe(path, create=create, write=write)
            if not os.access(path, os.R_OK | os.X_OK):
                raise ArchiveError(f"cannot read the archive {path}: permission is denied; change the folder's rights")
        return cls(path)

    # --- stages -------------------------------------------------------------------------------------------------------

    def find(self, stage: str, key: str) -> StageRef | None:
        """The published store, or None. Sizes are compared with the manifest, content only by :meth:`verify`.

        Raises
        ------
        IncompleteStoreError : it is there, but a file is missing or has another size.
        """
        ref = self._ref(stage, key)
        if not (ref.path / MANIFEST_NAME).is_file():
            return None
        check_files(ref.path, hashes=False)
        return ref

    @contextmanager
    def publish(
        self,
        stage: str,
        key: str,
        *,
        version: int | str = 1,
        params: Mapping[str, Any] | None = None,
        inputs: Sequence[str] | Mapping[str, str] = (),
    ) -> Iterator[StagedStore]:
        """Give a folder to write into, and publish it when the block ends well.

        One process at a time makes a key; the others wait and then find ``done``. When the block fails, the folder
        is removed and the archive is as before.

        Raises
        ------
        ArchiveError : the disk refuses; the message names the path and what to do.
        """
        ref = self._ref(stage, key)
        facts = {"stage": stage, "key": key, "version": version, "params": plain(params or {}), "inputs": plain(inputs)}
        with refusals(self.root, "write to the archive"), self._locked(f"{stage}-{key}"):
            done = self.find(stage, key) is not None
            part = ref.path.with_name(key + PART_SUFFIX)
            remove_tree(part)
            part.mkdir(parents=True)
            try:
                yield StagedStore(part, ref, done)
                if not done:
                    write_manifest(part, facts)
                    _retire(ref.path)
                    rename_into_place(part, ref.path)
            finally:
                remove_tree(part)

    def produce(
        self,
        stage: str,
        build: Callable[[Path], None],
        *,
        version: int | str,
        params: Mapping[str, Any],
        inputs: Sequence[str] | Mapping[str, str] = (),
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
        """What is known of a store: stage, key, version, params, inputs, created, libraries, files."""
        return read_manifest(ref.path)

    def stored_bytes(self, ref: StageRef) -> int:
        """Size of a store's files by its manifest."""
        return sum(int(entry["size"]) for entry in self.manifest(ref)["files"].values())

    def refs(self, stage: str | None = None) -> list[StageRef]:
        """Every published store (of one stage), by stage and key."""
        folders = sorted((self.root / "stages").glob(f"{stage or '*'}/*/{MANIFEST_NAME}"))
        found = [folder.parent for folder in folders if not folder.parent.name.endswith(PART_SUFFIX)]
        return [StageRef(path.parent.name, path.name, path) for path in found]

    def discard(self, ref: StageRef) -> None:
        """Take one store away, for good; a key that is asked for again is made again."""
        with refusals(self.root, "remove from the archive"), self._locked(f"{ref.stage}-{ref.key}"):
            _retire(ref.path)

    # --- verification and clearing up ---------------------------------------------------------------------------------

    def verify(self, ref: StageRef) -> None:
        """Read every byte of one store again.

        Raises
        ------
        IncompleteStoreError : names the first file that is missing, changed or not listed.
        """
        check_files(ref.path, hashes=True)

    def verify_all(self) -> list[Finding]:
        """Check every store and every run."""
        runs = [(f"runs/{path.name}", path) for path in self.runs()]
        stores = [(ref.uri, ref.path) for ref in self.refs()]
        return [Finding(uri, _problem(path)) for uri, path in (*stores, *runs)]

    def reclaim(self) -> list[str]:
        """Remove unfinished folders that no living process works on; gives their addresses."""
        removed: list[str] = []
        with refusals(self.root, "clear up the archive"):
            for part in sorted((*self.root.glob(f"stages/*/*{PART_SUFFIX}"), *self.root.glob(f"runs/*{PART_SUFFIX}"))):
                release = take_lock(self._lock_path(f"{part.parent.name}-{part.stem}"), wait=False)
                if release is not None:
                    remove_tree(part)
                    removed.append(part.relative_to(self.root).as_posix())
                    release()
        return removed

    # --- runs and spools ----------------------------------------------------------------------------------------------

    def new_run(self, name: str) -> RunDraft:
        """Begin the folder of one run; nothing of it is seen under ``runs`` before :meth:`RunDraft.publish`."""
        clean = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:60] or "run"
        stem = f"{datetime.now(UTC):%Y%m%dT%H%M%S}-{clean}"
        run_id, number = stem, 1
        with refusals(self.root, "write to the archive"):
            while (draft := self._begin_run(run_id)) is None:  # another run of the same second takes the next number
                number += 1
                run_id = f"{stem}-{number}"
        return draft

    def _begin_run(self, run_id: str) -> RunDraft | None:
        """Take a run's name and make its folder, empty; None where the name is taken."""
        folder = self.root / "runs" / (run_id + PART_SUFFIX)
        release = take_lock(self._lock_path(f"runs-{run_id}"), wait=False)
        if release is None:
            return None
        try:
            if folder.with_name(run_id).exists():
                release()
                return None
            remove_tree(folder)  # of a run that was killed within this second
            folder.mkdir(parents=True)
        except OSError:
            release()
            raise
        return RunDraft(run_id, folder, self.root, release)

    def runs(self) -> list[Path]:
        """Folders of the published runs, oldest first."""
        found = sorted(path.parent for path in (self.root / "runs").glob(f"*/{MANIFEST_NAME}"))
        return [path for path in found if not path.name.endswith(PART_SUFFIX)]

    def spool_folder(self, key: str) -> Path:
        """Folder for the lines of a capture under way; it outlives the process, unlike a staged store."""
        check_name(key)
        folder = self.root / "spool" / key
        with refusals(self.root, "write to the archive"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def drop_spool(self, key: str) -> None:
        """Remove a spool whose lines are published."""
        check_name(key)
        remove_tree(self.root / "spool" / key)

    def _ref(self, stage: str, key: str) -> StageRef:
        check_name(stage)
        check_name(key)
        return StageRef(stage, key, self.root / "stages" / stage / key)

    def _lock_path(self, name: str) -> Path:
        return self.root / ".locks" / f"{name}.lock"

    @contextmanager
    def _locked(self, name: str) -> Iterator[None]:
        release = take_lock(self._lock_path(name))
        try:
            yield
        finally:
            if release is not None:
                release()


@contextmanager
def _any_refusal(path: Path) -> Iterator[None]:
    """At the door whatever the system answers means that this is no place for an archive."""
    try:
        yield
    except ArchiveError:
        raise
    except OSError as error:
        raise ArchiveError(f"cannot use {path} as an archive: {error.strerror}; choose another --out") from error


def _make_and_probe(path: Path, *, create: bool, write: bool) -> None:
    try:
        if create:
            (path / "stages").mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise ArchiveError(
            f"{error.filename} is or lies below a file, expected a folder; choose another --out"
        ) from error
    if write:
        _probe(path)


def _probe(path: Path) -> None:
    """Write and remove a small file: rights alone do not tell of a read-only or full disk."""
    probe = path / f".probe-{os.getpid()}-{secrets.token_hex(4)}"
    try:
        probe.write_bytes(b"written to see whether this can be written to")
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)


def _retire(path: Path) -> None:
    """Take a folder away in one step: first its name, then its files."""
    if path.exists():
        away = path.with_name(f"{path.name}-{secrets.token_hex(4)}{PART_SUFFIX}")
        path.rename(away)
        remove_tree(away)


def _problem(path: Path) -> str | None:
    try:
        check_files(path, hashes=True)
    except (IncompleteStoreError, OSError) as error:
        return str(error)
    return None
