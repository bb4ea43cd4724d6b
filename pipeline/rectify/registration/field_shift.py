"""How a whole field lies beside an earlier look at it: moved, and turned, by what windows of two coarse images say.

Crops grow between two looks, shadows go round and leaves fall: a window may say what is not so. What most windows say
together is believed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.lazy import deferred
from pipeline.rectify.registration.shifts import pair_shift

if TYPE_CHECKING:
    import scipy.ndimage as ndimage
    import skimage.measure as skimage_measure
    import skimage.transform as skimage_transform
else:
    ndimage = deferred("scipy.ndimage")
    skimage_measure = deferred("skimage.measure")
    skimage_transform = deferred("skimage.transform")

WINDOWS = 3  # along either side of a field
LEAST_WINDOW_PX = 24  # on a side; a smaller field is compared as one
WINDOW_REACH_PX = 8.0  # what the shift of one window may differ by from that of the field
AGREE_PX, LOOSELY_PX = 0.5, 1.5  # within which windows say the same, and do so loosely
LOOSE_SHIFT_PX, LOOSE_EDGE_PX = 2.0, 3.0  # that what they say loosely is believed from: growth looks like less
TRIED_DEG = (-8.0, 8.0, -16.0, 16.0)  # by which a field may be turned of which windows say nothing as it lies
LEAST_WINDOWS, LEAST_SHARE = 4, 0.6  # that have to agree, and of those that say something
TRIALS = 200


@dataclass(frozen=True)
class FieldShift:
    """What brings an earlier image onto a later one: ``shift`` rows and columns [px], then ``turned_deg`` about it."""

    shift: tuple[float, float] = (0.0, 0.0)
    turned_deg: float = 0.0

    def edge_px(self, shape: tuple[int, ...]) -> float:
        """How far the corners of a field of (y, x) ``shape`` move by the turn alone."""
        return math.radians(abs(self.turned_deg)) * math.hypot(*shape[:2]) / 2


def field_shift(now: NDArray[np.floating], before: NDArray[np.floating], *, reach_px: float) -> FieldShift:
    """Find how ``before`` lies beside ``now``, two (y, x) broad-band images of one field with NaN where nothing is.

    No more than ``reach_px`` is looked for. Nothing is said where no two looks agree on it: fields that changed all
    over, or that show nothing. Raises ShapeError as `pair_shift`.
    """
    whole = pair_shift(now, before, prior_px=reach_px)
    start = np.rint(whole.shift) if whole.status == "found" else np.zeros(2)
    if min(now.shape) < WINDOWS * LEAST_WINDOW_PX:
        return FieldShift((float(whole.shift[0]), float(whole.shift[1]))) if whole.status == "found" else FieldShift()
    found = _of_windows(now, ndimage.shift(before, start, order=0, cval=np.nan)) if start.any() else []
    there = _of_windows(now, before)
    for within in (AGREE_PX, LOOSELY_PX):
        both = (_agreed(pairs, at, now.shape, within) for pairs, at in ((there, np.zeros(2)), (found, start)))
        count, lies = max(both, key=lambda one: one[0])
        far = math.hypot(*lies.shift) >= LOOSE_SHIFT_PX or lies.edge_px(now.shape) >= LOOSE_EDGE_PX
        if count:
            return lies if far or within == AGREE_PX else FieldShift()
    for turn in TRIED_DEG:
        turned = ndimage.rotate(before, turn, reshape=False, order=1, cval=np.nan)
        count, lies = _agreed(_of_windows(now, turned), np.zeros(2), now.shape, LOOSELY_PX)
        if count:
            return replace(lies, turned_deg=lies.turned_deg + turn)
    return FieldShift()


Pairs = list[tuple[NDArray[np.float64], NDArray[np.float64]]]  # middle of a window, and its shift


def _of_windows(now: NDArray[np.floating], before: NDArray[np.floating]) -> Pairs:
    """What windows say that say anything."""
    edges = [np.linspace(0, size, WINDOWS + 1).astype(int).tolist() for size in now.shape]
    pairs: Pairs = []
    for (top, bottom), (left, right) in product(pairwise(edges[0]), pairwise(edges[1])):
        window = np.s_[top:bottom, left:right]
        found = pair_shift(now[window], before[window], prior_px=WINDOW_REACH_PX)
        if found.status == "found":
            pairs.append((np.array([(top + bottom) / 2, (left + right) / 2]), found.shift))
    return pairs


def _agreed(
    pairs: Pairs, start: NDArray[np.float64], shape: tuple[int, ...], within_px: float
) -> tuple[int, FieldShift]:
    """How many windows agree, and on what; 0 and nothing where too few do."""
    if len(pairs) < LEAST_WINDOWS:
        return 0, FieldShift()
    middle = np.array(shape[:2]) / 2
    places = np.array([place - middle for place, _ in pairs])
    moved = places + np.array([shift for _, shift in pairs])
    model, inliers = skimage_measure.ransac(  # type: ignore[no-untyped-call]
        (places, moved),
        skimage_transform.EuclideanTransform,
        min_samples=2,
        residual_threshold=within_px,
        max_trials=TRIALS,
        rng=0,
    )
    count = 0 if inliers is None else int(inliers.sum())
    if model is None or count < max(LEAST_WINDOWS, LEAST_SHARE * len(pairs)):
        return 0, FieldShift()
    down, across = (model.translation + start).tolist()
    return count, FieldShift((float(down), float(across)), math.degrees(model.rotation))
