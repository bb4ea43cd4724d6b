"""Survey the fields of an archive again: the verb `reprocess`.

Existing stores are found by their keys; only stores that new weights or newer stages change are made.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from flows.archive.stale_runs import (
    asked_again,
    called,
    from_raw_cubes,
    generations,
    is_called,
    is_current,
    newest_runs,
)
from flows.settings.flags import ArchiveName, AsJson, Scheduler, Switch, Workers
from flows.settings.survey_settings import Settings
from flows.survey_command import run_survey
from flows.tasks.scores import score_of
from flows.terminal.figures import counted, format_points, format_seconds
from flows.terminal.processes import DONE, FAILED, PARTLY
from flows.terminal.progress import put_out, show_text, stderr
from models.weights.files import describe_weights
from pipeline.errors import PipelineError, SettingsError
from storage.archive.lineage import Catalogue
from storage.archive.records import Run, read_run
from storage.parallel.pool import THREADS, WorkerPool
from storage.remote.opening import open_archive


def reprocess(
    archive: ArchiveName,
    *,
    field: str | None = None,
    weights: Path | None = None,
    scheduler: Scheduler = "threads",
    workers: Workers = None,
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
    pool = WorkerPool(scheduler, workers)
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
    opened = open_archive(archive, create=False, write=not dry_run)
    catalogue = Catalogue.read(opened.root)
    if weights is not None:
        describe_weights(weights)  # raises an error before any survey
    fields = newest_runs(catalogue)
    wanted = fields if field is None else [run for run in fields if is_called(run, field)]
    if field is not None and not wanted:
        names = ", ".join(dict.fromkeys(map(called, fields))) or "none"
        raise SettingsError(f"--field {field}: no field of this archive has this name; there are {names}")
    rows: list[dict[str, Any]] = []
    renewed = {old.folder.name: runs[-1].folder.name for runs in generations(catalogue) for old in runs[:-1]}
    with pool.open():  # workers start once for all fields
        for number, run in enumerate(wanted, 1):
            old = run.folder.name
            title = f"{number} of {len(wanted)}: {called(run)} ({old})"
            console.print(f"[bold]reprocess {escape(title)}[/]", soft_wrap=True)
            begun = time.perf_counter()
            row = {"field": called(run), "scene": run.settings.get("scene"), "old": old, "new": None}
            row |= {"state": "failed", "message": None, **_scores(run.receipt, "before"), **_scores({}, "after")}
            try:
                settings = _settings_of(catalogue, run, str(archive), weights, pool, renewed)
                if settings is None:
                    row |= {"state": "skipped", "message": "is up to date", **_scores(run.receipt, "after")}
                elif dry_run:
                    row |= {"state": "would run"}
                else:
                    folder = run_survey(settings, console).folder
                    row |= {"new": folder.name, "state": "ran", **_scores(read_run(folder).receipt, "after")}
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
    here: dict[str, Any] = {"scheduler": pool.scheduler, "workers": pool.workers}
    settings = replace(asked_again(run, archive, weights), **here)
    prior = settings.prior
    while (newer := renewed.get(prior, prior)) != prior:
        prior = newer
    if prior == settings.prior and is_current(catalogue, run, settings):
        return None
    return replace(from_raw_cubes(catalogue, run, replace(settings, prior=prior)), **here)


def _scores(receipt: Mapping[str, Any], when: str) -> dict[str, float | None]:
    return {f"{name}_{when}": score for name, score in score_of(receipt).items()}


def _format_row(row: Mapping[str, Any]) -> str:
    text = f"{row['field']} ({row['old']}) {row['state']}"
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
