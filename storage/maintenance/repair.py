"""Repair an archive: remove damaged stores, and run the surveys again that name them.

Raw lines of a rig cannot be made again, nor can stores of another version of a stage: they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.errors import ArchiveError, PipelineError
from storage.archive.archive import Archive
from storage.archive.keys import canonical_json
from storage.archive.lineage import Catalogue
from storage.archive.records import RECEIPT, Run
from storage.maintenance.verification import Finding

Rerun = Callable[[dict[str, Any]], None]  # settings of a survey: runs and publishes it; PipelineError where it cannot


@dataclass(frozen=True)
class RepairPlan:
    """Steps of a repair, with addresses relative to the archive; inputs come after the stores made of them."""

    remade: tuple[str, ...]  # damaged or missing stores
    hopeless: dict[str, str]  # damaged stores that stay, with the reason
    surveys: tuple[tuple[Run, dict[str, Any]], ...]  # a run for each different settings, and the settings
    broken_runs: dict[str, str]  # run folders that are damaged -> canonical settings, empty where not known


@dataclass
class Repaired:
    """Result of a repair."""

    plan: RepairPlan
    remade: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)  # damaged stores that no run named
    failed: dict[str, str] = field(default_factory=dict)  # run or store that was not made again -> message

    @property
    def complete(self) -> bool:
        """Return whether no damage is left."""
        return not (self.plan.hopeless or self.failed)


def plan_repair(archive: Archive, findings: Iterable[Finding], *, versions: Mapping[str, int | str]) -> RepairPlan:
    """Return the repairs for these findings; ``versions`` are the present ones of the stages."""
    catalogue = Catalogue.read(archive.root)
    bad = [one.uri for one in findings if one.kind in ("broken", "missing")]
    stores = [uri for uri in bad if uri.startswith("stages/") and uri.count("/") == 2]
    hopeless = dict.fromkeys((uri for uri in bad if "/" not in uri), "its stage and settings are not known")
    hopeless |= {uri: why for uri in stores if (why := _hopeless(catalogue, uri, versions))}
    broken = set(stores) - set(hopeless)
    ordered = [uri for uri in reversed(catalogue.inputs_first(broken)) if uri in catalogue.stores]
    ordered += sorted(broken - set(ordered))
    runs = {run.uri: _settings_text(run) for run in catalogue.runs if run.uri in bad}
    runs |= {uri: "" for uri in bad if uri.startswith("runs/") and uri not in runs}
    affected = [run for run in catalogue.runs if run.uri in runs or run.names & broken]
    surveys = {text: run for run in affected if (text := _settings_text(run))}
    return RepairPlan(tuple(ordered), hopeless, tuple((run, run.settings) for run in surveys.values()), runs)


def repair(
    archive: Archive, findings: Iterable[Finding], rerun: Rerun, *, versions: Mapping[str, int | str]
) -> Repaired:
    """Remove the damaged stores, and run the surveys again that name them.

    ``findings`` are those of `verify_archive`. ``rerun`` runs a survey into this archive by its settings.
    ``versions`` are the present ones of the stages; stores of other versions stay. Raises ArchiveError: another process
    uses the archive, or the disk or bucket refuses.
    """
    with archive.in_use(alone=True) as alone:
        if not alone:
            raise ArchiveError(f"{archive.name} is in use; run verify --repair again when the survey there has ended")
        plan = plan_repair(archive, findings, versions=versions)
        done = Repaired(plan)
        for uri in plan.remade:
            archive.discard(archive.ref(*uri.split("/")[1:]))
    succeeded: set[str] = set()
    for run, settings in plan.surveys:
        try:
            rerun({name: value for name, value in settings.items() if name != "notes"})
            succeeded.add(_settings_text(run))
        except PipelineError as error:
            done.failed[run.uri] = str(error)
    catalogue = Catalogue.read(archive.root)
    for uri in plan.remade:
        if uri in catalogue.stores:
            done.remade.append(uri)
        elif not catalogue.named_by(uri):
            done.dropped.append(uri)
        else:
            done.failed[uri] = "; ".join(done.failed.values()) or "its survey ran again without building it"
    for uri, text in plan.broken_runs.items():
        if text in succeeded:  # its survey has run again, into a folder of its own
            archive.drop_run(uri)
            done.remade.append(uri)
        else:
            words = f"its {RECEIPT} or the settings in it cannot be read: run that survey again by hand"
            done.failed.setdefault(uri, words)
    return done


def _hopeless(catalogue: Catalogue, uri: str, versions: Mapping[str, int | str]) -> str:
    """Return why a store cannot be built again; empty where it can."""
    store, stage = catalogue.stores.get(uri), uri.split("/")[1]
    if catalogue.is_only_copy(uri):
        return "raw lines cannot be captured again: restore them from a copy. Undamaged lines can still be read"
    if stage not in versions:
        return f"there is no stage {stage}: take it out of the archive"
    if store is not None and store.version and store.version != str(versions[stage]):
        now = versions[stage]
        return f"made by version {store.version} of the stage {stage}, which is now {now}: reprocess builds it again"
    runs = catalogue.named_by(uri)
    if runs and not any(run.settings for run in runs):
        return f"the settings of {runs[-1].uri}, which names it, cannot be read: run that survey again by hand"
    return ""


def _settings_text(run: Run) -> str:
    """Return the settings as canonical text, without the archive's place and the notes."""
    asked = {name: value for name, value in run.settings.items() if name not in ("notes", "out")}
    return canonical_json(asked) if asked else ""
