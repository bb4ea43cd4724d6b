"""What a receipt says of a map as drawn: pixels without a class, those unknown, and what it is likely to score."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.values import LOOK_WHOLE
from flows.survey.memory import told_of_memory
from flows.survey.run import SurveyRun
from flows.survey.stages.maps import strange_pixels
from models.evaluation.expected_scores import expected_counts
from pipeline.geometry.grid import UNLABELLED
from storage.archive.keys import StageRef
from storage.arrays.class_maps import BeliefStore, ClassMap

FOREIGN = 0.2  # share of a map that is unknown from which on its weights are the wrong ones
STRIP_ROWS = 256  # of a belief that are read at a time


def find_map(run: SurveyRun, ref: StageRef, drawn: ClassMap) -> dict[str, Any]:
    """Findings of a map in the stage ``ref``: ``unknown``, ``pixels`` and ``expected``, each where there is one."""
    found: dict[str, Any] = {}
    unclassed, share = drawn.classes == UNLABELLED, 0.0
    if (rate := run.settings.unknown_rate) is not None and run.familiar is not None:
        count = int(np.count_nonzero(drawn.classes == run.described.config.classes))
        told_pixels = int(np.count_nonzero(~unclassed))
        share = count / told_pixels if told_pixels else 0.0
        found["unknown"] = {"pixels": count, "share": share, "rate": rate}
    if run.zones.left_out is not None:
        unclassed &= ~run.zones.left_out
    pixels = {
        "scene_without_a_value": run.scene.filled_px,
        "coarse_px_no_reading": 0,
        "fine_px_no_reading": 0,
        **{f"{name}_no_reading": count for name, count in strange_pixels(ref).items()},
        "map_without_a_class": int(np.count_nonzero(unclassed)),
    }
    if any(pixels.values()):
        found["pixels"] = pixels
    expected = None if share > FOREIGN else _expected(run, ref)
    return found if expected is None else found | {"expected": expected}


def _expected(run: SurveyRun, ref: StageRef) -> dict[str, Any] | None:
    """What the map is likely to score by what it says of itself; None where nobody knows how such comes true.

    That is known of maps of plain scans that are read whole, without a memory.
    """
    settings, step = run.settings, run.settings.scan_step
    memory = told_of_memory(ref.path)
    remembers = memory is not None and memory["put_aside"] is None
    if run.map_scores is None or step is None or settings.look != LOOK_WHOLE or run.budget is not None or remembers:
        return None
    names = run.described.class_names
    counts = expected_counts(_strips(BeliefStore(ref.path / "belief.zarr")), len(names))
    score = run.map_scores.expected(counts, step, settings.scan_exposure_ms or run.camera.exposure_ms)
    if score is None or not np.isfinite(score.miou):
        return None
    of_classes = {name: float(iou) for name, iou in zip(names, score.per_class_iou, strict=True) if np.isfinite(iou)}
    return {"miou": score.miou, "error": score.error, "per_class_iou": of_classes}


def _strips(belief: BeliefStore) -> Iterator[NDArray[np.float32]]:
    for top in range(0, belief.shape[0], STRIP_ROWS):
        yield belief.read(slice(top, min(top + STRIP_ROWS, belief.shape[0])))[0]
