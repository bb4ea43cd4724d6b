"""Remove from an archive the stores that no run names or needs, and leftovers of dead processes.

Stores are removed before their inputs, each in one step, so that the archive stays valid wherever this is killed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from pipeline.errors import SettingsError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, without_manifest
from storage.archive.lineage import Catalogue
from storage.archive.records import Store
from storage.archive.staging import (
    MANIFEST_NAME,
    PART_SUFFIX,
    bytes_below,
    check_name,
    refusals,
    remove_tree,
    take_lock,
)

DAY_S = 86400.0
IN_USE = "the archive is in use: run gc again when it is free"
What = Literal[
    "store", "files", "spool", "unfinished", "upload"
]  # files: raw lines that the setting `keep` of a run does not keep


@dataclass(frozen=True)
class Removal:
    """Something that can be removed: its address, kind, size [bytes] and the reason."""

    uri: str
    what: What
    size: int
    why: str


@dataclass(frozen=True)
class Clearance:
    """Things that can be removed, in this order."""

    removals: tuple[Removal, ...]
    kept: dict[str, str]  # stores that no run names and that stay, with the reason
    obstacle: str | None  # why no store is removed

    @property
    def size(self) -> int:
        """Bytes of all removals."""
        return sum(removal.size for removal in self.removals)


def clear_up(
    archive: Archive,
    *,
    keep_days: float = 1.0,
    raw_too: bool = False,
    dry_run: bool = False,
    progress: Callable[[Removal, float], None] | None = None,
) -> Clearance:
    """Remove what `plan_clearance` finds, except what another process holds; return what was removed.

    Raises ArchiveError: the disk refuses.
    """

    def plan_now() -> Clearance:
        return plan_clearance(archive, keep_days=keep_days, raw_too=raw_too)

    if dry_run:
        with refusals(archive.root, "clear up the archive"):
            return plan_now()
    with archive.in_use(alone=True) as alone, refusals(archive.root, "clear up the archive"):
        plan = plan_now()
        obstacle = plan.obstacle if alone else IN_USE
        gone: list[Removal] = []
        for number, removal in enumerate(plan.removals):
            if progress is not None:
                progress(removal, number / len(plan.removals))
            in_archive = removal.what == "store"
            held = (in_archive and obstacle is not None) or (removal.what == "upload" and not alone)
            if not held and _remove(archive, removal):
                gone.append(removal)
    return Clearance(tuple(gone), plan.kept, obstacle)


def plan_clearance(archive: Archive, *, keep_days: float = 1.0, raw_too: bool = False) -> Clearance:
    """Find stores that no run names, spools of published captures, and leftovers of dead processes.

    Stores younger than ``keep_days`` stay with their inputs: a running survey may name them. ``raw_too`` also takes raw
    lines of a rig or ingested ones that no run names; they cannot be captured again.
    Raises SettingsError: ``keep_days`` is negative or no number.
    """
    if not (math.isfinite(keep_days) and keep_days >= 0):
        raise SettingsError(f"--keep-days {keep_days}: expected a number of days, 0 or more")
    catalogue = Catalogue.read(archive.root)
    named = set[str]().union(*(run.names for run in catalogue.runs))
    spared = _spared(catalogue, named, keep_days, raw_too, archive.now())
    below = catalogue.ancestors(spared) & set(catalogue.stores) - named
    kept = dict.fromkeys(below, "an input of a store that stays") | spared
    obstacle = _obstacle(archive, catalogue, kept)
    gone = [] if obstacle else [uri for uri in catalogue.stores if uri not in named and uri not in kept]
    removals = [
        Removal(uri, "store", archive.size_of(uri), "no run names it") for uri in reversed(catalogue.inputs_first(gone))
    ]
    uploads = [
        Removal(uri, "upload", size, "it was never published") for uri, size in archive.leftovers(keep_days).items()
    ]
    published = {store.ref.key for store in catalogue.stores.values() if store.problem is None}
    spools = [
        Removal(f"spool/{path.name}", "spool", bytes_below(path), "its lines are published")
        for path in sorted((archive.root / "spool").glob("*"))
        if path.name in published
    ]
    return Clearance((*removals, *uploads, *spools, *_unfinished(archive.root)), kept, obstacle)


def _spared(catalogue: Catalogue, named: set[str], keep_days: float, raw_too: bool, now: datetime) -> dict[str, str]:
    """Return the stores that no run names and that stay, with the reason."""
    kept: dict[str, str] = {}
    for uri, store in catalogue.stores.items():
        if uri in named:
            continue
        if _age_days(store, now) < keep_days:
            kept[uri] = f"younger than {keep_days:g} days"
        elif not raw_too and catalogue.is_only_copy(uri):
            kept[uri] = "raw lines that cannot be had again; --raw-too removes them"
    return kept


def _age_days(store: Store, now: datetime) -> float:
    """Return the days since a store was published, or copied here."""
    return (now.timestamp() - (store.ref.path / MANIFEST_NAME).stat().st_mtime) / DAY_S


def _obstacle(archive: Archive, catalogue: Catalogue, kept: Iterable[str]) -> str | None:
    """Return why no store may be removed: a damaged manifest may name stores to keep; else None."""
    for path in without_manifest(archive.root):
        if path.parent.name == "runs" and path.is_dir():
            return f"no store is removed: runs/{path.name} has lost its {MANIFEST_NAME}; its stores are not known"
    for run in catalogue.runs:
        if run.problem is not None and not run.names:
            return f"no store is removed: the stores of {run.uri} are not known ({run.problem})"
    for uri in sorted(kept):
        if (problem := catalogue.stores[uri].problem) is not None:
            return f"no store is removed: the inputs of {uri} are not known ({problem}); run verify --repair"
    return None


def _unfinished(root: Path) -> list[Removal]:
    parts = {*root.glob(f"stages/*/*{PART_SUFFIX}"), *root.glob(f"runs/*{PART_SUFFIX}")}
    found: list[Removal] = []
    for path in sorted(parts):
        uri, free = path.relative_to(root).as_posix(), True
        if (lock := _lock_of(root, uri, "unfinished")).exists():
            release = take_lock(lock, wait=False)
            if free := release is not None:
                release()
        if free:
            found.append(Removal(uri, "unfinished", bytes_below(path), "its process has ended"))
    return found


def _lock_of(root: Path, uri: str, what: What) -> Path:
    path = Path(uri)
    name = f"capture-{path.name}" if what == "spool" else f"{path.parent.name}-{path.stem}"
    return root / ".locks" / f"{name}.lock"


def _remove(archive: Archive, removal: Removal) -> bool:
    """Remove one thing; False where another process holds it."""
    path = archive.root / removal.uri
    if removal.what == "store":
        return archive.discard(StageRef(path.parent.name, path.name, path), wait=False, unnamed=True)
    if removal.what == "upload":
        archive.drop_leftover(removal.uri)
        return True
    if removal.what == "spool":
        check_name(path.name)
    release = take_lock(_lock_of(archive.root, removal.uri, removal.what), wait=False)
    if release is None:
        return False
    try:
        remove_tree(path)
    finally:
        release()
    return not path.exists()  # the disk may have refused
