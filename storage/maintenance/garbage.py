"""Remove from an archive the stores that no run names or needs, leftovers of dead processes, or damaged stores.

Stores are removed before their inputs, each in one step, so that the archive stays valid wherever this is killed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.archive.archive import Archive
from spectralzoom.storage.archive.keys import StageRef, without_manifest
from spectralzoom.storage.archive.lineage import Catalogue
from spectralzoom.storage.archive.staging import MANIFEST_NAME, refusals
from spectralzoom.storage.maintenance.verification import Finding

DAY_S = 86400.0
_CURE = "restore this folder from a copy, or delete it and with it the stores that only it names"
ONLY_COPY = "damaged, and not simulated: restore it from a copy; --raw-too removes it, to read its source again"
IN_USE = "the archive is in use: run gc again when it is free"


@dataclass(frozen=True)
class Removal:
    """Something that can be removed: its address, kind, size [bytes] and the reason."""

    uri: str
    what: Literal["store", "run", "leftover"]
    size: int
    why: str


@dataclass(frozen=True)
class Clearance:
    """Things that can be removed, in this order."""

    removals: tuple[Removal, ...]
    kept: dict[str, str]  # stores that stay, with the reason
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
    damaged: Sequence[Finding] | None = None,
    dry_run: bool = False,
    progress: Callable[[Removal, float], None] | None = None,
) -> Clearance:
    """Remove what `plan_clearance` finds, except what another process holds; return what was removed.

    With the findings of `verify_everything` as ``damaged``, remove what `plan_removal` finds.
    Raises ArchiveError: the disk refuses.
    """

    def planned() -> Clearance:
        if damaged is not None:
            return plan_removal(archive, damaged, raw_too=raw_too)
        return plan_clearance(archive, keep_days=keep_days, raw_too=raw_too)

    with refusals(archive.root, "clear up the archive"):
        if dry_run:
            return planned()
        with archive.in_use(alone=True) as alone:
            plan = planned()
            if not alone:
                return Clearance((), plan.kept, IN_USE)
            gone: list[Removal] = []
            for number, removal in enumerate(plan.removals):
                if progress is not None:
                    progress(removal, number / len(plan.removals))
                if _remove(archive, removal):  # else another process holds it
                    gone.append(removal)
            for lock in archive.root.glob(".locks/*-*.lock"):  # of stores and runs, which nobody makes meanwhile
                lock.unlink(missing_ok=True)
    return Clearance(tuple(gone), plan.kept, plan.obstacle)


def _remove(archive: Archive, removal: Removal) -> bool:
    if removal.what == "leftover":
        return archive.drop_leftover(removal.uri)
    if removal.what == "run":
        archive.drop_run(removal.uri)
        return True
    path = archive.root / removal.uri
    return archive.discard(StageRef(path.parent.name, path.name, path), wait=False)


def plan_removal(archive: Archive, findings: Sequence[Finding], *, raw_too: bool = False) -> Clearance:
    """Find damaged stores with all that was made of them, and damaged runs; surveys make them again.

    Lines and pixels that cannot be captured again stay unless ``raw_too``.
    """
    catalogue = Catalogue.read(archive.root)
    bad = [one.uri for one in findings if one.kind == "broken"]
    stores = {uri for uri in bad if uri.startswith("stages/")}
    only = set() if raw_too else {uri for uri in catalogue.stores if catalogue.is_only_copy(uri)}
    gone = (stores - only) | (catalogue.descendants(stores - only) - only)
    ordered = [*sorted(gone - set(catalogue.stores)), *reversed(catalogue.inputs_first(gone & set(catalogue.stores)))]
    why = {uri: "it is damaged" if uri in stores else "it was made of a damaged store" for uri in ordered}
    removals = [Removal(uri, "store", archive.size_of(uri), why[uri]) for uri in ordered]
    removals += [Removal(uri, "run", archive.size_of(uri), "it is damaged") for uri in bad if uri.startswith("runs/")]
    return Clearance(tuple(removals), dict.fromkeys(sorted(stores & only), ONLY_COPY), None)


def plan_clearance(archive: Archive, *, keep_days: float = 1.0, raw_too: bool = False) -> Clearance:
    """Find stores that no run names, and leftovers of dead processes.

    Stores younger than ``keep_days`` stay with their inputs: a running survey may name them. ``raw_too`` also takes raw
    lines of a rig that no run names; they cannot be captured again.
    Raises SettingsError: ``keep_days`` is negative or no number.
    """
    if not (math.isfinite(keep_days) and keep_days >= 0):
        raise SettingsError(f"--keep-days {keep_days}: expected a number of days, 0 or more")
    catalogue = Catalogue.read(archive.root)
    named = set[str]().union(*(run.names for run in catalogue.runs))
    spared: dict[str, str] = {}
    now_s = time.time()
    for uri, store in catalogue.stores.items():
        if uri in named:
            continue
        try:
            published_s = (store.ref.path / MANIFEST_NAME).stat().st_mtime  # or copied here
        except FileNotFoundError:
            continue  # another process has removed it
        if now_s - published_s < keep_days * DAY_S:
            spared[uri] = f"no run names it, and it is younger than {keep_days:g} days"
        elif not raw_too and catalogue.is_only_copy(uri):
            spared[uri] = "no run names it, and it has raw lines that cannot be had again; --raw-too removes them"
    below = catalogue.ancestors(spared) & set(catalogue.stores) - named
    kept = dict.fromkeys(below, "an input of a store that stays") | spared
    obstacle = _obstacle(archive, catalogue, kept)
    gone = [] if obstacle else [uri for uri in catalogue.stores if uri not in named and uri not in kept]
    removals = [
        Removal(uri, "store", archive.size_of(uri), "no run names it") for uri in reversed(catalogue.inputs_first(gone))
    ]
    left = [Removal(uri, "leftover", size, "its process has ended") for uri, size in archive.leftovers().items()]
    return Clearance((*removals, *left), kept, obstacle)


def _obstacle(archive: Archive, catalogue: Catalogue, kept: Iterable[str]) -> str | None:
    """Return why no store may be removed: a damaged manifest may name stores to keep; else None."""
    for path in without_manifest(archive.root):
        if path.parent.name == "runs" and path.is_dir():
            return f"no store is removed: runs/{path.name} has lost its {MANIFEST_NAME}; {_CURE}"
    for run in catalogue.runs:
        if run.problem is not None and not run.names:
            return f"no store is removed: the stores of {run.uri} are not known ({run.problem}); {_CURE}"
    for uri in sorted(kept):
        if (problem := catalogue.stores[uri].problem) is not None:
            return f"no store is removed: the inputs of {uri} are not known ({problem}); run gc --damaged"
    return None
