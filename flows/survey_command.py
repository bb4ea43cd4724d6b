"""What `spectralzoom survey` shows: progress, the receipt as a table, and where everything lies."""

from __future__ import annotations

from dataclasses import replace

from rich.console import Console
from rich.markup import escape

from flows.finding_words import sentences
from flows.progress import StageProgress
from flows.publish import Published, publish_run
from flows.receipt_table import headline, print_table
from flows.run import SurveyRun, now, open_run
from flows.settings import Settings
from flows.survey import TITLES, Products, StageRunner, survey
from flows.survey_artifacts import progress_shown
from models.process import keep_freed_memory, use_one_thread


def run_survey(settings: Settings, console: Console) -> Published:
    """Survey, publish the run and print its receipt on ``console``."""
    started = now()
    use_one_thread()
    keep_freed_memory()
    with console.status("opening scene and weights"):
        run = open_run(settings)
        run.archive.reclaim()  # what a killed run left half made
    for note in run.notes:
        console.print(f"[dim]note: {escape(note)}[/]", highlight=False)
    with run.archive.in_use(), settings.crew.open():
        published = _survey_and_publish(run, settings, console, started)
    print_table(published.receipt, console)
    console.print(escape(headline(published.receipt, published.looked_twice)), highlight=False)
    for sentence in sentences(published.receipt):
        console.print(escape(sentence), highlight=False)
    if run.archive.in_bucket:
        address = f"{run.archive.name}/runs/{published.folder.name}"
        console.print(f"  {escape(address)}, and on this machine", highlight=False, soft_wrap=True)
    for name in ("report.html", "quicklook.png", "receipt.json"):
        console.print(f"  {escape(str(published.folder / name))}", highlight=False, soft_wrap=True)
    return published


def _survey_and_publish(run: SurveyRun, settings: Settings, console: Console, started: str) -> Published:
    """Run the stages with a bar each, then draw and publish what they left."""
    shown = progress_shown(run.name)
    with StageProgress(console, TITLES) as progress:

        def watch(stage: str, state: str, done: float) -> None:
            running = state == "running"
            progress.show(stage, done, "" if running else state, ended=not running)
            shown(stage, state, done)

        rig = None if run.rig is None else run.rig.saying(progress.say)
        runner = StageRunner(replace(run, rig=rig), watch)
        products = _run(runner, settings.engine, console)
    with console.status("drawing pictures and report"):
        published = publish_run(runner, products, started)
    return published


def _run(runner: StageRunner, engine: str, console: Console) -> Products:
    if engine == "plain":
        return survey(runner, runner.run.settings.rounds)
    from flows.engine import EngineUnavailable, survey_with_prefect

    try:
        return survey_with_prefect(runner)
    except EngineUnavailable as error:
        console.print(f"[yellow]{escape(str(error))}; going on with --engine plain[/]", highlight=False)
        return survey(runner, runner.run.settings.rounds)
