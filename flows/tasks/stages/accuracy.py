"""Define the stage that evaluates a map by labels; with controls also maps of the small and of the full network alone.

It needs labels and does not count as cost of the survey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.tasks.capture_plan import CapturePlan
from spectralzoom.flows.tasks.stage import Product, Report, Wanted, stage
from spectralzoom.flows.tasks.stages.attention import PatchGains
from spectralzoom.flows.tasks.stages.placement import load_registration
from spectralzoom.models.evaluation.metrics import (
    agreement,
    average_accuracy,
    confusion,
    false_pixels,
    iou_per_class,
    kappa,
)
from spectralzoom.models.policies.placement import mixed
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.geometry.scan import Axis
from spectralzoom.pipeline.simulator.effects.pointing import PointingErrors
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.storage.arrays.class_maps import load_class_map
from spectralzoom.storage.store import Ref, array_digest, read_table
from spectralzoom.storage.whole_files import to_json

RECORD = "accuracy.json"
ACCURACY = Product("evaluate", version=18, files=(RECORD,), by_weights=True)


@stage("evaluate", "accuracy", ACCURACY)
def evaluate(
    mosaic: Ref,
    attention: Ref,
    class_map: Ref,
    *sources: Ref,
    gains: PatchGains,
    plan: CapturePlan,
    simulated: SimulatedSource,
    source_key: Mapping[str, Any],
    labels: NDArray[np.uint8],
    model_key: Mapping[str, Any],
    controls: bool,
    report: Report,
) -> Wanted:
    """Evaluate the map by the labels, and with controls readings by the overview and by the full network.

    ``sources`` are the effects and the registration of the capture; a raster has neither.
    """
    labels = moved_labels(labels, map_offset(simulated, sources[1:]), plan.along)

    def build(path: Path) -> None:
        """Write the figures of the map and, with controls, of the overview and of a full reading."""
        drawn = load_class_map(class_map.path / "class_map.zarr")
        names = gains.work.weights.load().class_names
        judged = np.where(drawn.classes == UNLABELLED, np.uint8(UNLABELLED), labels)  # only pixels with a class
        counts = confusion(judged, drawn.classes, len(names))
        result: dict[str, Any] = map_figures(names, counts) | {"confusion": counts.tolist()}
        if controls:
            overview, full = gains.work.readings(mosaic, gains.capture, report)
            fractions, grid = gains.zones.fractions, gains.frame.grid
            kept = np.ones(len(grid.every_patch()), np.bool_) if fractions is None else fractions > 0
            for name, reading in {"none": overview, "all": mixed(overview, full, kept, grid)}.items():
                result[name] = map_figures(names, confusion(judged, reading, len(names)))
        (path / RECORD).write_text(to_json(result), encoding="utf-8")  # JSON without NaN

    params = {**model_key, "labels": array_digest(labels), "controls": controls, **source_key}
    return Wanted(build, params, [mosaic, attention, class_map, *sources])


def map_offset(simulated: SimulatedSource, pointing: Sequence[Ref]) -> NDArray[np.float64]:
    """Return the offset of the map from the scene, (along, scan) px: the pointing error of the reference sweep.

    Registration corrects relative errors only. The simulator knows the absolute one.
    """
    if not isinstance(simulated.pointing, PointingErrors) or not pointing:
        return np.zeros(2)
    return simulated.pointing.offset(load_registration(pointing[0])["reference"])


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
