"""Run the verb `survey`: the flow with progress bars, then a summary of the receipt."""

from __future__ import annotations

import atexit
import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.plan_command import dry_run
from spectralzoom.flows.local_server import (
    BOUNDED,
    QUIET,
    ServerUnavailable,
    configured,
    local_server,
    server_answers,
    silence_of,
)
from spectralzoom.flows.observer import Observer, observed_by
from spectralzoom.flows.opening.scene import farm_refusal
from spectralzoom.flows.publish.publishing import RunRef
from spectralzoom.flows.publish.receipt import load_receipt
from spectralzoom.flows.publish.receipt_table import print_summary
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.survey import carry_out
from spectralzoom.flows.survey_field import survey_field
from spectralzoom.flows.terminal.progress import StageProgress, show_warnings
from spectralzoom.models.network.machine import give_back_freed_memory, keep_freed_memory, use_one_thread
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked, remove

STARTED_WITHIN_S, RECORDED_WITHIN_S = 10.0, 5.0
MOST_LETTERS = 120  # of an error of Prefect


@dataclass
class FlowWork:
    """Call the work of a flow, and keep its outcome where Prefect's server cannot take it."""

    run: RunRef | None = None
    error: BaseException | None = None

    def __call__(self, work: Callable[[], RunRef]) -> RunRef:
        """Return the run of the work. Raises ServerUnavailable: the server no longer answers; else as the work."""
        try:
            self.run = work()
        except BaseException as error:
            self.error = error
            raise
        if not server_answers():  # Prefect would try to record the end for longer
            raise ServerUnavailable("no answer")
        return self.run

    def without_server(self, settings: Settings, error: Exception, note: Callable[[str], None]) -> RunRef:
        """Return the run of a flow that Prefect ended with an error, carried out without it if need be.

        Raises what the work raised.
        """
        if self.error is not None:
            raise self.error
        ends = "the run is published"
        if self.run is None or self.run.stopped is not None:
            ends = "it continues with --engine plain" if self.run is None else "its stages are stored"
        lines = str(error).splitlines() or [type(error).__name__]
        note(
            f"Prefect's server does not answer as expected ({lines[0][:MOST_LETTERS]}), and misses this survey: {ends}"
        )
        return survey_field(settings) if self.run is None else self.run


def run_survey(settings: Settings, console: Console, *, verbose: bool = False, summary: bool = True) -> Published:
    """Survey, publish the run and print its ``summary`` on ``console``; with ``verbose`` also its stages and effects.

    Raises PipelineError: of the flow; SurveyStopped: the settings stop the survey before its class map.
    """
    gc.collect()
    give_back_freed_memory()  # of a survey before
    keep_freed_memory()
    with StageProgress(console) as progress:

        def note(text: str) -> None:
            console.print(f"[dim]note: {escape(text)}[/]", soft_wrap=True)

        def warn(text: str) -> None:
            show_warnings([text], console)

        work = FlowWork()
        with observed_by(Observer(progress.watch, note, warn, progress.say, carry=work)):
            run = _survey(settings, console, work, note)
    if run.stopped is not None:
        raise run.stopped
    published = Published(load_receipt(run.folder), run.folder)
    if summary:
        print_summary(published.receipt, console, verbose=verbose)
        console.print(f"Report: {escape(str(published.folder / 'report.html'))}", soft_wrap=True)
    else:
        show_warnings(warnings_of(published.receipt), console)
    return published


def _survey(settings: Settings, console: Console, work: FlowWork, note: Callable[[str], None]) -> RunRef:
    """Run the flow on a server of this process or at PREFECT_API_URL; without Prefect where that fails or stops.

    Inside another flow its tasks become tasks of that flow. Without a stage to make, only the run is published.
    """
    if not inside_flow() and (run := _publish_stored(settings)) is not None:
        return run
    use_one_thread()
    if settings.engine != "plain" and not inside_flow():
        try:
            with _prefect_server(settings.out):
                from spectralzoom.flows.prefect_flow import survey  # Prefect takes a second, and reads settings once

                state = survey(settings, return_state=True)
                _wait_until_recorded(state.state_details.flow_run_id)
                return state.result()
        except ServerUnavailable as error:
            if work.run is not None:
                return work.without_server(settings, error, note)
            console.print(f"[yellow]{escape(str(error))}; the survey runs with --engine plain[/]")
        except Exception as error:
            return work.without_server(settings, error, note)
    return survey_field(settings)


def _publish_stored(settings: Settings) -> RunRef | None:
    """Publish a survey whose stages are all stored; None where one is to be made, or the server of the user records it.

    Raises PipelineError: the settings are refused, before a server starts.
    """
    started = datetime.now(UTC)
    if (refused := farm_refusal(settings)) is not None:
        raise SettingsError(refused)
    plan, stores = dry_run(settings)
    if any(row.state not in ("cached", "left out") for row in stores.rows.values()) or "PREFECT_API_URL" in os.environ:
        return None
    return carry_out(plan, started)


@contextmanager
def _prefect_server(out: str) -> Iterator[None]:
    """Start a server for one survey, with its files in the archive, or use the one at PREFECT_API_URL.

    A second survey of the archive has a temporary folder of its own. Raises ServerUnavailable.
    """
    root = Archive.open(out).root
    home = root / ".prefect"
    if (named := os.environ.get("PREFECT_API_URL")) is not None:
        if (why := silence_of(named, STARTED_WITHIN_S)) is not None:
            raise ServerUnavailable(
                f"no Prefect server answers at {named}, which PREFECT_API_URL names ({why}): start it, or unset that"
            )
        with configured(home, usual=BOUNDED | QUIET):
            yield
        return
    with locked(root / ".locks" / "prefect.lock", wait=False) as is_held:
        if not is_held:
            home = root / f".prefect-{os.getpid()}"
            atexit.register(remove, home)
        with local_server(home):
            yield


def _wait_until_recorded(flow_run: Any) -> None:
    """Wait for the final states of the tasks of a flow run, for 5 s at most: they are reported in batches."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowRunFilter

    of_run = FlowRunFilter.model_validate({"id": {"any_": [flow_run]}})
    end = time.monotonic() + RECORDED_WITHIN_S
    with suppress(Exception), get_client(sync_client=True) as client:  # the server may have stopped
        while time.monotonic() < end:
            if all(run.state and run.state.is_final() for run in client.read_task_runs(flow_run_filter=of_run)):
                return
            time.sleep(0.1)
