"""Publish the run of a survey, add its accuracy, and create Prefect's artifact.

A run is published as soon as it has a class map, and its accuracy is added later. A survey that was stopped in between
continues with the run that it has published.
"""

from __future__ import annotations

import base64
import io
import json
from contextlib import suppress

from flows.publish.receipt import is_pending
from flows.publish.receipt_table import finding_rows, headline
from flows.publish.report import render_markdown
from flows.publish.retention import is_outlived
from flows.publish.run_folder import Published, asked_settings, extend_with_accuracy, make_receipt, publish_draft
from flows.settings.survey_settings import OF_THE_MACHINE
from flows.settings.values import KEEP_SIGNAL
from flows.tasks.open_survey import STAGES, OpenSurvey, RunRef
from flows.tasks.prefect_tasks import as_task, inside_flow, prefect_artifacts
from flows.tasks.stages.accuracy import evaluate
from flows.tasks.stages.attention import load_plan
from flows.tasks.stages.capture import capture_coarse, capture_fine
from flows.tasks.stages.condense import raw_differs
from storage.archive.keys import StageRef, canonical_json
from storage.archive.lineage import Catalogue
from storage.archive.records import Run, read_run
from storage.archive.whole_files import to_json

PASSES = (capture_fine.name, capture_coarse.name)  # in the order in which they are condensed
NOT_ASKED = ("notes", "out", "engine", *OF_THE_MACHINE)  # settings without an effect on the results
WIDTH_PX = 800  # of the picture in the text


def publish(survey: OpenSurvey) -> RunRef:
    """Publish the run of a class map, with its accuracy if that is in the archive; in a flow as a task."""
    return as_task(_publish, "publish")(survey, *survey.products.values())


def _publish(survey: OpenSurvey, *products: StageRef) -> RunRef:
    if (stopped := _stopped_run(survey)) is not None:
        survey.observer.note(f"published before: {stopped.folder}; its accuracy is added to it")
        return stopped
    judged = survey.run.scene.labelled and survey.run.settings.accuracy
    if judged and _accuracy_is_stored(survey):
        survey(evaluate.name, *survey.products.judged)
        judged = False
    _clear_first_mosaic(survey)
    plan = load_plan(survey.products["score"])
    with survey.run.archive.new_run(survey.run.name) as draft:
        published = publish_draft(survey, draft, plan, make_receipt(survey, plan, f"runs/{draft.id}"))
    if not (survey.run.plan.plain or plan.sweeps):
        survey.observer.note(f"no second pass: {plan.reason}")
    if judged:
        survey.observer.note(f"published: {published.folder}; accuracy follows")
    _show_artifact(survey, published)
    return _ref(published, pending=judged)


def add_accuracy(survey: OpenSurvey, run: RunRef, accuracy: StageRef) -> RunRef:
    """Replace a published run by one with its accuracy."""
    draft = survey.run.archive.extend_run(run.name)
    assert draft is not None
    with draft:
        published = extend_with_accuracy(survey, draft, accuracy)
    _show_artifact(survey, published)
    return _ref(published)


def clear_raw(survey: OpenSurvey, run: RunRef) -> RunRef:
    """Compare and clear the raw lines that the settings do not keep; in a flow as a task."""
    if survey.run.settings.keep != KEEP_SIGNAL or not survey.products.there(*PASSES):
        return run
    return as_task(_clear_raw, "clear_raw")(survey, run)


def _clear_raw(survey: OpenSurvey, run: RunRef) -> RunRef:
    archive = survey.run.archive
    passes = survey.products.there(*PASSES)
    if not survey.products.signals or any(archive.find(raw.stage, raw.key) is None for raw in passes):
        return run  # cleared before
    archive.refresh()
    catalogue = Catalogue.read(archive.root)
    others = [one for raw in passes for one in catalogue.named_by(raw.uri) if not is_outlived(one, archive.now())]
    kept = f"{others[0].uri} keeps them" if others else None
    why = kept or raw_differs(passes, survey.products.signals[0], survey.run.camera)
    if any(archive.find(raw.stage, raw.key) is None for raw in passes):
        return run  # cleared meanwhile, by another survey
    if why is not None:
        survey.observer.note(f"raw lines stay: {why}")
        return run
    for raw in passes:
        archive.clear(raw, wait=False)
    return run


def _clear_first_mosaic(survey: OpenSurvey) -> None:
    """Clear the mosaic of the first pass, whose lines are in that of both passes."""
    archive = survey.run.archive
    first = survey.products.get("rectify")
    if first is None or "rectify_fine" not in survey.products or survey.registers:  # fine sweeps are registered on it
        return
    archive.refresh()
    if not any(run.products.get("mosaic", "").startswith(first.uri) for run in Catalogue.read(archive.root).runs):
        archive.clear(first, wait=False)


def _ref(published: Published, *, pending: bool = False) -> RunRef:
    return RunRef(f"runs/{published.folder.name}", published.folder, published.captured_again, pending)


def _accuracy_is_stored(survey: OpenSurvey) -> bool:
    try:
        one = STAGES[evaluate.name]
        return one.find(survey.run.archive, one.wants(survey.run, *survey.products.judged)) is not None
    except Exception:  # the evaluation reports the error, after the run is published
        return False


def _stopped_run(survey: OpenSurvey) -> RunRef | None:
    """Return the run that the same survey published before it was stopped; None without one, or if it is locked."""
    for folder in reversed(survey.run.archive.runs()):
        if not _is_stopped(survey, read_run(folder)):
            continue
        if (draft := survey.run.archive.extend_run(folder.name, wait=False)) is not None:
            draft.abandon()  # it was free
            if _is_stopped(survey, read_run(folder)):  # and not judged since
                return RunRef(f"runs/{folder.name}", folder, pending=True)
    return None


def _is_stopped(survey: OpenSurvey, run: Run) -> bool:
    if run.problem is not None or not is_pending(run.receipt):
        return False
    stores = {name: one.key for name, one in survey.records.items()}
    found = {str(row.get("name")): row.get("key") for row in run.stages}
    asked = (
        canonical_json(json.loads(to_json({name: value for name, value in given.items() if name not in NOT_ASKED})))
        for given in (run.settings, asked_settings(survey.run))
    )
    return found == stores and len(set(asked)) == 1


def _show_artifact(survey: OpenSurvey, published: Published) -> None:
    """Create the artifact of a run in the present flow: score, picture, findings, and where its files are."""
    if not inside_flow():
        return
    letters = (letter if letter.isalnum() and letter.isascii() else "-" for letter in survey.run.name.lower())
    key = "".join(letters).strip("-")
    where = f"{survey.run.archive.name}/runs/{published.folder.name}"
    with suppress(Exception):  # without a server the archive has everything
        text = render_markdown(
            "survey.md",
            survey=published.receipt["survey"],
            headline=headline(published.receipt, published.captured_again),
            picture=base64.b64encode(small_jpeg((published.folder / "quicklook.png").read_bytes())).decode("ascii"),
            findings=[f"{name}: {text}" for name, text in finding_rows(published.receipt)],
            where=where,
        )
        prefect_artifacts.create_markdown_artifact(text, key=f"survey-{key}", description=where)


def small_jpeg(png: bytes) -> bytes:
    """Return a picture as a JPEG of at most 800 px width, which stays below 100 KiB in base64."""
    from PIL import Image

    file = io.BytesIO()
    with Image.open(io.BytesIO(png)) as opened:
        picture = opened.convert("RGB")
    picture.thumbnail((WIDTH_PX, 10 * WIDTH_PX))
    picture.save(file, "JPEG", quality=60, optimize=True)
    return file.getvalue()
