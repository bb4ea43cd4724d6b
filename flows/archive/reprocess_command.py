"""Survey the fields of an archive again: the verb `reprocess`.

Existing stores are found by their keys; only stores that new weights or newer stages change are made.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.plan_command import dry_run
from spectralzoom.flows.opening.recorded_field import open_recorded, recorded_scene
from spectralzoom.flows.opening.scene import open_map, open_scene
from spectralzoom.flows.publish.scores import score_of, warnings_of
from spectralzoom.flows.settings.flags import ArchiveName, AsJson, Scheduler, Switch, Workers, WorkersBucket
from spectralzoom.flows.settings.settings import OF_THE_MACHINE, Settings, load_settings, parse_settings
from spectralzoom.flows.settings.values import BUILT_IN_SCENES, RECORDED, RIG
from spectralzoom.flows.stages.capture import capture_coarse, capture_fine
from spectralzoom.flows.survey_command import run_survey
from spectralzoom.flows.terminal.figures import counted, format_points, format_seconds
from spectralzoom.flows.terminal.processes import DONE, FAILED, PARTLY
from spectralzoom.flows.terminal.progress import put_out, show_text, stderr
from spectralzoom.models.weights.files import describe_weights
from spectralzoom.pipeline.errors import PipelineError, SceneError, SettingsError
from spectralzoom.pipeline.rig.device_settings import FAKE, OF_THE_LIGHT
from spectralzoom.pipeline.rig.drivers import NO_PORT
from spectralzoom.storage.parallel.pool import THREADS, WorkerPool
from spectralzoom.storage.readers.recordings import stores_of_lines
from spectralzoom.storage.runs import Catalogue, Run, read_run
from spectralzoom.storage.store import Archive, text_of

OF_THE_SURVEY = ("labels", "weights", "memory", "accuracy", "controls", "prior", "keep")  # not in raw cubes


def reprocess(
    archive: ArchiveName,
    *,
    field: str | None = None,
    weights: Path | None = None,
    scheduler: Scheduler = "threads",
    workers: Workers = None,
    bucket: WorkersBucket = None,
    dry_run: Switch = False,
    as_json: AsJson = False,
) -> int:
    """Survey every field of an archive again: stored captures are used, only stores that have changed are made.

    Parameters
    ----------
    field
        Only fields whose survey, scene file or newest run has this name; * matches any letters.
    weights
        Other model weights for all of them.
    dry_run
        Only print what would run.
    """
    pool = WorkerPool(scheduler, workers, bucket)
    return run_reprocess(archive, stderr, as_json=as_json, field=field, weights=weights, dry_run=dry_run, pool=pool)


def run_reprocess(archive: str | Path, console: Console, *, as_json: bool = False, **options: Any) -> int:
    """Run `reprocess_fields` with progress on ``console``, and print its summary on stdout."""
    content = reprocess_fields(archive, console, **options)
    put_out(content, _show, as_json=as_json)
    failed = sum(row["state"] == "failed" for row in content["fields"])
    return DONE if not failed else FAILED if failed == len(content["fields"]) else PARTLY


def reprocess_fields(
    archive: str | Path,
    console: Console,
    *,
    field: str | None = None,
    weights: Path | None = None,
    dry_run: bool = False,
    pool: WorkerPool = THREADS,
) -> dict[str, Any]:
    """Survey fields of an archive again, and return a row a field.

    Fields whose newest run is current are skipped, so the same command continues after an interruption. Raises
    SettingsError: no field has this name; ArchiveError: the archive cannot be read or written.
    """
    opened = Archive.open(archive, create=False, write=not dry_run)
    catalogue = Catalogue.read(opened)
    if weights is not None:
        describe_weights(weights)  # raises an error before any survey
    fields = newest_runs(catalogue)
    wanted = fields if field is None else [run for run in fields if is_called(run, field)]
    if field is not None and not wanted:
        names = ", ".join(dict.fromkeys(map(called, fields))) or "none"
        raise SettingsError(f"--field {field}: no field of this archive has this name; there are {names}")
    rows: list[dict[str, Any]] = []
    renewed = {old.folder.name: runs[-1].folder.name for runs in fields_of(catalogue) for old in runs[:-1]}
    with pool.open():  # workers start once for all fields
        for number, run in enumerate(wanted, 1):
            old = run.folder.name
            title = f"{number} of {len(wanted)}: {called(run)} ({old})"
            console.print(f"[bold]reprocess {escape(title)}[/]", soft_wrap=True)
            begun = time.perf_counter()
            row = {"field": called(run), "scene": run.settings.get("scene"), "old": old, "new": None}
            row |= {"state": "failed", "message": None, "warnings": warnings_of(run.receipt)}
            row |= {**_scores(run.receipt, "before"), **_scores({}, "after")}
            try:
                settings = _settings_of(catalogue, run, str(archive), weights, pool, renewed)
                if settings is None:
                    row |= {"state": "skipped", "message": "is up to date", **_scores(run.receipt, "after")}
                elif dry_run:
                    row |= {"state": "would run"}
                else:
                    folder = run_survey(settings, console).folder
                    receipt = read_run(folder).receipt
                    row |= {"new": folder.name, "state": "ran", **_scores(receipt, "after")}
                    row |= {"warnings": warnings_of(receipt)}
                    renewed[old] = folder.name
            except PipelineError as error:
                row |= {"message": str(error)}
            rows.append(row | {"seconds": time.perf_counter() - begun})
            show_text(_format_row(rows[-1]), console)
    return {"archive": opened.name, "dry_run": dry_run, "fields": rows}


def _settings_of(
    catalogue: Catalogue, run: Run, archive: str, weights: Path | None, pool: WorkerPool, renewed: Mapping[str, str]
) -> Settings | None:
    """Return the settings of a field's new survey; None where its newest run is current.

    ``renewed`` has the newest generation of each run that may be another's prior map.
    """
    here: dict[str, Any] = {"scheduler": pool.scheduler, "workers": pool.workers, "bucket": pool.bucket}
    settings = asked_again(run, archive, weights)
    prior = settings.prior
    while (newer := renewed.get(prior, prior)) != prior:
        prior = newer
    settings = settings.but(prior=prior, **here)
    shown = _is_there(run, settings)
    rows = dry_run(settings)[1].rows if shown else {}
    if shown and run.problem is None and all(row.state in ("cached", "left out") for row in rows.values()):
        return None
    captures = [row for name, row in rows.items() if name in (capture_coarse.name, capture_fine.name)]
    gone = settings.source == RIG and any(row.state != "cached" for row in captures)  # that light is over
    otherwise = settings.source == RECORDED and any(row.ref.key and row.ref.uri not in run.names for row in captures)
    if gone or otherwise or not shown:
        return from_raw_cubes(catalogue, run, settings).but(**here)
    return settings


def _scores(receipt: Mapping[str, Any], when: str) -> dict[str, float | None]:
    return {f"{name}_{when}": score for name, score in score_of(receipt).items()}


def _format_row(row: Mapping[str, Any]) -> str:
    text = "".join(f"Warning: {one}. " for one in row["warnings"]) + f"{row['field']} ({row['old']}) {row['state']}"
    if row["state"] != "ran":
        return text + (f": {row['message']}" if row["message"] else "")
    text += f": {row['new']}, {format_seconds(row['seconds'])}"
    for label, name in (("mIoU", "miou"), ("overall", "overall_accuracy")):
        scores = [row[f"{name}_before"], row[f"{name}_after"]]
        text += "" if None in scores else f", {label} {' to '.join(map(format_points, scores))}"
    return text


def _show(content: Mapping[str, Any], console: Console) -> None:
    rows = content["fields"]
    counts = ", ".join(f"{count} {state}" for state, count in Counter(row["state"] for row in rows).items())
    total = f"{counted(len(rows), 'run')}: {counts}" if rows else "no field matches: nothing to do"
    for line in (*map(_format_row, rows), total):
        show_text(line, console)


# --- the newest run of every field, and whether present code and weights would change it ------------------------------


def called(run: Run) -> str:
    """Return the name of the field that a run surveyed."""
    return str(run.receipt.get("survey") or run.facts.get("survey") or run.folder.name)


def fields_of(catalogue: Catalogue) -> list[list[Run]]:
    """Return the runs of each field, oldest first: those of one name, source, visit and scene, by the scene's key.

    A run without a readable receipt is a field of its own.
    """
    found: dict[str, list[Run]] = {}
    by_name = {one.folder.name: one for one in catalogue.runs}
    for run in catalogue.runs:
        lit = run
        while lit.settings.get("source") == RECORDED:  # perhaps the raw cubes of another run
            place, _, name = str(lit.settings.get("sweeps")).rpartition("/runs/")
            if not place or name == lit.folder.name or name not in by_name:
                break
            lit = by_name[name]
        asked = [lit.settings.get(name) for name in ("source", "visit")]
        found.setdefault(text_of([called(run), lit.receipt.get("scene", run.uri), *asked]), []).append(run)
    return list(found.values())


def newest_runs(catalogue: Catalogue) -> list[Run]:
    """Return the newest run of every field, oldest first."""
    newest = {runs[-1].uri for runs in fields_of(catalogue)}
    return [run for run in catalogue.runs if run.uri in newest]


def from_raw_cubes(catalogue: Catalogue, run: Run, settings: Settings) -> Settings:
    """Return settings that survey a run's own raw cubes as a recording, where its source cannot be read again.

    That is the case if captures are made otherwise by now, or if the files of a recording or scene are gone or changed.
    Raises SettingsError, BudgetError: as `asked_again`; SceneError: the raw cubes are gone too.
    """
    raw = set(
        stores_of_lines(run.products, lambda uri: uri in catalogue.stores and not catalogue.stores[uri]["cleared"])
    )
    stores = [catalogue.stores.get(uri) for uri in raw]
    if not stores or any(one is None or one["problem"] is not None or one["cleared"] for one in stores):
        lost = f"what {run.uri} showed is gone or shows something else by now"
        if settings.source == RIG:
            raise SceneError(f"{lost}, and only `spectralzoom survey` opens a rig; survey this field again")
        raise SceneError(f"{lost}; restore its scene or recording")
    asked = {"sweeps": f"{settings.out}/{run.uri}", "out": settings.out, "engine": settings.engine}
    kept = {name: getattr(settings, name) for name in OF_THE_SURVEY}
    return load_settings(None, {name: value for name, value in {**asked, **kept}.items() if value is not None})


def _is_there(run: Run, settings: Settings) -> bool:
    """Return whether the recording or scene file of a run still shows the same; True for a rig and built-in scenes."""
    if settings.source == RIG or (settings.source != RECORDED and settings.scene in BUILT_IN_SCENES):
        return True
    try:
        if settings.source == RECORDED:
            scene, _ = recorded_scene(*open_recorded(settings))
        else:
            scene = open_map(settings)[1] if settings.is_map else open_scene(settings)[0]
    except PipelineError:
        return False
    return scene.key == run.receipt.get("scene")


def is_called(run: Run, pattern: str) -> bool:
    """Return whether the survey, scene or run has this name; ``*`` matches any letters."""
    scene = str(run.settings.get("scene", ""))
    names = (called(run), scene, PurePath(scene).name, run.folder.name)
    return any(fnmatchcase(name, pattern.replace("[", "[[]").replace("?", "[?]")) for name in names)


def asked_again(run: Run, out: str | Path, weights: Path | None) -> Settings:
    """Return the settings of a run for another survey into the archive ``out``, with other ``weights`` if given.

    They name no device, so that nothing of a receipt is opened or imported: a rig has only the settings of its light.
    Raises SettingsError, BudgetError: the run's settings cannot be read, or are not of this version.
    """
    if not run.settings:
        raise SettingsError(f"the settings of {run.uri} cannot be read ({run.problem}); survey this field by hand")
    known = {key: value for key, value in run.settings.items() if key != "notes"} | dict.fromkeys(OF_THE_MACHINE)
    if isinstance(rig := known.get("rig"), Mapping):
        drivers = dict.fromkeys(("mirror_driver", "camera_driver"), FAKE)
        fakes = drivers if all(rig.get(name) == FAKE for name in drivers) else {}
        devices = {**fakes, "port": NO_PORT} if known.get("source") == RIG else {}
        known["rig"] = {name: rig[name] for name in OF_THE_LIGHT if name in rig} | devices
    try:
        return parse_settings({**known, "out": str(out), **({} if weights is None else {"weights": str(weights)})})
    except SettingsError as error:
        raise SettingsError(f"{run.uri} was surveyed by another version: {error}; survey the field anew") from error
