"""Scores of a run's map, read from its receipt: those that may be compared, the worst class, false classes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from flows.terminal.figures import format_count, format_points, known_number

JUDGING = "evaluate"  # the stage that judges the map
MOST_ERROR = (
    0.1  # a standard deviation of a predicted mIoU from which on nothing is predicted: 40 points lie within two
)
MAPS = {"this survey": None, "none": "none", "all": "all"}  # as they are called; where a receipt's accuracy has them


def format_prediction(miou: float | None, error: float | None) -> str:
    """Return a predicted mIoU with its standard deviation, 0..1; empty where there is none, or where it may be any."""
    if miou is None or (error is not None and error > MOST_ERROR):
        return ""
    return format_points(miou) if error is None else f"{format_points(miou)} ± {format_points(error)}"


class WorstClass(NamedTuple):
    """The class of the truth that this map shows worst, and its IoU in the three maps; None for one not judged."""

    name: str
    none: float | None
    this: float
    all: float | None


def score_of(receipt: Mapping[str, Any]) -> dict[str, float | None]:
    """``miou`` and ``overall_accuracy`` of a run's map, 0..1; None where nothing was judged."""
    accuracy = receipt.get("accuracy")
    if not isinstance(accuracy, Mapping):
        return {"miou": None, "overall_accuracy": None}
    return {name: known_number(accuracy.get(name)) for name in ("miou", "overall_accuracy")}


def _by_class(one: Mapping[str, Any]) -> dict[str, float | None]:
    table = one.get("per_class_iou")
    return {str(name): known_number(iou) for name, iou in table.items()} if isinstance(table, Mapping) else {}


def worst_class(accuracy: Mapping[str, Any]) -> WorstClass | None:
    """The class of the truth with the lowest IoU in this map; None where no class was judged."""
    this, none, every = (_by_class(one or {}) for one in (accuracy, accuracy.get("none"), accuracy.get("all")))
    known = {name: iou for name, iou in this.items() if iou is not None}
    if not known:
        return None
    name = min(known, key=lambda name: known[name])
    return WorstClass(name, none.get(name), known[name], every.get(name))


def format_worst_class(accuracy: Mapping[str, Any], *, alone: bool = False) -> str:
    """The worst class in a sentence, ``alone`` without what other looks give; empty where there is none."""
    worst = worst_class(accuracy)
    if worst is None:
        return ""
    name = worst.name.replace("_", " ")
    if alone:
        return f"Its worst class is {name} with {format_points(worst.this)}."
    full = "" if worst.all is None else f", a full reading {format_points(worst.all)}"
    return (
        f"Its worst class is {name} with {format_points(worst.this)}: the overview alone "
        f"gives {format_points(worst.none)}{full}."
    )


def format_false_classes(accuracy: Mapping[str, Any]) -> str:
    """Classes that a map shows and the truth lacks, with their pixels; empty where there are none."""
    parts = []
    for name, key in MAPS.items():
        one = accuracy if key is None else accuracy.get(key)
        if isinstance(one, Mapping) and _by_class(one) and (false := one.get("false_classes")):
            pixels = ", ".join(f"{kind.replace('_', ' ')} {format_count(count)} px" for kind, count in false.items())
            parts.append(f"{name} {pixels}")
    return f"Shown although the truth has none: {'; '.join(parts)}." if parts else ""


class ErrorMatrix(NamedTuple):
    """A confusion matrix in words, over the classes that map or labels have."""

    labels: list[str]  # of the columns
    rows: list[list[str]]  # mapped class, pixels by label, user's accuracy [%]; last the producer's accuracies [%]


def error_matrix(accuracy: Mapping[str, Any]) -> ErrorMatrix | None:
    """Return the confusion matrix of a receipt's accuracy as a table; None where the receipt has none."""
    if not (counts := accuracy.get("confusion")):
        return None
    size = len(counts)
    names = [*_by_class(accuracy), "unknown"][:size]
    label, mapped = [sum(row) for row in counts], [sum(row[one] for row in counts) for one in range(size)]
    columns = [one for one in range(size) if label[one]]
    rows = [
        [_spaced(names[one]), *(format_count(counts[by][one]) for by in columns), _right(counts[one][one], mapped[one])]
        for one in range(size)
        if label[one] or mapped[one]
    ]
    producers = [_right(counts[one][one], label[one]) for one in columns]
    return ErrorMatrix([_spaced(names[one]) for one in columns], [*rows, ["producer's accuracy", *producers, ""]])


def _right(right: int, pixels: int) -> str:
    return format_points(right / pixels if pixels else None)


def _spaced(name: str) -> str:
    return name.replace("_", " ")
