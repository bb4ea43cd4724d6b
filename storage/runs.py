"""Read the runs of an archive with their receipts, verify every byte, and clear up.

A damaged manifest, or a receipt with a value that is not valid, gives a record with a ``problem``. Stores are
removed before their inputs, each in one step, so that the archive stays valid wherever this is killed.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

from spectralzoom.pipeline.errors import ArchiveError, NoRunError, SettingsError, list_some
from spectralzoom.pipeline.words import is_name, moment_of
from spectralzoom.storage.receipts import receipt_problem
from spectralzoom.storage.store import (
    CAPTURED,
    LATEST,
    RESTS_ON,
    Archive,
    ancestors,
    conflicts,
    descendants,
    digest_of,
    file_problem,
    inputs_first,
    is_known,
    lies_ahead,
    listed_bytes,
    manifest_path,
    problems_of,
    try_manifest,
    uri_of,
)
from spectralzoom.storage.whole_files import entries, read_own, refusals

RECEIPT = "receipt.json"
_WITH_TIME = re.compile(r"\s*[\dW-]+[^\d-]\d\d")  # a date and an hour, in ISO 8601
LINE_PRODUCTS = {"raw_coarse": "signal_coarse", "raw_fine": "signal_fine"}  # of a run: raw lines, and condensed ones
LINES = re.compile(rf"stages/({CAPTURED}|condense(_fine)?)/.*")
DAY_S = 86400.0
ONLY_COPY = "damaged, and not simulated: restore it from a copy; --raw-too removes it, to read its source again"
IN_USE = "the archive is in use: run gc again when it is free"


def dated(*texts: str | None) -> str | None:
    """Return the first text that begins with a day or moment, as `moment_of` reads it; None without one."""
    return next((text for text in texts if moment_of(text) is not None), None)


def has_time(text: object) -> bool:
    """Return whether a text begins with a day and a time of it."""
    return _WITH_TIME.match(str(text)) is not None


@dataclass(frozen=True)
class Run:
    """One run; a damaged ``receipt`` is empty."""

    folder: Path
    facts: Mapping[str, Any]  # of its manifest
    receipt: Mapping[str, Any]
    problem: str | None

    @property
    def uri(self) -> str:
        """Address relative to the archive."""
        return f"runs/{self.folder.name}"

    @cached_property
    def names(self) -> frozenset[str]:
        """Return the addresses of its stores and of all their inputs; empty where its manifest is damaged."""
        return frozenset(self.facts[RESTS_ON])

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings of the survey, from the receipt or else, rounded, from the manifest."""
        return dict(self.receipt.get("settings") or self.facts["settings"])

    @property
    def products(self) -> dict[str, str]:
        """Names and addresses of its products."""
        return dict(self.receipt.get("products") or {})

    @property
    def stages(self) -> list[dict[str, Any]]:
        """Its stages, each with name, key, state and costs."""
        return list(self.receipt.get("stages") or ())

    @property
    def acquired(self) -> str | None:
        """Return the day or moment of its visit, else that of acquisition by its file; None if neither is known."""
        return dated(self.settings.get("visit"), self.receipt.get("acquired"))

    @property
    def created(self) -> str:
        """When it was published, ISO 8601 in UTC."""
        return str(self.facts["created"] or self.receipt.get("finished", ""))

    @property
    def in_future(self) -> bool:
        """Return whether it was published later than now, by a clock that is or was wrong."""
        return lies_ahead(self.folder.name, self.created)


def read_run(folder: Path, digests: Callable[[Path], str | None] = digest_of) -> Run:
    """Return one run by its manifest and receipt, damaged or not; ``digests`` has those of the stores beside it."""
    facts, problem = try_manifest(folder)
    receipt: Any = {}
    if RECEIPT in facts["files"]:
        found = file_problem(folder / RECEIPT, *facts["files"][RECEIPT])
        problem = f"{RECEIPT} {found}" if found else None
        try:
            receipt = {} if problem else json.loads(read_own(folder / RECEIPT))
            if wrong := receipt_problem(receipt):
                receipt, problem = {}, f"{RECEIPT}: {wrong}"
        except (OSError, ValueError, RecursionError) as error:
            receipt, problem = {}, f"{RECEIPT} cannot be read: {error}"
    root = folder.parents[1]
    problem = problem or next(iter(conflicts(facts, lambda uri: digests(root / uri), str(root))), None)
    return Run(folder, facts, receipt, problem)


class Catalogue(NamedTuple):
    """All manifests of stores by address, and all runs, oldest first."""

    stores: dict[str, dict[str, Any]]
    runs: list[Run]

    @classmethod
    def read(cls, archive: Archive) -> Catalogue:
        """Read every manifest and receipt of an archive once; damaged ones have a ``problem``."""
        stores = {uri: one for uri, one in archive.manifests().items() if uri.startswith("stages/")}
        digests = cache(digest_of)
        read = (read_run(folder, digests) for folder in archive.runs())
        runs = [run for run in read if run.problem is None or run.folder.exists()]
        return cls(stores, sorted(runs, key=lambda run: (run.created, run.folder.name)))

    def named_by(self, uri: str) -> list[Run]:
        """Return the runs that rest on a store."""
        return [run for run in self.runs if uri in run.names]

    def called(self, uri: str) -> set[str]:
        """Return the names that runs give the stage of a store, such as capture_fine."""
        rows = [row for run in self.runs for row in run.stages]
        return {str(row.get("name")) for row in rows if row.get("key") == uri.rpartition("/")[2]}


def find_product(catalogue: Catalogue, text: str) -> str | Run:
    """Return the address of a store that is there, or a run.

    Raises NoRunError: nothing has this name; ArchiveError: more than one product has it, or it is not allowed.
    """
    text = text.rstrip("/")
    parts = text.split("/")
    if not all(map(is_name, parts)):
        raise ArchiveError(f"{text!r} cannot be a name in an archive; use letters, digits, '_', '-' and '.'")
    name = parts[1] if parts[0] == "runs" and len(parts) > 1 else text
    if runs := [run for run in catalogue.runs if name == run.folder.name]:
        return runs[-1]
    past = [run for run in catalogue.runs if not lies_ahead(run.folder.name, run.created, warns=True)]
    if past and name == LATEST:
        return past[-1]
    if name != text:
        there = [run.uri for run in reversed(catalogue.runs)]
        raise NoRunError(f"there is no run {name} in this archive; there is {list_some(there, 3) or 'none'}")
    newest = next((run for run in reversed(past) if run.products), None)
    products = {} if newest is None else newest.products
    address = products.get(text, text)
    if newest is not None and address.startswith("runs/"):
        return newest
    wanted = uri_of(address) or f"stages/{address}"
    found = [uri for uri in catalogue.stores if uri.startswith(wanted) or uri.rpartition("/")[2].startswith(address)]
    if wanted in found or len(found) == 1:
        return wanted if wanted in found else found[0]
    if found:
        raise ArchiveError(f"{text} begins {len(found)} stores: {list_some(found, 3)}; give more of it")
    if newest is not None and text in products:
        raise ArchiveError(f"the {text} of {newest.uri} lacks its store {wanted}; survey again to make it")
    known = ", ".join(products) or list_some(sorted(catalogue.stores), 3) or "nothing in it"
    raise NoRunError(f"{text!r} is no product, store or run of this archive; there is {known}")


def _runs_of(known: Iterable[str]) -> list[str]:
    return [uri for uri in known if uri.startswith("runs/")]


# --- verification -----------------------------------------------------------------------------------------------------


class Finding(NamedTuple):
    """Finding on one store or run; ``problem`` is None where every byte is as published.

    ``missing``: a run or store names a store that is not there. ``stray``: something that is no part of an archive.
    """

    uri: str
    problem: str | None
    kind: Literal["whole", "broken", "missing", "stray"] = "whole"


def verify_everything(
    archive: Archive, progress: Callable[[str, float], None] = lambda uri, done: None
) -> list[Finding]:
    """Read every byte again; return a finding for each store and run without damage, and for each problem.

    ``progress`` gets the address being read, and the fraction of all bytes.
    """
    known = archive.manifests()
    total, done = sum(map(listed_bytes, known.values())) or 1, 0
    needed = {one: (uri, "was made of it") for uri, manifest in known.items() for one in manifest["inputs"]}
    named = {one: (uri, "names it") for uri in _runs_of(known) for one in known[uri][RESTS_ON]}
    found: list[Finding] = []
    for uri, manifest in known.items():
        progress(uri, done / total)
        done += listed_bytes(manifest)
        with refusals(archive.root, "read the archive", every=True):
            problems = list(problems_of(archive.root / uri, every_byte=True))
            if not problems and uri.startswith("runs/"):
                problems += filter(None, [read_run(archive.root / uri).problem])
        if is_known(archive.root / uri) or uri in named:  # else gc has removed it since
            found += [Finding(uri, problem, "broken") for problem in problems] or [Finding(uri, None)]
    what = "expected a folder with a manifest; take it out of the archive"
    found += [Finding(one.relative_to(archive.root).as_posix(), what, "stray") for one in archive.strays()]
    for uri, (by, why) in sorted((needed | named).items()):
        if uri not in known and is_known(archive.root / by):  # else gc has removed both since
            found.append(Finding(uri, f"is not there, but {by} {why}", "missing"))
    return found


# --- clearing up ------------------------------------------------------------------------------------------------------


class Removal(NamedTuple):
    """Something that can be removed: its address, kind, size [bytes] and the reason."""

    uri: str
    what: Literal["store", "run", "leftover"]
    size: int
    why: str


class Clearance(NamedTuple):
    """Things that can be removed, in this order; stores that stay, with the reason; why no store is removed."""

    removals: list[Removal]
    kept: dict[str, str]
    obstacle: str | None

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
    progress: Callable[[Removal, float], None] = lambda removal, done: None,
) -> Clearance:
    """Remove stores that no run names, and leftovers; return what was removed.

    With findings of `verify_everything` as ``damaged``, remove damaged stores with all that was made of them, and
    damaged runs; surveys make them again. Lines and pixels that cannot be captured again stay unless ``raw_too``.
    Raises ArchiveError: the disk refuses; SettingsError: ``keep_days`` is negative or no number.
    """
    if not (math.isfinite(keep_days) and keep_days >= 0):
        raise SettingsError(f"--keep-days {keep_days}: expected a number of days, 0 or more")
    with refusals(archive.root, "clear up the archive", every=True), ExitStack() as held:
        alone = dry_run or held.enter_context(archive.in_use(alone=True))
        plan = _damaged(archive, damaged, raw_too) if damaged is not None else _unnamed(archive, keep_days, raw_too)
        if dry_run or not alone:
            return plan if dry_run else Clearance([], plan.kept, IN_USE)
        gone: list[Removal] = []
        for number, removal in enumerate(plan.removals):
            progress(removal, number / len(plan.removals))
            gone += [removal] if archive.discard(removal.uri) else []  # else another process holds it
        for lock in entries(archive.root / ".locks"):
            if "-" in lock.name:  # of stores and runs, which nothing makes meanwhile
                lock.unlink(missing_ok=True)
    return plan._replace(removals=gone)


def _damaged(archive: Archive, findings: Sequence[Finding], raw_too: bool) -> Clearance:
    """Plan the removal of damaged stores and runs."""
    known = archive.manifests()
    bad = [one.uri for one in findings if one.kind == "broken" and one.uri in known]
    only = {uri for uri in known if not raw_too and is_only_copy(known, uri)}
    stores = [uri for uri in bad if uri.startswith("stages/")]
    first = [uri for uri in stores if uri not in only]
    below = [uri for uri in descendants(known, first) if uri not in only]
    ordered = [*reversed(below), *(uri for uri in reversed(inputs_first(known, first)) if uri not in below)]
    why = {uri: "it is damaged" if uri in stores else "it was made of a damaged store" for uri in ordered}
    removals = [Removal(uri, "store", archive.size_of(uri), why[uri]) for uri in ordered]
    removals += [Removal(uri, "run", archive.size_of(uri), "it is damaged") for uri in bad if uri.startswith("runs/")]
    return Clearance(removals, {uri: ONLY_COPY for uri in stores if uri in only}, None)


def _unnamed(archive: Archive, keep_days: float, raw_too: bool) -> Clearance:
    """Plan the removal of stores that no run names, and of leftovers; young stores stay with their inputs."""
    known = archive.manifests()
    named = {one for uri in _runs_of(known) for one in known[uri][RESTS_ON]}
    spared: dict[str, str] = {}
    for uri in known:
        if uri in named or uri.startswith("runs/"):
            continue
        with suppress(FileNotFoundError):  # published or copied here at this time
            age_s = time.time() - manifest_path(archive.root / uri).stat().st_mtime
            if age_s < keep_days * DAY_S:
                spared[uri] = f"no run names it, and it is younger than {keep_days:g} days"
            elif not raw_too and is_only_copy(known, uri):
                spared[uri] = "no run names it, and it has raw lines that cannot be had again; --raw-too removes them"
    below = {uri for uri in ancestors(known, spared) if uri in known and uri not in named}
    kept = dict.fromkeys(below, "an input of a store that stays") | spared
    obstacle = next((why for uri in known if (why := _obstacle(uri, known[uri]["problem"], uri in kept))), None)
    gone = [uri for uri in known if uri.startswith("stages/") and not {uri} & (named | kept.keys())]
    removals = [
        Removal(uri, "store", archive.size_of(uri), "no run names it")
        for uri in reversed(inputs_first(known, () if obstacle else gone))
    ]
    removals += [Removal(uri, "leftover", archive.size_of(uri), "its process has ended") for uri in archive.leftovers()]
    return Clearance(removals, kept, obstacle)


def _obstacle(uri: str, problem: str | None, is_kept: bool) -> str | None:
    """Return why no store may be removed: a damaged manifest may name stores to keep; else None."""
    if problem is not None and uri.startswith("runs/"):
        return (
            f"no store is removed: the stores of {uri} are not known ({problem}); restore this folder from a copy, or "
            "delete it and with it the stores that only it names"
        )
    if problem is not None and is_kept:
        return f"no store is removed: the inputs of {uri} are not known ({problem}); run gc --damaged"
    return None


def is_only_copy(known: Mapping[str, Mapping[str, Any]], uri: str, seen: tuple[str, ...] = ()) -> bool:
    """Return whether the archive alone cannot make a store again: lines and pixels that were not simulated.

    So is a store that was made of such lines, if they were cleared away or are missing. The runs
    that name a damaged or missing store say whether its lines were simulated, and which they were.
    """
    stage, store = uri.split("/")[1], known.get(uri)
    runs = [one for one in known.values() if uri in one[RESTS_ON] and one["settings"]]
    sources = {one["settings"].get("source") for one in runs}
    inputs: Sequence[str] = ()
    if store is not None and store["problem"] is None:
        inputs = store["inputs"]
        is_only = _source_in(store["params"]) != "sim" if stage == CAPTURED else stage == "rectify" and not inputs
    elif LINES.fullmatch(uri):
        inputs = [name for one in runs for name in one[RESTS_ON] if name.startswith(f"stages/{CAPTURED}/")]
        is_only = sources != {"sim"} and (stage == CAPTURED or not inputs)
    else:
        is_only = stage == "rectify" and "raster" in sources
    seen = (*seen, uri)
    gone = (one for one in inputs if one not in seen and (one not in known or known[one]["cleared"]))
    return is_only or any(is_only_copy(known, one, seen) for one in gone)


def _source_in(params: Mapping[str, Any]) -> str | None:
    """Return the source of captured light, wherever parameters have it."""
    if isinstance(params.get("source"), str):
        return str(params["source"])
    inner = (_source_in(one) for one in params.values() if isinstance(one, dict))
    return next((one for one in inner if one is not None), None)
