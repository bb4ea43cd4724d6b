"""Publish the run of a survey once, create Prefect's artifact, and clear the raw lines that are not kept."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from spectralzoom.flows.local_server import server_answers
from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.products import Control, Products
from spectralzoom.flows.publish.receipt import load_receipt
from spectralzoom.flows.publish.receipt_table import finding_rows, format_score, headline
from spectralzoom.flows.publish.report import render_markdown
from spectralzoom.flows.publish.run_folder import Published, publish_run
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.values import KEEP_SIGNAL
from spectralzoom.flows.stage import Stores, inside_flow, task_in_flow
from spectralzoom.flows.stages.condense import raw_differs
from spectralzoom.flows.stages.score import load_plan
from spectralzoom.pipeline.errors import SurveyStopped
from spectralzoom.storage.runs import Catalogue
from spectralzoom.storage.store import Archive, Ref

WIDTH_PX = 800  # of the picture in the text
Note = Callable[[str], None]


@dataclass(frozen=True)
class RunRef:
    """Address of a published run."""

    uri: str  # relative to the archive
    folder: Path
    stopped: SurveyStopped | None = None  # at the store of this address, before a run was published


def outcome(run: RunRef) -> str:
    """Return the address, the warnings and the score of a run in a line, or where the survey was stopped."""
    if run.stopped is not None:
        return str(run.stopped)
    receipt = load_receipt(run.folder)
    return f"{run.uri}: {'. '.join([*map('Warning: {}'.format, warnings_of(receipt)), format_score(receipt)])}"


def publish(
    stores: Stores, plan: SurveyPlan, products: Products, control: Control | None, *, started: datetime, note: Note
) -> RunRef:
    """Publish the run of a class map, with its accuracy where it was evaluated; in a flow as a task."""

    def work(*_: Ref) -> RunRef:
        published = publish_run(stores, plan, products, control, started)
        fine = load_plan(products.attention)
        if not (plan.passes.plain or fine.sweeps):
            note(f"no second pass: {fine.reason}")
        _show_artifact(plan.field.name, stores.archive.name, published)
        return RunRef(f"runs/{published.folder.name}", published.folder)

    return task_in_flow("publish", stores.name, work, *stores.refs)


def clear_raw(stores: Stores, plan: SurveyPlan, products: Products, run: RunRef, *, note: Note) -> RunRef:
    """Compare and clear the raw lines that the settings do not keep; in a flow as a task."""
    raws = [one.raw for one in products.passes if stores.has(one.raw)]

    def work(*_: Ref) -> RunRef:
        archive = stores.archive
        if raws:
            catalogue = Catalogue.read(archive)
            named = (one for raw in raws for one in catalogue.named_by(raw.uri))
            others = [one for one in named if one.settings.get("keep") != KEEP_SIGNAL]
            kept = f"{others[0].uri} keeps them" if others else None
            why = kept or raw_differs(raws, products.passes[0].signal, plan.field.camera)
            if why is not None and all(map(stores.has, raws)):
                note(f"raw lines stay: {why}")
            for raw in raws if why is None else ():
                archive.clear(raw, wait=False)
        return run

    return task_in_flow("clear_raw", stores.name, work, *raws) if raws and plan.settings.keep == KEEP_SIGNAL else run


def clear_intermediate(archive: Archive, plan: SurveyPlan, products: Products) -> None:
    """Clear the overview, and the mosaic of the first pass, whose lines are in that of both passes."""
    if products.overview is not None:
        archive.clear(products.overview, wait=False)
    if products.first is None or products.second is None or plan.registers:  # fine sweeps are registered on it
        return
    first = products.first.mosaic
    if not any(run.products.get("mosaic", "").startswith(first.uri) for run in Catalogue.read(archive).runs):
        archive.clear(first, wait=False)


def _show_artifact(name: str, archive: str, published: Published) -> None:
    """Create the artifact of a run in the present flow: score, picture, findings, and where its files are."""
    if not inside_flow() or not server_answers():
        return
    key = re.sub("[^a-z0-9]", "-", name.lower()).strip("-")
    where = f"{archive}/runs/{published.folder.name}"
    with suppress(Exception):  # without a server the archive has everything
        text = render_markdown(
            "survey.md",
            survey=published.receipt["survey"],
            headline=[*map("Warning: {}".format, warnings_of(published.receipt)), *headline(published.receipt)],
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
