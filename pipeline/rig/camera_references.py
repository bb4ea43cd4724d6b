"""Dark and white references from captured lines: means over frames, and the elements that do not answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import RigError, ShapeError
from pipeline.rectify.detector import BadElementCriteria, find_bad_elements
from pipeline.source import References

LEAST_LIT = 0.5  # share of the elements whose white is above their dark
FRAMES_FOR_STUCK = 8  # fewer frames cannot tell an element that never changes from a quiet one
_BLOCK = 64  # frames summed at a time


@dataclass(frozen=True)
class MeanFrame:
    """The mean of a reference's frames."""

    mean: NDArray[np.float32]  # (sample, band) DN
    noise: NDArray[np.float32]  # (sample, band) DN, standard deviation of one frame; 0 for a single frame
    frames: int
    stuck: NDArray[np.bool_]  # (sample, band) the same number in every frame while the others change
    notes: tuple[str, ...]


def mean_frame(lines: NDArray[np.integer]) -> MeanFrame:
    """Average frames (line, sample, band); exact sums, so that the order of frames does not matter.

    Raises
    ------
    ShapeError : they are not (line, sample, band), or there is none.
    """
    if lines.ndim != 3 or not lines.size:
        raise ShapeError(f"expected at least one frame (line, sample, band), got {lines.shape}; capture the reference")
    count = len(lines)
    total, squares = np.zeros(lines.shape[1:], np.int64), np.zeros(lines.shape[1:], np.int64)
    for start in range(0, count, _BLOCK):
        block = lines[start : start + _BLOCK].astype(np.int64)
        total += block.sum(axis=0)
        squares += (block * block).sum(axis=0)
    spread = count * squares - total * total  # whole numbers: nothing cancels
    noise = np.sqrt(spread / (count * max(count - 1, 1)))
    stuck = _stuck(noise, count)
    notes = [f"the mean of {count} frames; {np.count_nonzero(stuck)} of {stuck.size} elements are stuck"]
    if count < FRAMES_FOR_STUCK:
        notes.append(f"{count} frames cannot tell stuck elements; take {FRAMES_FOR_STUCK} or more")
    return MeanFrame((total / count).astype(np.float32), noise.astype(np.float32), count, stuck, tuple(notes))


def as_references(
    dark: MeanFrame, white: MeanFrame, *, panel: ArrayLike = 1.0, saturated_dn: float | None = None,
    criteria: BadElementCriteria | None = None,
) -> tuple[References, tuple[str, ...]]:  # fmt: skip
    """Join dark and white into the references of a sweep, and say what was found.

    An element is bad where its dark frame is stuck or :func:`pipeline.rectify.detector.find_bad_elements` says so.

    Parameters
    ----------
    panel
        Value of the white panel, one or (band,).
    saturated_dn
        Least DN of a saturated white frame; None where it is known not to be.

    Raises
    ------
    RigError : the frames are of two sizes, swapped, without light, or too many elements would be bad.
    """
    if dark.mean.shape != white.mean.shape:
        raise RigError(f"dark is {dark.mean.shape} (sample, band), white {white.mean.shape}; take both anew")
    values = np.asarray(panel, np.float32)
    if values.shape not in ((), (dark.mean.shape[1],)):
        raise RigError(
            f"panel has shape {values.shape}, expected one value or one for each of {dark.mean.shape[1]} bands"
        )
    lit = np.count_nonzero(white.mean > dark.mean) / dark.mean.size
    if lit < LEAST_LIT:
        raise RigError(
            f"white is above dark in {100 * lit:.0f} % of the elements; are they swapped, or was the lamp off?"
        )
    bad = find_bad_elements(dark.mean, white.mean, criteria=criteria, saturated_dn=saturated_dn) | dark.stuck
    notes = (
        *(f"dark: {note}" for note in dark.notes),
        *(f"white: {note}" for note in white.notes),
        f"{np.count_nonzero(bad)} of {bad.size} elements are bad",
    )
    return References(dark.mean, white.mean, np.broadcast_to(values, dark.mean.shape[1]).copy(), bad), notes


def _stuck(noise: NDArray[np.float64], count: int) -> NDArray[np.bool_]:
    """Elements without noise where most have some."""
    if count < FRAMES_FOR_STUCK or not np.median(noise) > 0:
        return np.zeros(noise.shape, np.bool_)
    stuck: NDArray[np.bool_] = noise == 0
    return stuck
