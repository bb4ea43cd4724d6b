"""Verbs of schedules: serve fields, and report what became of them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from flows.cli.app import ArchiveName, AsJson, OutFile, app, stderr
from flows.terminal.shown_text import print_json


@app.command
def serve(
    *fields: Path,
    cron: str | None = None,
    every: str | None = None,
    timezone: str | None = None,
    out: str | None = None,
    limit: int = 1,
    late: float = 0.5,
    engine: Literal["prefect", "plain"] = "prefect",
    port: int = 4200,
    notify: str | None = None,
) -> int:
    """Survey fields on a schedule, one after another, until stopped; every due run is done, skipped by rule, or failed.

    Parameters
    ----------
    fields
        A settings file for each field, in turn.
    cron
        When all of them are due: minute hour day month weekday, such as '0 6-20 * * *'.
    every
        Or how often: 30m, 2h, 1d; counted from midnight UTC of 1970, not from now.
    timezone
        Of --cron, such as Europe/Berlin; this machine's by default.
    out
        Archive for all fields, a folder or s3://bucket/prefix; by default that of each field's settings.
    limit
        Surveys at a time, by Prefect; of one rig it is always one.
    late
        Share of the time to the next due one after which a run may not begin any more: it is skipped.
    engine
        `prefect`, with pages to look at, or `plain`, in this process alone.
    port
        Of Prefect's pages on this machine; a server that PREFECT_API_URL names is used instead.
    notify
        Address that is told of failed and skipped runs, a POST of JSON, or a file that holds it: what stands on the
        command line is in the process list. SPECTRALZOOM_NOTIFY in the environment does as well. By default nobody.
    """
    from flows.schedule.serve_command import ServeChoice, run_serve

    choice = ServeChoice(
        files=fields,
        cron=cron,
        every=every,
        timezone=timezone,
        out=out,
        limit=limit,
        late=late,
        engine=engine,
        port=port,
        notify=notify,
    )
    return run_serve(choice, stderr)


@app.command
def report(archive: ArchiveName, *, field: str | None = None, out: OutFile, as_json: AsJson = False) -> int:
    """Write a field's history as one page that opens from disk: dates, class areas, savings, failures.

    Parameters
    ----------
    field
        What it is called; without one an index of all fields is written, beside a page for each.
    out
        The page to write.
    """
    from flows.schedule.history_page import run_report

    content = run_report(archive, field, out, stderr)
    if as_json:
        print_json(content)
    return 0
