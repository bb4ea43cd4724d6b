"""Making an archive whole again: what is broken, and what was made of it, is made anew by the surveys that name it.

Nothing is thrown away before it is there again. Stores to be remade are set aside, and put back where their survey
does not make them again; killed in between, the next repair begins by putting back. Raw lines of a rig, and stores of
a version of a stage that is no longer made, cannot be remade: they stay, and with them what was made of them.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import ArchiveError, PipelineError
from storage.archive.archive import Archive
from storage.archive.keys import canonical_json
from storage.archive.lineage import Catalogue
from storage.archive.records import RECEIPT, Run
from storage.archive.staging import PART_SUFFIX, refusals, remove_tree, retire, sync_path, take_lock
from storage.maintenance.verification import ASIDE, Finding

Rerun = Callable[[dict[str, Any]], None]  # settings of a survey: runs and publishes it; PipelineError where it cannot


@dataclass(frozen=True)
class RepairPlan:
    """What a repair does. Addresses are relative to the archive, stores in such an order that inputs come last."""

    remade: tuple[str, ...]  # broken or missing stores, and what was made of them
    hopeless: dict[str, str]  # broken and left as they are, with the reason
    surveys: tuple[tuple[Run, dict[str, Any]], ...]  # one run for each different settings, and these
    broken_runs: dict[str, str]  # run folders that are damaged -> canonical settings, empty where not known


@dataclass
class Repaired:
    """What a repair did."""

    plan: RepairPlan
    remade: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)  # broken, and no run named it
    put_back: dict[str, str] = field(default_factory=dict)  # not made again, with the reason
    failed: dict[str, str] = field(default_factory=dict)  # run whose survey could not be run again -> message

    @property
    def complete(self) -> bool:
        """Whether nothing broken is left."""
        return not (self.plan.hopeless or self.put_back or self.failed)


def plan_repair(
    archive: Archive, findings: Iterable[Finding], *, versions: Mapping[str, int | str] | None = None
) -> RepairPlan:
    """Tell what a repair would do with these findings; ``versions`` are the stages' as they are made now."""
    catalogue = Catalogue.read(archive.root)
    bad = {one.uri: one.problem or "" for one in findings if one.kind in ("broken", "missing")}
    stores = {uri: problem for uri, problem in bad.items() if uri.startswith("stages/") and uri.count("/") == 2}
    hopeless = dict.fromkeys((uri for uri in bad if "/" not in uri), "nothing tells what it was or how to make it")
    hopeless |= {uri: why for uri in stores if (why := _hopeless(catalogue, uri, versions))}
    broken = set(stores) - set(hopeless)
    below = {uri for uri in catalogue.dependents(broken) if not _hopeless(catalogue, uri, versions)}
    ordered = [uri for uri in reversed(catalogue.inputs_first(below | broken)) if uri in catalogue.stores]
    ordered += sorted(broken - set(ordered))
    runs = {run.uri: _settings_text(run) for run in catalogue.runs if run.uri in bad}
    runs |= {uri: "" for uri in bad if uri.startswith("runs/") and uri not in runs}
    affected = [run for run in catalogue.runs if run.uri in runs or catalogue.named_and_below[run.uri] & set(ordered)]
    surveys = {text: run for run in affected if (text := _settings_text(run))}
    return RepairPlan(tuple(ordered), hopeless, tuple((run, run.settings) for run in surveys.values()), runs)


def repair(
    archive: Archive, findings: Iterable[Finding], rerun: Rerun, *, versions: Mapping[str, int | str] | None = None
) -> Repaired:
    """Set aside what is broken and all that was made of it, and run the surveys that name any of it again.

    ``findings`` are those of `verify_everything`. ``rerun`` runs a survey by its settings, as the receipt has them,
    into this archive, and finds there what is whole. ``versions`` are the stages' as they are made now: stores of
    others are not made again, and stay. Raises ArchiveError: somebody else uses the archive, or the disk refuses.
    """
    with archive.in_use(alone=True) as alone, refusals(archive.root, "repair the archive"):
        if not alone:
            raise ArchiveError(f"{archive.root} is in use; run verify --repair again when the survey there has ended")
        put_back(archive.root)
        plan = plan_repair(archive, findings, versions=versions)
        for uri in plan.remade:
            _, stage, key = uri.split("/")
            release = take_lock(archive.root / ".locks" / f"{stage}-{key}.lock")
            try:
                if os.path.lexists(archive.root / uri):
                    _move(archive.root / uri, archive.root / ASIDE / stage / key)
            finally:
                if release is not None:
                    release()
    done = Repaired(plan)
    try:
        succeeded = run_again(plan.surveys, rerun, done)
    except BaseException:
        put_back(archive.root)
        raise
    with refusals(archive.root, "repair the archive"):
        _settle(archive, done)
        for uri, text in plan.broken_runs.items():
            if text in succeeded:  # its survey has run again, into a folder of its own
                retire(archive.root / uri)
                done.remade.append(uri)
            else:
                words = f"its {RECEIPT} or the settings in it cannot be read: run that survey again by hand"
                done.failed.setdefault(uri, words)
    return done


def put_back(root: Path) -> list[str]:
    """Put back what a broken-off repair had set aside, unless it has been made again; gives the addresses."""
    back: list[str] = []
    for path in sorted((root / ASIDE).glob("*/*")):
        uri = f"stages/{path.parent.name}/{path.name}"
        if (root / uri).exists():
            remove_tree(path)
        else:
            _move(path, root / uri)
            back.append(uri)
    remove_tree(root / ASIDE)
    return back


def _hopeless(catalogue: Catalogue, uri: str, versions: Mapping[str, int | str] | None) -> str:
    """Why a store cannot be made again; empty where it can."""
    store, stage = catalogue.stores.get(uri), uri.split("/")[1]
    if catalogue.is_only_copy(uri):
        return "raw lines that cannot be had again: restore them from a copy; the chunks not named can still be read"
    if uri in catalogue.lost and versions is not None and stage not in versions:
        return f"there is no stage {stage}, so nothing tells what it was: take it out of the archive"
    made = "" if store is None else store.version
    if versions is not None and made and str(versions.get(stage)) != made:
        now = versions.get(stage, "none")
        return f"made by version {made} of the stage {stage}, which is now {now}: reprocess makes a new generation"
    runs = catalogue.named_by(uri)
    if runs and not any(run.settings for run in runs):
        return f"the settings of {runs[-1].uri}, which names it, cannot be read: run that survey again by hand"
    return ""


def _settings_text(run: Run) -> str:
    """Settings in one text, without the archive's place and the notes, which ask for nothing."""
    asked = {name: value for name, value in run.settings.items() if name not in ("notes", "out")}
    return canonical_json(asked) if asked else ""


def run_again(surveys: Sequence[tuple[Run, dict[str, Any]]], rerun: Rerun, done: Repaired) -> set[str]:
    """Run surveys again; gives the canonical settings of those that succeeded, and keeps what the others said."""
    succeeded: set[str] = set()
    for run, settings in surveys:
        try:
            rerun({name: value for name, value in settings.items() if name != "notes"})
        except PipelineError as error:
            done.failed[run.uri] = str(error)
        else:
            succeeded.add(_settings_text(run))
    return succeeded


def _settle(archive: Archive, done: Repaired) -> None:
    """Say of each store whether it was made again; what was not is put back, unless nobody named it."""
    catalogue = Catalogue.read(archive.root)
    for uri in reversed(done.plan.remade):  # inputs first, so that what is put back never lacks any
        aside = archive.root / ASIDE / uri.removeprefix("stages/")
        if (archive.root / uri).exists():
            done.remade.append(uri)
        elif not catalogue.named_by(uri):
            done.dropped.append(uri)
        else:
            why = "; ".join(done.failed.values()) or "its survey ran again and did not make it"
            done.put_back[uri] = why
            if os.path.lexists(aside):
                _move(aside, archive.root / uri)
        remove_tree(aside)
    remove_tree(archive.root / ASIDE)


def _move(path: Path, to: Path) -> None:
    """Give a folder another name, for good; what has that name is taken away."""
    to.parent.mkdir(parents=True, exist_ok=True)
    if to.exists():
        to.rename(away := to.with_name(f"{to.name}-{secrets.token_hex(4)}{PART_SUFFIX}"))
        remove_tree(away)
    path.rename(to)
    sync_path(to.parent)
    sync_path(path.parent)
