"""What `spectralzoom survey` shows: progress, the receipt as a table, and where everything lies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from rich.console import Console
from rich.markup import escape

from flows.publish.finding_words import sentences
from flows.publish.judging import publish_and_judge
from flows.publish.prefect_artifacts import progress_shown
from flows.publish.receipt_table import headline, print_table
from flows.publish.run_folder import Published
from flows.settings.survey_settings import Settings
from flows.survey.run import SurveyRun, now, open_run
from flows.survey.survey import TITLES, Products, StageRunner, Step, survey
from flows.terminal.progress import StageProgress
from models.network.process import keep_freed_memory, use_one_thread
from storage.archive.archive import Archive

Finish = Callable[[Step, Products], Published]  # what comes after the map, with what runs a stage


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
    show_published(published, run.archive, console)
    return published


def show_published(published: Published, archive: Archive, console: Console) -> None:
    """Print a run's receipt as tables and sentences, and where its files lie."""
    print_table(published.receipt, console)
    console.print(escape(headline(published.receipt, published.looked_twice)), highlight=False)
    for sentence in sentences(published.receipt):
        console.print(escape(sentence), highlight=False)
    if archive.in_bucket:
        address = f"{archive.name}/runs/{published.folder.name}"
        console.print(f"  {escape(address)}, and on this machine", highlight=False, soft_wrap=True)
    for name in ("report.html", "quicklook.png", "receipt.json"):
        console.print(f"  {escape(str(published.folder / name))}", highlight=False, soft_wrap=True)


def _survey_and_publish(run: SurveyRun, settings: Settings, console: Console, started: str) -> Published:
    """Run the stages with a bar each, publish the run once the map is drawn, and add its accuracy."""
    shown = progress_shown(run.name)
    with StageProgress(console, TITLES) as progress:

        def watch(stage: str, state: str, done: float) -> None:
            running = state == "running"
            progress.show(stage, done, "" if running else state, ended=not running)
            shown(stage, state, done)

        runner = StageRunner(replace(run, source=run.source.saying(progress.say)), watch)

        def finish(step: Step, products: Products) -> Published:
            return publish_and_judge(
                runner,
                step,
                products,
                started,
                lambda words: console.print(escape(words), highlight=False, soft_wrap=True),
            )

        return _run(runner, settings.engine, console, finish)


def _run(runner: StageRunner, engine: str, console: Console, finish: Finish) -> Published:
    if engine != "plain":
        from flows.survey.prefect_engine import EngineUnavailable, survey_with_prefect

        try:
            return survey_with_prefect(runner, finish)
        except EngineUnavailable as error:
            console.print(f"[yellow]{escape(str(error))}; going on with --engine plain[/]", highlight=False)
    return finish(runner, survey(runner))
