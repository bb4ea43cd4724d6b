"""Into how many boxes a footprint that lies turned in the scene is parted: as few as misplace little of its light."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.effect import Moments
from pipeline.simulator.footprint import Footprint, fold
from pipeline.simulator.rays import RayViews
from pipeline.simulator.tap_sums import PartOffsets, part_places, shape_of
from pipeline.simulator.tap_tables import box_weight

Floats = NDArray[np.float64]
Parts = tuple[int, int]

LADDER: tuple[Parts, ...] = ((1, 1), (2, 1), (3, 1), (5, 2), (9, 3))  # across and along; the last is taken as exact
_FINER = (18, 6)  # than any; what they are held against
_PHASES = (0.0, 0.5)  # of the pixels, along either axis


def fewest_parts(share: float, box: tuple[float, float], views: RayViews) -> Parts:
    """Give the fewest boxes that misplace at most a ``share`` of the light where views are turned most.

    ``box`` is across and along [px]. A blur, or held positions, make the share smaller.
    """
    turn, run = np.abs(views.along_turn), np.abs(views.scan_run)
    most = {int(one.argmax()) for one in (turn, run, turn * box[0] ** 2 + run * box[1] ** 2)}
    columns = views.along_run, views.scan_run, views.along_turn, views.scan_turn
    shapes = [tuple(float(one[number]) for one in columns) for number in sorted(most)]
    kept = (parts for parts in LADDER if all(misplaced(parts, box, shape) <= share for shape in shapes))
    return next(kept, LADDER[-1])


@lru_cache(maxsize=256)
def misplaced(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> float:
    """Give the share of light, by size, that so many boxes put elsewhere than the turned footprint does.

    ``shape`` is px of the scene along and scan per px of the camera along the line, then across it. Half of the share
    times the range of a scene within the footprint is the most that a sample changes.
    """
    apart = np.abs(_weights(parts, box, shape) - _weights(_FINER, box, shape))
    return float(apart.sum(axis=(1, 2)).max())


def _weights(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> Floats:
    """Weights (phase, along, scan) of the pixels around a sample, in closed form."""
    none, views = np.zeros((2, 1)), RayViews(*(np.array([one]) for one in (0.0, 0.0, *shape)))
    footprint: Footprint = fold(box, parts, 1, Moments(none, none))
    scale = shape_of(footprint, views)
    places = PartOffsets.of(views, scale, 0.0, 0.0).parts(footprint.shift, part_places(footprint))
    along, scan = (one[0, :, 0].astype(np.float64) for one in places)
    reach = math.ceil((1 + max(map(abs, shape))) * sum(box)) + 3
    pixel = np.arange(-reach, reach + 1)[:, None]
    widths = box[1] / parts[1] * float(scale.along[0, 0]), box[0] / parts[0] * float(scale.scan[0, 0])
    runs = [box_weight(pixel + phase - along, widths[0]) for phase in _PHASES]
    turns = [box_weight(pixel + phase - scan, widths[1]) for phase in _PHASES]
    return np.stack([run @ turn.T for run in runs for turn in turns]) / len(along)
