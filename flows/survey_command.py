"""Run the verb `survey`: the flow with progress bars, then a summary of the receipt."""

from __future__ import annotations

import atexit
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.plan_command import dry_run
from spectralzoom.flows.field import open_field
from spectralzoom.flows.plan import plan_survey
from spectralzoom.flows.publish.publishing import RunRef
from spectralzoom.flows.publish.receipt import load_receipt
from spectralzoom.flows.publish.receipt_table import print_summary
from spectralzoom.flows.publish.run_folder import Published
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.survey import carry_out, survey_field
from spectralzoom.flows.tasks.local_server import (
    ServerUnavailable,
    check_answers,
    local_server,
    quiet_environment,
    wait_until_recorded,
)
from spectralzoom.flows.tasks.observer import Observer, observed_by
from spectralzoom.flows.tasks.scene import farm_refusal
from spectralzoom.flows.terminal.progress import StageProgress
from spectralzoom.models.network.machine import give_back_freed_memory, keep_freed_memory, use_one_thread
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import locked, remove


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

        with observed_by(Observer(progress.watch, note, progress.say)):
            run = _survey(settings, console)
    if run.stopped is not None:
        raise run.stopped
    published = Published(load_receipt(run.folder), run.folder)
    if summary:
        print_summary(published.receipt, console, verbose=verbose)
        console.print(f"Report: {escape(str(published.folder / 'report.html'))}", soft_wrap=True)
    return published


def _survey(settings: Settings, console: Console) -> RunRef:
    """Run the flow on a server of this process or at PREFECT_API_URL; without Prefect where that fails.

    Inside another flow its tasks become tasks of that flow. Without a stage to make, only the run is published.
    """
    if not inside_flow() and (run := _publish_stored(settings)) is not None:
        return run
    use_one_thread()
    if settings.engine != "plain" and not inside_flow():
        from spectralzoom.flows.prefect_flow import survey  # Prefect takes a second

        try:
            with _prefect_server(settings.out):
                state = survey(settings, return_state=True)
                wait_until_recorded(state.state_details.flow_run_id)
                return state.result()
        except ServerUnavailable as error:
            console.print(f"[yellow]{escape(str(error))}; the survey runs with --engine plain[/]")
    return survey_field(settings)


def _publish_stored(settings: Settings) -> RunRef | None:
    """Publish a survey whose stages are all stored; None where one is to be made, or the server of the user records it.

    Raises PipelineError: the settings are refused, before a server starts.
    """
    started = datetime.now(UTC)
    if (refused := farm_refusal(settings)) is not None:
        raise SettingsError(refused)
    plan, stores = dry_run(settings)
    if any(row.state != "cached" for row in stores.rows.values()) or "PREFECT_API_URL" in os.environ:
        return None
    if plan.field.raster is not None:  # notes on its unit need values and weights
        plan = plan_survey(open_field(settings))
    return carry_out(plan, started)


@contextmanager
def _prefect_server(out: str) -> Iterator[None]:
    """Start a server for one survey, with its files in the archive, or use the one at PREFECT_API_URL.

    A second survey of the archive has a temporary folder of its own. Raises ServerUnavailable.
    """
    if "PREFECT_API_URL" in os.environ:
        check_answers(os.environ["PREFECT_API_URL"])
        yield
        return
    root = Archive.open(out).root
    home = root / ".prefect"
    with locked(root / ".locks" / "prefect.lock", wait=False) as is_held:
        if not is_held:
            home = root / f".prefect-{os.getpid()}"
            atexit.register(remove, home)
        with quiet_environment(home), local_server(home):
            yield
