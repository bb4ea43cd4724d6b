"""Read the scores of a run's map from its receipt: mIoU, worst class, false classes, error matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from spectralzoom.flows.terminal.figures import format_count, format_points, spaced

MOST_ERROR = 0.1  # standard deviation of an expected mIoU, above which it is not shown


def format_prediction(miou: float | None, error: float | None) -> str:
    """Return an expected mIoU with its standard deviation as text; empty where it is missing or too uncertain."""
    if miou is None or (error is not None and error > MOST_ERROR):
        return ""
    return format_points(miou) if error is None else f"{format_points(miou)} ± {format_points(error)}"


def warnings_of(receipt: Mapping[str, Any]) -> list[str]:
    """Return the warnings about a run's map; none of a receipt with something else in their place."""
    found = receipt.get("warnings")
    return [one for one in found if isinstance(one, str)] if isinstance(found, list) else []


def warning_column(warnings: Sequence[str], rows: int) -> dict[str, list[str]]:
    """Return the column of a table that repeats the warnings about its map in every row; none without any."""
    return {"warning": ["; ".join(warnings)] * rows} if warnings else {}


def score_of(receipt: Mapping[str, Any]) -> dict[str, float | None]:
    """Return ``miou`` and ``overall_accuracy`` of a run's map, 0..1; None without labels."""
    accuracy = receipt.get("accuracy") or {}
    return {name: accuracy.get(name) for name in ("miou", "overall_accuracy")}


def format_worst_class(accuracy: Mapping[str, Any]) -> str:
    """Return the class with the lowest IoU in a sentence; empty without labels."""
    known = {name: iou for name, iou in accuracy["per_class_iou"].items() if iou is not None}
    if not known:
        return ""
    worst = min(known, key=lambda name: known[name])
    return f"The map's worst class is {spaced(worst)} with {format_points(known[worst])}."


def format_false_classes(accuracy: Mapping[str, Any]) -> str:
    """Return the classes of a map that the labels lack, with their pixels; empty where there are none."""
    pixels = ", ".join(
        f"{spaced(kind)} {format_count(px)} px" for kind, px in (accuracy["false_classes"] or {}).items()
    )
    return f"Shown although the truth has none: {pixels}." if pixels else ""


def error_matrix(accuracy: Mapping[str, Any]) -> dict[str, list[Any]] | None:
    """Return the confusion matrix of a receipt's accuracy as text; None where the receipt has none.

    It has ``labels``, the classes of the columns, and ``rows``: mapped class, pixels by label, user's accuracy [%].
    The last row has the producer's accuracies.
    """
    if not (counts := accuracy.get("confusion")):
        return None
    size = len(counts)
    names = list(accuracy["per_class_iou"])
    label, mapped = [sum(row) for row in counts], [sum(row[one] for row in counts) for one in range(size)]
    columns = [one for one in range(size) if label[one]]
    rows = [
        [spaced(names[one]), *(format_count(counts[by][one]) for by in columns), _right(counts[one][one], mapped[one])]
        for one in range(size)
        if label[one] or mapped[one]
    ]
    rows.append(["producer's accuracy", *(_right(counts[one][one], label[one]) for one in columns), ""])
    return {"labels": [spaced(names[one]) for one in columns], "rows": rows}


def _right(right: int, pixels: int) -> str:
    return format_points(right / pixels if pixels else None)
