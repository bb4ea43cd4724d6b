"""What Prefect's pages show of a survey: one text with its picture and receipt, and a table of savings by field."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from flows.publish.receipt import Receipt
from flows.publish.receipt_table import COST_LABELS, cost_rows, headline, sentences
from flows.publish.report import render_markdown
from flows.publish.run_folder import Published
from flows.survey.prefect_engine import inside_flow
from flows.terminal.figures import format_percent

MOST_BYTES = 100 * 1024  # of the picture, as it stands in the text
WIDTHS_PX = (1200, 1000, 800, 600, 400, 200)


def publish_artifacts(published: Published, field: str, archive: str) -> None:
    """Give a survey's text and table to the Prefect server of the flow that this is called in."""
    from prefect.artifacts import create_markdown_artifact, create_table_artifact

    key, where = artifact_key(field), f"{archive}/runs/{published.folder.name}"
    text = survey_markdown(published, where)
    create_markdown_artifact(text, key=f"survey-{key}", description=where)
    create_table_artifact(savings_rows(published.receipt), key=f"savings-{key}", description=where)


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
    """What shows how far stages are on Prefect's pages, every two seconds at most: nothing outside of a flow.

    A stage has an artifact where it takes longer than a moment. A server that is gone is no matter.
    """
    if not inside_flow():
        return lambda stage, state, done: None
    from prefect.artifacts import create_progress_artifact, update_progress_artifact

    shown: dict[str, Any] = {}
    last: dict[str, float] = {}

    def show(stage: str, state: str, done: float) -> None:
        now = time.monotonic()
        if now - last.setdefault(stage, now) < 2.0 and not (stage in shown and state != "running"):
            return
        last[stage] = now
        with suppress(Exception):
            if stage in shown:
                update_progress_artifact(shown[stage], progress=round(100 * done, 1))
            else:
                key = f"{stage.replace('_', '-')}-{artifact_key(field)}"
                shown[stage] = create_progress_artifact(100 * done, key=key, description=stage)

    return show
