"""Evaluate a map by labels. It does not count as cost of the survey."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import FieldLabels
from spectralzoom.flows.stage import Output, stage
from spectralzoom.flows.stages.register import load_registration
from spectralzoom.models.evaluation.metrics import (
    agreement,
    average_accuracy,
    confusion,
    false_pixels,
    iou_per_class,
    kappa,
)
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.geometry.scan import Axis
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.store import Ref, read_table
from spectralzoom.storage.whole_files import to_json, write_new

RECORD = "accuracy.json"


@stage("accuracy", version=21, made_by=("models/evaluation",))
def evaluate(
    out: Output, class_map: Ref, seams: Ref | None, *, labels: FieldLabels, along: Axis, pointing: PointingErrors | None
) -> None:
    """Evaluate the map by the labels.

    ``seams`` is the registration of the first pass, whose reference has the error that ``pointing`` simulates.
    """
    truth = labels.read()
    assert truth is not None
    truth = moved_labels(truth, map_offset(pointing, seams), along)
    drawn = load_class_map(class_map.path / "class_map.zarr")
    names = drawn.legend.names
    judged = np.where(drawn.classes == UNLABELLED, np.uint8(UNLABELLED), truth)  # only pixels with a class
    counts = confusion(judged, drawn.classes, len(names))
    result: dict[str, Any] = map_figures(names, counts) | {"confusion": counts.tolist()}
    write_new(out.path / RECORD, to_json(result))  # JSON without NaN


def map_offset(pointing: PointingErrors | None, seams: Ref | None) -> NDArray[np.float64]:
    """Return the offset of the map from the scene, (along, scan) px: the pointing error of the reference sweep.

    Registration corrects relative errors only. The simulator knows the absolute one.
    """
    if pointing is None or seams is None:
        return np.zeros(2)
    return pointing.offset(load_registration(seams)["reference"])


def moved_labels(labels: NDArray[np.uint8], off: NDArray[np.float64], along: Axis) -> NDArray[np.uint8]:
    """Return labels shifted to the map, to the nearest pixel; pixels beyond them are unlabelled."""
    down, across = np.rint(off[::-1] if along == "x" else off).astype(int)
    rows, columns = (np.arange(size) + by for size, by in zip(labels.shape, (down, across), strict=True))
    inside = ((rows >= 0) & (rows < labels.shape[0]))[:, None] & ((columns >= 0) & (columns < labels.shape[1]))
    moved = labels[np.clip(rows, 0, labels.shape[0] - 1)[:, None], np.clip(columns, 0, labels.shape[1] - 1)]
    return np.where(inside, moved, np.uint8(UNLABELLED))


def map_figures(names: Sequence[str], counts: NDArray[np.int64]) -> dict[str, Any]:
    """Return the figures of a map from its confusion matrix."""
    false = zip(names, false_pixels(counts).tolist(), strict=True)
    return {
        **agreement(counts),
        "average_accuracy": average_accuracy(counts),
        "kappa": kappa(counts),
        "pixels": int(counts.sum()),
        "per_class_iou": dict(zip(names, iou_per_class(counts).tolist(), strict=True)),
        "false_classes": {name: pixels for name, pixels in false if pixels},
    }


def load_accuracy(evaluated: Ref) -> dict[str, Any]:
    """Read the figures of an evaluation."""
    return read_table(evaluated.path / RECORD)
