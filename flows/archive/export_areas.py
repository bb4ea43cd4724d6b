"""The table of areas of a run: each class's pixels, hectares and confidence, and how surely its area is known."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.archive.export_layers import ExportedRun
from pipeline.geometry.grid import UNLABELLED
from pipeline.products.areas import ShareEstimate, probable_shares, stratified_shares
from storage.archive.whole_files import write_whole
from storage.arrays.beliefs import BeliefStore
from storage.arrays.ground_maps import open_image

CSV = "text/csv"
COLUMNS = (
    "class",
    "pixels",
    "hectares",
    "share",
    "mean_confidence",
    "estimated_share",
    "estimated_hectares",
    "standard_error_share",
    "standard_error_hectares",
    "estimated_from",
)
DIGITS = 6


def write_areas(run: ExportedRun, path: Path) -> None:
    """Write the table, a row a class; empty where something is not known, as hectares where there is no CRS."""
    path_of_map = run.path(run.map_product)
    names = tuple(open_image(path_of_map, "classes").about["class_names"])
    pixels, confidence = _counted(path_of_map, len(names))
    hectares = _hectares(run, names)
    share = pixels / max(pixels.sum(), 1) if hectares is None else hectares / (hectares.sum() or 1.0)
    estimate, source = _estimate(run, share)
    total = np.nan if hectares is None else hectares.sum()
    own = np.full(len(names), np.nan) if hectares is None else hectares
    figures = (own, share, confidence, estimate.shares, estimate.shares * total, estimate.errors)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for number, (name, count) in enumerate(zip(names, pixels.tolist(), strict=True)):
        told = [_cell(figure[number]) for figure in (*figures, estimate.errors * total)]
        table.writerow([name, count, *told, source])
    write_whole(path, text.getvalue())


def _cell(value: float) -> str:
    return f"{value:.{DIGITS}g}" if np.isfinite(value) else ""


def _counted(path: Path, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(class,) pixels and mean confidence of the exported map; NaN for a class of which no pixel has one."""
    pixels, sums, sure_pixels = np.zeros(256, np.int64), np.zeros(256), np.zeros(256, np.int64)
    for (_, classes), (_, sure) in zip(
        open_image(path, "classes").rows(), open_image(path, "confidence").rows(), strict=True
    ):
        pixels += np.bincount(classes.ravel(), minlength=256)
        known = np.isfinite(sure)
        sums += np.bincount(classes[known], sure[known], 256)
        sure_pixels += np.bincount(classes[known], minlength=256)
    return pixels[:count], np.where(sure_pixels > 0, sums / np.maximum(sure_pixels, 1), np.nan)[:count]


def _hectares(run: ExportedRun, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    """Hectares of each class as the receipt has them; None where nothing says where the field lies."""
    if "ground" not in run.receipt:
        return None
    areas = run.receipt["ground"]["areas_ha"]
    return np.array([areas.get(name, 0.0) for name in names], np.float64)


def _estimate(run: ExportedRun, share: NDArray[np.float64]) -> tuple[ShareEstimate, str]:
    """Shares with their errors: by the confusion matrix of the receipt where there is one, else by probabilities."""
    confusion = run.receipt.get("accuracy", {}).get("confusion")
    if confusion is not None:
        return stratified_shares(share, confusion), "labels"
    if run.store("belief") is None:
        unknown = np.full(len(share), np.nan)
        return ShareEstimate(unknown, unknown), ""
    return probable_shares(_probabilities(run, len(share)), len(share)), "probabilities"


def _probabilities(run: ExportedRun, count: int) -> Iterator[NDArray[np.float32]]:
    """What is believed of the pixels with a class, (y, x, class); of those called unknown that they are, for sure."""
    store = BeliefStore(run.path("belief"))
    for first, drawn in open_image(run.path("class_map"), "classes").rows():
        values = np.exp(store.read(slice(first, first + len(drawn)))[0])
        known = values.shape[-1]
        values = np.pad(values, [(0, 0), (0, 0), (0, count - known)])
        values[drawn == UNLABELLED] = np.nan
        unknown = (drawn >= known) & (drawn != UNLABELLED)
        values[unknown] = np.arange(count) == drawn[unknown, None]
        yield values
