"""What `spectralzoom survey` does and shows: progress, the run published and then judged, the receipt; Prefect's pages.

A map is judged once its run is published, so that nothing that is lost then is the map; the accuracy is then added to
the run. A survey that was stopped meanwhile goes on with the run that it had published.
"""

from __future__ import annotations

import base64
import io
import json
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape

from flows.publish.receipt import Receipt, is_pending
from flows.publish.receipt_table import COST_LABELS, cost_rows, print_table
from flows.publish.receipt_words import headline, sentences
from flows.publish.report import render_markdown
from flows.publish.run_folder import Published, add_accuracy, asked_settings, publish_run
from flows.settings.survey_settings import OF_THE_MACHINE, Settings
from flows.survey.prefect_engine import EngineUnavailable, inside_flow, survey_with_prefect
from flows.survey.run import SurveyRun, now, open_run
from flows.survey.survey import STAGES, TITLES, Products, StageRunner, Step, judge, survey
from flows.terminal.figures import format_percent
from flows.terminal.progress import StageProgress
from models.network.machine import keep_freed_memory, use_one_thread
from pipeline.lazy import deferred
from storage.archive.archive import Archive
from storage.archive.keys import canonical_json
from storage.archive.records import Run, read_run
from storage.archive.run_folders import RunDraft
from storage.archive.whole_files import to_json

if TYPE_CHECKING:
    import prefect.artifacts as prefect_artifacts
else:
    prefect_artifacts = deferred("prefect.artifacts")


def run_survey(settings: Settings, console: Console) -> Published:
    """Survey, publish the run and print its receipt on ``console``."""
    started = now()
    use_one_thread()
    keep_freed_memory()
    with console.status("opening scene and weights"):
        run = open_run(settings)
        run.archive.reclaim()  # what a killed run left half made
    for note in run.notes:
        console.print(f"[dim]note: {escape(note)}[/]")
    with run.archive.in_use(), settings.crew.open():
        published = _survey_and_publish(run, settings, console, started)
    show_published(published, run.archive, console)
    return published


def show_published(published: Published, archive: Archive, console: Console) -> None:
    """Print a run's receipt as tables and sentences, and where its files lie."""
    print_table(published.receipt, console)
    console.print(escape(headline(published.receipt, published.looked_twice)))
    for sentence in sentences(published.receipt):
        console.print(escape(sentence))
    if archive.in_bucket:
        address = f"{archive.name}/runs/{published.folder.name}"
        console.print(f"  {escape(address)}, and on this machine", soft_wrap=True)
    for name in ("report.html", "quicklook.png", "receipt.json"):
        console.print(f"  {escape(str(published.folder / name))}", soft_wrap=True)


def _survey_and_publish(run: SurveyRun, settings: Settings, console: Console, started: str) -> Published:
    """Run the stages with a bar each, publish the run once the map is drawn, and add its accuracy."""
    shown = progress_shown(run.name)
    with StageProgress(console, TITLES) as progress:

        def watch(stage: str, state: str, done: float) -> None:
            progress.watch(stage, state, done)
            shown(stage, state, done)

        runner = StageRunner(replace(run, source=run.source.saying(progress.say)), watch)

        def tell(words: str) -> None:
            console.print(escape(words), soft_wrap=True)

        def finish(step: Step, products: Products) -> Published:
            return publish_and_judge(runner, step, products, started, tell)

        if settings.engine != "plain":
            try:
                return survey_with_prefect(runner, finish)
            except EngineUnavailable as error:
                console.print(f"[yellow]{escape(str(error))}; going on with --engine plain[/]")
        return finish(runner, survey(runner))


JUDGE = STAGES["evaluate"]
NOT_ASKED = ("notes", "out", "engine", *OF_THE_MACHINE)  # of a receipt's settings: no byte depends on them


def publish_and_judge(
    runner: StageRunner, step: Step, products: Products, started: str, tell: Callable[[str], None]
) -> Published:
    """Publish the run of a map, then judge the map and add its accuracy to the run.

    Where there is nothing to judge by, or the archive holds the accuracy, the run is published once, with all of it.
    ``step`` runs the stage that judges; ``started`` is when the survey began, ISO 8601; ``tell`` is given a line once
    the run is there and the map is about to be judged.
    """
    run = runner.run
    draft = _draft_of_stopped(runner)
    if draft is None and not _takes_time(run, products):
        return publish_run(runner, judge(step, products), started)
    if draft is not None:
        tell(f"published before: {draft.published}; its accuracy is added to it")
    else:
        published = publish_run(runner, products, started)
        tell(f"published: {published.folder}; its accuracy is judged now and added to it")
        draft = run.archive.extend_run(published.folder.name)
        assert draft is not None
    with draft:
        judged = judge(step, products)
        return add_accuracy(run, draft, judged, runner.records[JUDGE.name])


def _takes_time(run: SurveyRun, products: Products) -> bool:
    """Whether there is a map to judge, and no stored accuracy of it."""
    if not run.scene.labelled or not run.settings.accuracy:
        return False
    try:
        wanted = JUDGE(run, *products.there(JUDGE.of))
        return wanted is not None and JUDGE.find(run.archive, wanted) is None
    except Exception:  # what is wrong is said when the map is judged: until then it is published
        return True


def _draft_of_stopped(runner: StageRunner) -> RunDraft | None:
    """The run that the same survey published before it was stopped; None where there is none, or it is being judged."""
    archive = runner.run.archive
    for folder in reversed(archive.runs()):
        if _is_stopped(runner, read_run(folder, {})):
            draft = archive.extend_run(folder.name, wait=False)
            if draft is None:
                continue
            if _is_stopped(runner, read_run(folder, {})):  # and not judged since
                return draft
            draft.abandon()
    return None


def _is_stopped(runner: StageRunner, run: Run) -> bool:
    if run.problem is not None or not is_pending(run.receipt):
        return False
    stores = {name: one.key for name, one in runner.records.items()}
    found = {str(row.get("name")): row.get("key") for row in run.stages}
    asked = (
        canonical_json(json.loads(to_json({name: value for name, value in given.items() if name not in NOT_ASKED})))
        for given in (run.settings, asked_settings(runner.run))
    )
    return found == stores and len(set(asked)) == 1


MOST_BYTES = 100 * 1024  # of the picture, as it stands in the text
WIDTHS_PX = (1200, 1000, 800, 600, 400, 200)


def publish_artifacts(published: Published, field: str, archive: str) -> None:
    """Give a survey's text and table to the Prefect server of the flow that this is called in."""
    key, where = artifact_key(field), f"{archive}/runs/{published.folder.name}"
    text = survey_markdown(published, where)
    prefect_artifacts.create_markdown_artifact(text, key=f"survey-{key}", description=where)
    prefect_artifacts.create_table_artifact(savings_rows(published.receipt), key=f"savings-{key}", description=where)


def artifact_key(field: str) -> str:
    """A field's name as Prefect's keys are: small letters, digits and dashes."""
    return "".join(letter if letter.isalnum() and letter.isascii() else "-" for letter in field.lower()).strip("-")


def survey_markdown(published: Published, where: str) -> str:
    """Headline, quicklook (at most 100 KiB), receipt, and where the report lies."""
    picture = small_jpeg((published.folder / "quicklook.png").read_bytes())
    return render_markdown(
        "survey.md",
        survey=published.receipt["survey"],
        headline=headline(published.receipt, published.looked_twice),
        picture=base64.b64encode(picture).decode("ascii"),
        rows=savings_rows(published.receipt),
        findings=sentences(published.receipt),
        where=where,
    )


def savings_rows(receipt: Receipt) -> list[dict[str, str]]:
    """The receipt's savings, a row each, in words."""
    return [
        {
            "cost": row["label"],
            "this survey": row["done"],
            "everything": row["full"],
            "share": format_percent(row["ratio"]),
        }
        for row in cost_rows(receipt["savings"])[: len(COST_LABELS)]
    ]


def small_jpeg(png: bytes) -> bytes:
    """A picture as a JPEG that takes at most 100 KiB in base64, as large as that lets it be."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as opened:
        picture = opened.convert("RGB")
    for width in WIDTHS_PX:
        smaller = picture.copy()
        smaller.thumbnail((width, 10 * width))
        for quality in (85, 70):
            file = io.BytesIO()
            smaller.save(file, "JPEG", quality=quality, optimize=True)
            if len(file.getvalue()) * 4 / 3 <= MOST_BYTES - 4:
                return file.getvalue()
    return file.getvalue()


def progress_shown(field: str) -> Callable[[str, str, float], None]:
    """What shows on Prefect's pages how far stages are, every two seconds at most: nothing outside of a flow."""
    if not inside_flow():
        return lambda stage, state, done: None
    shown: dict[str, Any] = {}
    last: dict[str, float] = {}

    def show(stage: str, state: str, done: float) -> None:
        """Bring a stage's bar up to date, or begin it; that Prefect does not answer stops no survey."""
        now = time.monotonic()
        if now - last.setdefault(stage, now) < 2.0 and not (stage in shown and state != "running"):
            return
        last[stage] = now
        with suppress(Exception):
            if stage in shown:
                prefect_artifacts.update_progress_artifact(shown[stage], progress=round(100 * done, 1))
            else:
                key = f"{stage.replace('_', '-')}-{artifact_key(field)}"
                shown[stage] = prefect_artifacts.create_progress_artifact(100 * done, key=key, description=stage)

    return show
