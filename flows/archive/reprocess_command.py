"""What `spectralzoom reprocess` and `evaluate ARCHIVE RUN` do: surveys of an archive again, and maps judged later.

What the archive holds is found by its key, raw light above all; only what new weights or newer stages change is made.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.archive.compare_command import find_run
from flows.archive.stale_runs import (
    Generation,
    asked_again,
    from_raw_cubes,
    is_called,
    is_current,
    is_whole,
    newest_runs,
    renewals,
    renewed_prior,
)
from flows.cli.app import ArchiveName, AsJson, Scheduler, Switch, Workers, stderr
from flows.publish.receipt import Receipt
from flows.publish.run_folder import extend_with_accuracy, load_receipt
from flows.publish.survey_command import run_survey, show_published
from flows.settings.load import of_this_version, parse_settings
from flows.settings.survey_settings import OF_THE_MACHINE, Settings
from flows.tasks.observer import Observer
from flows.tasks.open_survey import JUDGED, STAGES, TITLES, OpenSurvey, Products, versions
from flows.tasks.run import SurveyRun, open_run
from flows.tasks.scene import for_rig
from flows.tasks.scores import score_of
from flows.tasks.stages.accuracy import evaluate
from flows.tasks.stages.placement import extract_patches
from flows.tasks.stages.raster import take_patches
from flows.terminal.figures import counted, format_points, format_seconds
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import StageProgress, put_out
from models.network.machine import keep_freed_memory, use_one_thread
from pipeline.errors import ArchiveError, PipelineError, SceneError, SettingsError, WeightsError
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.lineage import Catalogue
from storage.archive.records import Run, read_run
from storage.parallel.pool import THREADS, WorkerPool
from storage.remote.opening import open_archive

Survey = Callable[[Settings, Console], Path]  # settings in, the folder of the published run out
STATES = ("ran", "would run", "skipped", "failed")


def reprocess(
    archive: ArchiveName,
    *,
    since: str | None = None,
    field: str | None = None,
    failed: Switch = False,
    weights: Path | None = None,
    scheduler: Scheduler = "threads",
    workers: Workers = None,
    dry_run: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Survey every field of an archive again: light is found there, only what has changed is made anew.

    Parameters
    ----------
    since
        Only fields whose newest run is of this date (UTC) or later: 2026-05-01
    field
        Only fields whose survey, scene file or newest run is called so; * stands for any letters.
    failed
        Only fields whose newest run is damaged or lacks stores; what `verify` finds in bytes is for its --repair.
    weights
        Other model weights for all of them.
    dry_run
        Only say what would run.
    """
    request = ReprocessRequest(archive, since, field, failed, weights, dry_run, WorkerPool(scheduler, workers))
    return run_reprocess(request, stderr, as_json=as_json)


@dataclass(frozen=True)
class ReprocessRequest:
    """Which fields, and with what."""

    archive: str | Path
    since: str | None = None  # ISO date (UTC); the newest run of the field is of this day or later
    field: str | None = None  # what survey, scene file or run is called; * for any letters
    failed: bool = False  # only where the newest run is damaged or lacks stores
    weights: Path | None = None
    dry_run: bool = False
    pool: WorkerPool = THREADS  # who makes blocks; what the old runs were made by need not be there


def run_reprocess(
    request: ReprocessRequest, console: Console, *, survey: Survey | None = None, as_json: bool = False
) -> int:
    """Survey again what was asked for; progress on ``console``, the summary on stdout. Raises as `reprocess_fields`."""
    content = reprocess_fields(request, console, survey)
    put_out(content, _show, as_json=as_json)
    failed = sum(row["state"] == "failed" for row in content["fields"])
    return DONE if not failed else FAILED if failed == len(content["fields"]) else PARTLY


def reprocess_fields(request: ReprocessRequest, console: Console, survey: Survey | None = None) -> dict[str, Any]:
    """Survey again what was asked for, and return a row a field.

    Fields whose newest run is already as it would become are skipped: the same command goes on after an interruption.
    Raises SettingsError: a date that is none, or no field is called so; ArchiveError: the archive cannot be read or
    written.
    """
    opened = open_archive(request.archive, create=False, write=not request.dry_run)
    catalogue = Catalogue.read(opened.root)
    wanted = _chosen(catalogue, request)
    rows: list[dict[str, Any]] = []
    renewed = renewals(catalogue)
    with request.pool.open():  # one start of its workers for all fields
        for number, generation in enumerate(wanted, 1):
            summary = f"{number} of {len(wanted)}: {generation.field} ({generation.run.folder.name})"
            console.print(f"[bold]reprocess {escape(summary)}[/]", soft_wrap=True)
            rows.append(_again(catalogue, generation, request, console, survey or _survey, renewed))
            if rows[-1]["new"] is not None:
                renewed[generation.run.folder.name] = rows[-1]["new"]
            console.print(escape(_format_row(rows[-1])), soft_wrap=True)
    return {"archive": opened.name, "dry_run": request.dry_run, "fields": rows}


def _chosen(catalogue: Catalogue, request: ReprocessRequest) -> list[Generation]:
    if request.weights is not None and not request.weights.is_file():
        raise SettingsError(f"--weights {request.weights}: there is no such file; give weights that train has written")
    since = None if request.since is None else _moment(request.since)
    fields = newest_runs(catalogue)
    if request.field is not None:
        names = ", ".join(dict.fromkeys(one.field for one in fields)) or "none"
        fields = [one for one in fields if is_called(one, request.field)]
        if not fields:
            raise SettingsError(f"--field {request.field}: no field of this archive is called so; there are {names}")
    if since is not None:
        fields = [one for one in fields if _moment(one.run.created or "0001-01-01") >= since]
    if request.failed:
        fields = [one for one in fields if not is_whole(catalogue, one.run)]
    return fields


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise SettingsError(f"--since expects a date such as 2026-05-01, got {text!r}") from None
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


def _again(
    catalogue: Catalogue,
    generation: Generation,
    request: ReprocessRequest,
    console: Console,
    survey: Survey,
    renewed: Mapping[str, str],
) -> dict[str, Any]:
    """Survey one field again; ``renewed`` names the newest run of each visit that another may go on from."""
    run, begun = generation.run, time.perf_counter()
    row: dict[str, Any] = {
        "field": generation.field,
        "scene": run.settings.get("scene"),
        "old": run.folder.name,
        "new": None,
        "state": "failed",
        "message": None,
        **_scores(run.receipt, "before"),
        **_scores({}, "after"),
        "seconds": None,
    }
    try:
        settings = asked_again(run, str(request.archive), request.weights)
        settings = replace(settings, scheduler=request.pool.scheduler, workers=request.pool.workers)
        prior = renewed_prior(settings.prior, renewed)
        if prior == settings.prior and is_current(catalogue, run, settings):
            same = {"state": "skipped", "message": "is as it would become"}
            return row | same | _scores(run.receipt, "after")
        settings = from_raw_cubes(catalogue, run, replace(settings, prior=prior))
        settings = replace(settings, scheduler=request.pool.scheduler, workers=request.pool.workers)
        if request.dry_run:
            return row | {"state": "would run"}
        folder = survey(settings, console)
    except PipelineError as error:
        return row | {"message": str(error), "seconds": time.perf_counter() - begun}
    after, seconds = _scores(read_run(folder, {}).receipt, "after"), time.perf_counter() - begun
    return row | {"new": folder.name, "state": "ran", **after, "seconds": seconds}


def _survey(settings: Settings, console: Console) -> Path:
    return run_survey(settings, console).folder


def survey_as_before(settings: Mapping[str, Any], out: str, console: Console) -> None:
    """Survey by the settings of a run's receipt into the archive ``out``, on this machine's own terms."""
    here = {**of_this_version(settings), "out": out, **dict.fromkeys(OF_THE_MACHINE)}
    run_survey(parse_settings(here), console)


def _scores(receipt: Mapping[str, Any], when: str) -> dict[str, float | None]:
    return {f"{name}_{when}": score for name, score in score_of(receipt).items()}


def _format_row(row: Mapping[str, Any]) -> str:
    words = f"{row['field']} ({row['old']}) {row['state']}"
    if row["state"] == "ran":
        words += f": {row['new']}, {format_seconds(row['seconds'])}"
        for label, name in (("mIoU", "miou"), ("overall", "overall_accuracy")):
            scores = [row[f"{name}_before"], row[f"{name}_after"]]
            words += "" if None in scores else f", {label} {' to '.join(map(format_points, scores))}"
        return words
    return words + (f": {row['message']}" if row["message"] else "")


def _show(content: Mapping[str, Any], console: Console) -> None:
    rows = content["fields"]
    counts = {state: sum(row["state"] == state for row in rows) for state in STATES}
    summary = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    lines = [
        *map(_format_row, rows),
        f"{counted(len(rows), 'field')}: {summary}" if rows else "no field matches: nothing to do",
    ]
    for line in lines:
        console.print(escape(line), soft_wrap=True)


def run_judge(
    archive: str, name: str, console: Console, *, controls: bool | None = None, labels: str | None = None
) -> Receipt:
    """Judge a run's map and add its accuracy to the run; gives its receipt, as it is where it has what is asked for.

    ``name`` may be `latest` or `previous`; what is None is as the survey was asked for. Raises ArchiveError: there is
    no such run, it is damaged, or lacks what is needed; SceneError, WeightsError: scene, labels or weights are not
    those of the run, or there are no labels.
    """
    opened = open_archive(archive, create=False)
    catalogue = Catalogue.read(opened.root)
    found = find_run(catalogue, name)
    receipt = load_receipt(found.folder)
    settings = replace(asked_again(found, opened.name, None), accuracy=True)
    if controls is not None:
        settings = for_rig(replace(settings, controls=controls))
    if labels is not None:
        settings = replace(settings, labels=labels)
    there = "accuracy" in receipt and labels is None
    if there and (receipt["accuracy"]["controls"] or _places_none(settings) or not settings.controls):
        console.print(escape(f"{found.uri} has its accuracy already"), soft_wrap=True)
        return receipt
    use_one_thread()
    keep_freed_memory()
    with console.status("opening scene and weights"):
        run = open_run(settings)
        run.archive.reclaim()
        survey = OpenSurvey(run)
        for row in found.stages:
            stage = STAGES.get(str(row.get("name")))
            if stage is not None and stage.name != evaluate.name and row.get("key"):
                what = f"{stage.title} of {found.uri}"
                survey.products[stage.name] = _store(catalogue, run.archive, what, str(row["key"]))
        for name in _needed(survey):
            if name not in survey.products:
                raise ArchiveError(f"the {TITLES[name]} of {found.uri} is missing or damaged; run verify --repair")
        _check_same(catalogue, found, survey.products, run)
    with survey.at_work(captures=False), StageProgress(console, TITLES) as progress:
        survey.observer = Observer(progress.watch)
        draft = run.archive.extend_run(found.folder.name, wait=False)
        if draft is None:
            raise ArchiveError(f"{found.uri} is being judged by another process; it adds the accuracy")
        with draft:
            made = survey.products
            if catalogue.stores[made.patches.uri].cleared and survey.is_map:
                take_patches(survey, made["score"])
            elif catalogue.stores[made.patches.uri].cleared:
                last = "coarse" if survey.uniform else "fine"
                extract_patches(survey, made["score"], *made.there(f"capture_{last}", f"register_{last}"))
            published = extend_with_accuracy(survey, draft, evaluate(survey, *made.there(*JUDGED)))
    show_published(published, settings.out, console)
    return published.receipt


def _places_none(settings: Settings) -> bool:
    """Return whether a survey placed no patches, so that no other placement is judged beside it."""
    return settings.plain and not settings.is_map


def _needed(survey: OpenSurvey) -> tuple[str, ...]:
    """Return the stages by whose stores a map is judged."""
    if survey.is_map:
        return ("average_raster", "take_patches", "segment", "score")
    return ("rectify", "extract_patches", "segment", "choose_effects", "score")


def _store(catalogue: Catalogue, archive: Archive, what: str, key: str) -> StageRef:
    uris = [uri for uri in catalogue.by_key.get(key, []) if uri in catalogue.stores]
    store = catalogue.stores[uris[0]] if uris else None
    if store is None or store.problem is not None:
        raise ArchiveError(f"the {what} is missing or damaged; run verify --repair")
    now = versions().get(store.ref.stage)
    if store.version != str(now):
        raise ArchiveError(
            f"the {what} was made by version {store.version} of the stage {store.ref.stage}, which is now {now}:"
            " reprocess makes a new run, with its accuracy"
        )
    return archive.ref(store.ref.stage, store.ref.key)


def _check_same(catalogue: Catalogue, found: Run, products: Products, run: SurveyRun) -> None:
    """Refuse to judge by another scene or other weights than the map is of, or where there is nothing to judge by."""
    if run.scene.key != found.receipt.get("scene"):
        raise SceneError(
            f"the scene {run.settings.scene} is another than {found.uri} looked at; put that one back, or survey again"
        )
    if run.weights_key != catalogue.stores[products["segment"].uri].params.get("weights"):
        raise WeightsError(
            f"the weights {run.settings.weights or 'that come with SpectralZoom'} are others than the map of"
            f" {found.uri} was drawn with; put those back, or reprocess with these"
        )
    if not run.scene.labelled:
        raise SceneError(f"there are no labels to judge {found.uri} by; give --labels FILE, on the scene's pixels")
