"""Verify an archive: compare every byte with its manifest, and every manifest with its seal; and repair it.

A repair removes damaged stores, and runs the surveys again that name them. Lines of a rig cannot be captured again, nor
can stores of another version of a stage be made: they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pipeline.errors import ArchiveError, IncompleteStoreError, PipelineError
from storage.archive.archive import Archive
from storage.archive.keys import canonical_json, without_manifest
from storage.archive.lineage import Catalogue
from storage.archive.manifests import broken_files, is_cleared, listed_bytes, try_manifest
from storage.archive.records import RECEIPT, Run, moment_of, read_run
from storage.archive.staging import MANIFEST_NAME

Progress = Callable[[str, float], None]  # address being read, fraction of all bytes


@dataclass(frozen=True)
class Finding:
    """Finding on one store or run; ``problem`` is None where every byte is as published.

    ``missing``: a run or store names a store that is not there. ``stray``: something that is no part of an archive.
    """

    uri: str
    problem: str | None
    kind: Literal["whole", "broken", "missing", "stray"] = "whole"


def verify_everything(
    root: Path, progress: Progress | None = None, problems_of: Callable[[Path], Iterator[str]] | None = None
) -> list[Finding]:
    """Return a finding for each store and run without damage, and for each problem.

    ``problems_of`` reads one published folder whose files lie elsewhere, as in a bucket.
    """
    catalogue = Catalogue.read(root)
    places = [(uri, store.ref.path, store.size) for uri, store in catalogue.stores.items()]
    places += [(run.uri, run.folder, listed_bytes(run.facts) if run.facts else 0) for run in catalogue.runs]
    total = sum(size for *_, size in places) or 1
    done = 0
    found: list[Finding] = []
    for uri, path, size in places:
        if progress is not None:
            progress(uri, done / total)
        done += size
        problems = list((problems_of or _problems)(path))
        if not path.exists() and not catalogue.named_by(uri):
            continue  # gc or a repair has cleared it away since
        found += [Finding(uri, problem, "broken") for problem in problems] or [Finding(uri, None)]
    for path in without_manifest(root):
        uri = path.relative_to(root).as_posix()
        if path.is_dir():
            found.append(Finding(uri, f"{MANIFEST_NAME} is missing", "broken"))
        else:
            found.append(Finding(uri, "expected a folder with a manifest; take it out of the archive", "stray"))
    there = set(catalogue.stores)
    reported: set[str] = set()
    for run in catalogue.runs:
        for uri in sorted(run.names - there - reported):
            reported.add(uri)
            found.append(Finding(uri, f"is not there, but {run.uri} names it", "missing"))
    for uri in catalogue.stores:
        for given in catalogue.inputs_of(uri):
            if given not in there | reported:
                reported.add(given)
                found.append(Finding(given, f"is not there, but {uri} was made of it", "missing"))
    return found


def _problems(folder: Path) -> Iterator[str]:
    """Yield the problems of one published folder, file by file."""
    manifest, problem = try_manifest(folder)
    if problem is not None:
        yield f"{MANIFEST_NAME} is damaged: {problem}"
        return
    found = [f"{name} {problem}" for name, problem in broken_files(folder, manifest, hashes=True)]
    changed = found and (is_cleared(folder) or try_manifest(folder)[0] != manifest)  # cleared meanwhile, or made anew
    yield from _problems(folder) if changed else found


@dataclass(frozen=True)
class RepairPlan:
    """Steps of a repair, with addresses relative to the archive; inputs come after the stores made of them."""

    remade: tuple[str, ...]  # damaged or missing stores
    hopeless: dict[str, str]  # damaged stores that stay, with the reason
    surveys: tuple[Run, ...]  # a run for each different settings
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


def plan_repair(
    archive: Archive,
    findings: Iterable[Finding],
    *,
    versions: Mapping[str, int | str],
    can_capture: Callable[[Run], bool],
    weights_of: Callable[[Run], str | None],
) -> RepairPlan:
    """Return the repairs for these findings.

    ``versions`` are the present ones of the stages. ``can_capture`` tells whether a run can capture its lines again;
    ``weights_of`` gives the key of the weights that its survey takes now.
    """
    catalogue = Catalogue.read(archive.root)
    bad = [one.uri for one in findings if one.kind in ("broken", "missing")]
    stores = [uri for uri in bad if uri.startswith("stages/") and uri.count("/") == 2]
    hopeless = dict.fromkeys((uri for uri in bad if "/" not in uri), "its stage and settings are not known")
    hopeless |= {uri: why for uri in stores if (why := _hopeless(catalogue, uri, versions, can_capture, weights_of))}
    missed = {uri for uri in stores if uri in hopeless and catalogue.inputs_of(uri) and not _is_found(archive, uri)}
    there = [(uri, one) for uri, one in catalogue.stores.items() if uri not in stores]
    missed |= {uri for uri, one in there if one.version != str(versions.get(one.ref.stage))}
    stuck = {run.uri: min(run.names & missed) for run in catalogue.runs if run.names & missed and not can_capture(run)}
    for uri in set(stores) - set(hopeless):  # its survey would capture what it does not find
        if (named := catalogue.named_by(uri)) and all(run.uri in stuck for run in named):
            hopeless[uri] = f"its survey needs {stuck[named[0].uri]}, which is damaged or of another version"
    broken = set(stores) - set(hopeless)
    ordered = [uri for uri in reversed(catalogue.inputs_first(broken)) if uri in catalogue.stores]
    ordered += sorted(broken - set(ordered))
    runs = {run.uri: _settings_text(run) for run in catalogue.runs if run.uri in bad}
    runs |= {uri: "" for uri in bad if uri.startswith("runs/") and uri not in runs}
    affected = [run for run in catalogue.runs if (run.uri in runs or run.names & broken) and run.uri not in stuck]
    surveys = {text: run for run in affected if (text := _settings_text(run))}
    return RepairPlan(tuple(ordered), hopeless, tuple(surveys.values()), runs)


def repair(
    archive: Archive,
    findings: Iterable[Finding],
    rerun: Callable[[dict[str, Any]], str],  # settings of a survey -> address of the run; PipelineError where it cannot
    *,
    versions: Mapping[str, int | str],
    can_capture: Callable[[Run], bool],
    weights_of: Callable[[Run], str | None],
) -> Repaired:
    """Remove the damaged stores, and run the surveys again that name them.

    ``findings`` are those of `verify_archive`. ``rerun`` runs a survey into this archive by its settings. A damaged run
    is published again under its name; the repetition of an undamaged one is removed. Stores made of other ``versions``
    or weights than the present ones stay, and so do those of lines that a run cannot capture again. Raises
    ArchiveError: another process uses the archive, or the disk or bucket refuses.
    """
    with archive.in_use(alone=True) as alone:
        if not alone:
            raise ArchiveError(f"{archive.name} is in use; run verify --repair again when the survey there has ended")
        plan = plan_repair(archive, findings, versions=versions, can_capture=can_capture, weights_of=weights_of)
        done = Repaired(plan)
        for uri in plan.remade:
            archive.discard(archive.ref(*uri.split("/")[1:]))
    there = {run.uri for run in Catalogue.read(archive.root).runs} | set(plan.broken_runs)
    repeated: dict[str, str] = {}
    surveys = {_settings_text(run): run for run in plan.surveys}

    def run_again(text: str) -> None:
        repeated.pop(text, None)
        try:
            repeated[text] = rerun({name: value for name, value in surveys[text].settings.items() if name != "notes"})
        except PipelineError as error:
            done.failed[surveys[text].uri] = str(error)

    for text in surveys:
        run_again(text)
    catalogue = Catalogue.read(archive.root)
    for uri in plan.remade:
        if uri in catalogue.stores:
            done.remade.append(uri)
        elif not catalogue.named_by(uri):
            done.dropped.append(uri)
        else:
            done.failed[uri] = "; ".join(done.failed.values()) or "its survey ran again without building it"
    for uri, text in plan.broken_runs.items():
        if repeated.get(text) in plan.broken_runs:  # another damaged run of this survey has taken it
            run_again(text)
        before = read_run(archive.root / uri).names
        if text in repeated and before and before.isdisjoint(read_run(archive.root / repeated[text]).names):
            done.failed[uri] = "its scene shows something else by now: restore the file"
        elif text in repeated:  # its survey has run again
            archive.drop_run(uri)
            if repeated[text] not in there:
                archive.rename_run(repeated[text], uri)
                repeated[text] = uri
            done.remade.append(uri)
        else:
            done.failed.setdefault(
                uri, f"its {RECEIPT} cannot be read, or its lines are lost: run that survey again by hand"
            )
    for uri in set(repeated.values()) - there:
        archive.drop_run(uri)
    return done


def _is_found(archive: Archive, uri: str) -> bool:
    """Return whether a survey finds a store, as far as sizes tell."""
    try:
        return archive.find(*uri.split("/")[1:]) is not None
    except IncompleteStoreError:
        return False


def _hopeless(
    catalogue: Catalogue,
    uri: str,
    versions: Mapping[str, int | str],
    can_capture: Callable[[Run], bool],
    weights_of: Callable[[Run], str | None],
) -> str:
    """Return why a store cannot be built again; empty where it can. Its key has the versions of all its inputs."""
    if catalogue.is_only_copy(uri, can_capture):
        return "its lines cannot be captured again: restore it from a copy. Undamaged lines can still be read"
    if (stage := uri.split("/")[1]) not in versions:
        return f"there is no stage {stage}: take it out of the archive"
    made_of = [one for key in (uri, *sorted(catalogue.ancestors([uri]))) if (one := catalogue.stores.get(key))]
    for one in made_of:
        name = one.ref.stage
        now = str(versions.get(name, one.version))
        if one.version not in ("", now):
            return f"made by version {one.version} of the stage {name}, which is now {now}: reprocess builds it again"
    runs = catalogue.named_by(uri)
    if runs and not any(run.settings for run in runs):
        return f"the settings of {runs[-1].uri}, which names it, cannot be read: run that survey again by hand"
    if runs and not any(can_capture(run) or run.settings.get("source") == "rig" for run in runs):
        return "what its runs showed is gone or shows something else by now: restore their scene or recording"
    weights = {one.params["weights"] for one in made_of if "weights" in one.params}
    if runs and weights and weights.isdisjoint(map(weights_of, runs)):
        return "made by weights that its survey does not find any more: reprocess builds it again"
    dated = any(moment_of(run.settings.get("visit")) or run.settings.get("day") for run in runs)
    for name, known in (("device", False), ("days", dated)):  # of this machine, or from the prior map until today
        if not known and any(name in one.params for one in made_of):
            return f"its {name} would be others today: run its survey again by hand"
    return ""


def _settings_text(run: Run) -> str:
    """Return the settings as canonical text, without the archive's place and the notes."""
    asked = {name: value for name, value in run.settings.items() if name not in ("notes", "out")}
    return canonical_json(asked) if asked else ""
