"""What a class map says of plots: ground, share of each class and mean confidence of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import FieldPlace
from pipeline.ground.zones import pixels_inside

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry


@dataclass(frozen=True)
class PlotFigures:
    """One plot, as far as it lies on the field and is mapped. Without a mapped pixel nothing is said of it."""

    plot: str
    pixels: int  # whose centres lie in it
    mapped_pixels: int  # of them, those with a class
    area_m2: float | None  # of the mapped pixels; None where nobody knows how large they are
    confidence: float | None  # mean over the mapped pixels that have one
    shares: dict[str, float | None]  # of the mapped ground, by class; of the pixels where that is not known


def figures_of_plots(
    plots: Mapping[str, BaseGeometry],
    place: FieldPlace,
    classes: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    names: tuple[str, ...],
) -> list[PlotFigures]:
    """Work out the figures of every plot, in pixels of a (y, x) class map and by name. Plots may overlap."""
    return [_figures(name, shape, place, classes, confidence, names) for name, shape in plots.items()]


def _figures(
    plot: str,
    shape: BaseGeometry,
    place: FieldPlace,
    classes: NDArray[np.uint8],
    confidence: NDArray[np.float32],
    names: tuple[str, ...],
) -> PlotFigures:
    rows, columns = _window(shape, classes.shape)
    size = rows.stop - rows.start, columns.stop - columns.start
    inside = pixels_inside([shape], size, origin=(rows.start, columns.start))
    drawn = classes[rows, columns]
    mapped = inside & (drawn != UNLABELLED)
    ground = place.pixel_areas_m2(rows, columns)
    weight = np.where(mapped, 1.0 if ground is None else np.nan_to_num(ground), 0.0)
    by_class, total = np.bincount(drawn[mapped], weight[mapped], len(names)), float(weight.sum())
    count, sure = int(mapped.sum()), confidence[rows, columns][mapped]
    sure = sure[np.isfinite(sure)]  # what is unknown has no confidence
    return PlotFigures(
        plot,
        int(inside.sum()),
        count,
        None if ground is None else total,
        float(sure.mean(dtype=np.float64)) if sure.size else None,
        {name: float(one) / total if total else None for name, one in zip(names, by_class, strict=True)},
    )


def _window(shape: BaseGeometry, size: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a map of ``size`` that a polygon can hold, one at least."""
    bounds = np.zeros(4) if shape.is_empty else np.array(shape.bounds)
    firsts = (min(max(int(np.floor(low)), 0), most - 1) for low, most in zip(bounds[[1, 0]], size, strict=True))
    lasts = (min(max(int(np.ceil(high)), 1), most) for high, most in zip(bounds[[3, 2]], size, strict=True))
    rows, columns = (slice(first, max(last, first + 1)) for first, last in zip(firsts, lasts, strict=True))
    return rows, columns
