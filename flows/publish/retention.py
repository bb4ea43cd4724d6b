"""Clear the raw lines that no run keeps any longer, after comparing them with their condensed signal.

The setting ``keep`` of a run is the time for which its raw lines stay. Lines of several runs stay as long as one keeps
them. A killed process leaves each store complete or cleared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime

from flows.settings.values import parse_keep, raw_days
from flows.tasks.stages.condense import SIGNAL, SIGNAL_FINE, raw_differs
from pipeline.errors import IncompleteStoreError
from pipeline.geometry.camera import LineCamera
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.records import LINE_PRODUCTS, Run, Store, moment_of
from storage.maintenance.garbage import DAY_S, IN_USE, Removal

PRESENT = {one.name: str(one.version) for one in (SIGNAL, SIGNAL_FINE)}


@dataclass
class RawClearance:
    """Raw lines that were cleared, expired ones that stay with the reason, and why none is cleared."""

    removals: list[Removal] = field(default_factory=list)
    kept: dict[str, str] = field(default_factory=dict)
    obstacle: str | None = None


@dataclass(frozen=True)
class OutlivedLines:
    """Expired raw lines, the store condensed from them, the reason, and what keeps them all the same."""

    raw: Store
    signal: Store
    why: str
    stay: str | None


def clear_raw_lines(
    archive: Archive, *, dry_run: bool = False, progress: Callable[[str, float], None] | None = None
) -> RawClearance:
    """Clear the raw lines that have expired for every run that names them.

    Every line is compared first; lines that differ or cannot be read stay. With ``dry_run`` nothing is compared or
    removed. Raises ArchiveError: the disk refuses.
    """
    archive.refresh()
    expired = list(outlived_lines(Catalogue.read(archive.root), archive.now()))
    found = [one for one in expired if one.stay is None]
    done = RawClearance(kept={one.raw.ref.uri: one.stay for one in expired if one.stay is not None})
    if dry_run:
        return replace(done, removals=[_removal(one) for one in found])
    with archive.in_use(alone=True) as alone:
        if not alone:
            return replace(done, obstacle=IN_USE if found else None)
        for number, one in enumerate(found):
            if progress is not None:
                progress(one.raw.ref.uri, number / len(found))
            raw, signal = (archive.ref(store.ref.stage, store.ref.key) for store in (one.raw, one.signal))
            try:
                others = [archive.find(raw.stage, key) for key in one.signal.inputs if key != raw.key]
            except IncompleteStoreError as error:
                done.kept[raw.uri] = str(error)
                continue
            passes = [raw, *(other for other in others if other is not None)]
            why = raw_differs(passes, signal, LineCamera(**one.signal.params["camera"]))
            if why is not None:
                done.kept[raw.uri] = why
            elif archive.clear(raw, wait=False):
                done.removals.append(_removal(one))
    return done


def outlived_lines(catalogue: Catalogue, now: datetime) -> Iterator[OutlivedLines]:
    """Yield the condensed raw lines of published runs that no run keeps any longer."""
    found = set[str]()
    for run in catalogue.runs:
        for names in reversed(LINE_PRODUCTS.items()):  # fine pass first: its comparison needs the coarse one
            raw, signal = (_whole(catalogue, run, name) for name in names)
            if raw is None or signal is None or raw.ref.uri in found:
                continue
            runs = catalogue.named_by(raw.ref.uri)
            if raw.ref.uri in catalogue.inputs_of(signal.ref.uri) and all(is_outlived(one, now) for one in runs):
                found.add(raw.ref.uri)
                keeps = sorted({str(one.settings["keep"]) for one in runs})
                stage = signal.ref.stage
                present = PRESENT.get(stage)
                old = f"they were condensed by version {signal.version} of {stage}, now {present}: run reprocess"
                stay = None if present == signal.version else old
                yield OutlivedLines(raw, signal, f"keep = {', '.join(keeps)}, and they were condensed", stay)


def _whole(catalogue: Catalogue, run: Run, product: str) -> Store | None:
    """Return the store of a product; None where it is missing, damaged or cleared."""
    store = catalogue.stores.get(run.products.get(product, ""))
    return None if store is None or store.problem is not None or store.cleared else store


def is_outlived(run: Run, now: datetime) -> bool:
    """Return whether the raw lines of a run have expired; False where that is not known."""
    made = moment_of(run.created)
    try:
        days = raw_days(parse_keep(run.settings["keep"]))
    except (KeyError, ValueError):
        return False
    return run.problem is None and made is not None and (days <= 0 or (now - made).total_seconds() >= days * DAY_S)


def _removal(one: OutlivedLines) -> Removal:
    return Removal(one.raw.ref.uri, "files", one.raw.size, one.why)
