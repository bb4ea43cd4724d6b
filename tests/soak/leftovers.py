"""What gc leaves of an archive after a day of surveys, and what of it cannot be explained."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.maintenance.garbage import clear_up
from storage.remote.opening import verify_archive

Survey = tuple[int, str]  # the seed of a field's scene, and the visit, as the settings have them


@dataclass
class Leftovers:
    """What gc took away, what stayed, and what of it nobody explains."""

    removed: Counter[str]
    kept: Counter[str]
    unexplained: list[str]

    def words(self) -> str:
        """In one line."""
        parts = [
            ", ".join(f"{count} {what}" for what, count in sorted(one.items()) if count) or "nothing"
            for one in (self.removed, self.kept)
        ]
        found = f"; UNEXPLAINED: {'; '.join(self.unexplained[:3])} ({len(self.unexplained)})"
        return f"removed: {parts[0]}; stays: {parts[1]}{found if self.unexplained else '; nothing unexplained'}"


def clear(archive: Archive, failed: Iterable[Survey], spools: Mapping[str, Survey]) -> Leftovers:
    """Run gc and look at what is left that no run names.

    Only what belongs to looks that failed may stay: their raw lines, which cannot be had again, and lines under way.
    ``spools`` says in which look each spool appeared.
    """
    scan_passes = set(failed)
    done = clear_up(archive, keep_days=0)
    found = Leftovers(Counter(one.what for one in done.removals), Counter(), [])
    if done.obstacle:
        found.unexplained.append(done.obstacle)
    _check_stores(archive, scan_passes, done.kept, found)
    for spool in sorted((archive.root / "spool").glob("*")):
        if spools.get(spool.name) in scan_passes:
            found.kept["lines under way of a failed run"] += 1
        else:
            found.unexplained.append(f"spool/{spool.name} of {spools.get(spool.name)}")
    found.unexplained += [str(path.relative_to(archive.root)) for path in archive.root.glob("*/*/*.part")]
    return found


def problems_of(archive: Archive) -> list[str]:
    """What `verify` finds."""
    return [f"{found.uri}: {found.problem}" for found in verify_archive(archive) if found.problem is not None]


def _check_stores(archive: Archive, scan_passes: set[Survey], kept: Mapping[str, str], found: Leftovers) -> None:
    catalogue = Catalogue.read(archive.root)
    named = set[str]().union(*(catalogue.named_and_below[run.uri] for run in catalogue.runs))
    rest = set(catalogue.stores) - named
    raw = set[str]()
    for uri in rest & set(kept):
        params = archive.manifest(catalogue.stores[uri].ref)["params"]
        if (params.get("seed"), params.get("visit")) in scan_passes:
            raw.add(uri)
    below = (catalogue.ancestors(raw) & rest) - raw
    found.kept["raw of a failed run"] += len(raw)
    found.kept["what that rests on"] += len(below)
    found.unexplained += [f"{uri}, which no run names" for uri in sorted(rest - raw - below)]
