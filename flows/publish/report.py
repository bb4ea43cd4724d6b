"""The report: one HTML page from a receipt and its pictures, for a farmer first and for whoever reruns it below.

Nothing is loaded from anywhere: styles are inline, pictures are data in the page. It opens from disk and prints.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.publish.effect_table import total_words
from flows.publish.finding_words import sentences
from flows.publish.pages import render_page
from flows.publish.receipt import Accuracy, Receipt, Savings
from flows.publish.receipt_table import COST_LABELS, control_seats, headline
from flows.survey.scores import SHOWN, SHOWN_WORDS, definitions_differ, false_class_words
from flows.terminal.figures import format_seconds


@dataclass(frozen=True)
class Picture:
    """A PNG with the words below it."""

    png: bytes
    caption: str


def write_report(
    path: str | Path,
    receipt: Receipt,
    quicklook_png: bytes,
    pictures: Iterable[Picture] = (),
    *,
    looked_twice: float | None = None,
) -> None:
    """Write the page.

    Parameters
    ----------
    pictures
        More pictures, shown below the quicklook.
    looked_twice
        Share of the field captured in detail, 0..1, for the first sentence; None leaves it out.

    Raises
    ------
    OSError : the file cannot be written.
    """
    page = render_report(receipt, quicklook_png, pictures, looked_twice=looked_twice)
    Path(path).write_text(page, encoding="utf-8")


def render_report(
    receipt: Receipt, quicklook_png: bytes, pictures: Iterable[Picture] = (), *, looked_twice: float | None = None
) -> str:
    """The page as text; the same receipt and pictures give the same bytes."""
    shown = [Picture(quicklook_png, "The survey at a glance."), *pictures]
    split: Mapping[str, Any] = receipt["savings"]["multiply_adds"]
    parts = [name for name in ("glance", "score", "encode", "decode") if split["done"] and split[name] is not None]
    total = receipt.get("effects_total")  # receipts of before have none
    return render_page(
        "report.html",
        kicker="SpectralZoom survey",
        title=receipt["survey"],
        lead=headline(receipt, looked_twice),
        about=f"{receipt['scene']} seen by {receipt['source']}, seed {receipt['seed']}, finished {receipt['finished']}",
        receipt=receipt,
        pictures=[{"data": base64.b64encode(one.png).decode("ascii"), "caption": one.caption} for one in shown],
        costs=list(_costs(receipt["savings"])),
        shares={name: split[name] / split["done"] for name in parts},
        findings=sentences(receipt),
        **_scores(receipt.get("accuracy")),
        total_words="" if total is None else " ".join(total_words(total)),
        details={
            "Settings": _flat(receipt["settings"]),
            "Versions": receipt["versions"],
            "Files of this survey": receipt["products"],
        },
    )


def _costs(savings: Savings) -> Iterator[dict[str, Any]]:
    """What was spent against everything, a row each."""
    entries: Mapping[str, Any] = savings
    for name, (label, show) in COST_LABELS.items():
        entry = entries[name]
        yield {**entry, "label": label, "done": show(entry["done"]), "full": show(entry["full"])}
    if "segment_wall_s" in savings:
        done, full = savings["segment_wall_s"]["done"], savings["segment_wall_s"]["full"]
        times = {"done": format_seconds(done), "full": format_seconds(full), "full_is": "measured"}
        yield {**times, "label": "time of the model", "ratio": done / full if full else None}


def _scores(accuracy: Accuracy | None) -> dict[str, Any]:
    """What the page says of the map against the truth; ``shown`` where the definition of before scores otherwise."""
    if accuracy is None:
        return {"accuracy": None}
    maps: list[Mapping[str, Any]] = [accuracy["none"], *accuracy["controls"].values(), accuracy, accuracy["all"]]
    return {
        "accuracy": accuracy,
        "seats": control_seats(accuracy),
        "shown": SHOWN if definitions_differ(maps) else "",
        "shown_words": SHOWN_WORDS,
        "false_classes": false_class_words(accuracy),
    }


def _flat(settings: Mapping[str, Any]) -> dict[str, object]:
    """Tables within the settings as dotted names."""
    flat: dict[str, object] = {}
    for name, value in settings.items():
        table = isinstance(value, Mapping)
        flat |= {f"{name}.{key}": item for key, item in value.items()} if table else {name: value}
    return flat
