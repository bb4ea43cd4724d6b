"""Publish the run of a survey once, create Prefect's artifact, and clear the raw lines that are not kept."""

from __future__ import annotations

import base64
import io
from contextlib import suppress

from spectralzoom.flows.publish.receipt_table import finding_rows, headline
from spectralzoom.flows.publish.report import render_markdown
from spectralzoom.flows.publish.run_folder import Published, publish_run
from spectralzoom.flows.settings.values import KEEP_SIGNAL
from spectralzoom.flows.tasks.open_survey import OpenSurvey, RunRef
from spectralzoom.flows.tasks.prefect_tasks import as_task, inside_flow
from spectralzoom.flows.tasks.stages.attention import load_plan
from spectralzoom.flows.tasks.stages.capture import capture_coarse, capture_fine
from spectralzoom.flows.tasks.stages.condense import raw_differs
from spectralzoom.storage.runs import Catalogue
from spectralzoom.storage.store import Ref

PASSES = (capture_fine.name, capture_coarse.name)  # in the order in which they are condensed
WIDTH_PX = 800  # of the picture in the text


def publish(survey: OpenSurvey) -> RunRef:
    """Publish the run of a class map, with its accuracy where it was evaluated; in a flow as a task."""
    return as_task(_publish, "publish")(survey, *survey.products.values())


def _publish(survey: OpenSurvey, *products: Ref) -> RunRef:
    _clear_first_mosaic(survey)
    plan = load_plan(survey.products["score"])
    published = publish_run(survey, plan)
    if not (survey.run.plan.plain or plan.sweeps):
        survey.observer.note(f"no second pass: {plan.reason}")
    _show_artifact(survey, published)
    return RunRef(f"runs/{published.folder.name}", published.folder)


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
    catalogue = Catalogue.read(archive)
    others = [one for raw in passes for one in catalogue.named_by(raw.uri) if one.settings.get("keep") != KEEP_SIGNAL]
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
    if not any(run.products.get("mosaic", "").startswith(first.uri) for run in Catalogue.read(archive).runs):
        archive.clear(first, wait=False)


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
            headline=headline(published.receipt),
            picture=base64.b64encode(small_jpeg((published.folder / "quicklook.png").read_bytes())).decode("ascii"),
            findings=[f"{name}: {text}" for name, text in finding_rows(published.receipt)],
            where=where,
        )
        from prefect.artifacts import create_markdown_artifact

        create_markdown_artifact(text, key=f"survey-{key}", description=where)


def small_jpeg(png: bytes) -> bytes:
    """Return a picture as a JPEG of at most 800 px width, which stays below 100 KiB in base64."""
    from PIL import Image

    file = io.BytesIO()
    with Image.open(io.BytesIO(png)) as opened:
        picture = opened.convert("RGB")
    picture.thumbnail((WIDTH_PX, 10 * WIDTH_PX))
    picture.save(file, "JPEG", quality=60, optimize=True)
    return file.getvalue()
