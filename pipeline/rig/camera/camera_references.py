"""Dark and white references from captured lines: means over frames, and the elements that do not answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import RigError, ShapeError
from pipeline.rectify.calibration.detector import TO_SIGMA, BadElementCriteria, find_bad_elements
from pipeline.source import References

LEAST_LIT = 0.5  # share of the elements whose white is above their dark
FRAMES_FOR_STUCK = 8  # fewer frames cannot tell an element that never changes from a quiet one
FRAMES_FOR_JUMPS = 16  # fewer frames do not tell how much an element scatters by itself
JUMP_SIGMAS = 12.0  # off its median over the frames: in noise that would be one value in 1e32
LEAST_SIGMA_DN = 1.0  # of whole numbers; below one step a spread means nothing
MOST_JUMPING = 0.01  # of the elements
ODD_FRAME = 3.0  # times the scatter of the frame in the middle
_BLOCK = 64  # frames summed at a time
_SAMPLES = 16  # looked at together


@dataclass(frozen=True)
class MeanFrame:
    """The mean of a reference's frames."""

    mean: NDArray[np.float32]  # (sample, band) DN
    noise: NDArray[np.float32]  # (sample, band) DN, standard deviation of one frame; 0 for a single frame
    frames: int
    stuck: NDArray[np.bool_]  # (sample, band) the same number in every frame while the others change
    jumping: NDArray[np.bool_]  # (sample, band) further off its median in some frame than noise goes
    odd_frames: tuple[int, ...]  # that show something else than the others: shifted, or in another light
    notes: tuple[str, ...]


def mean_frame(lines: NDArray[np.integer]) -> MeanFrame:
    """Average frames (line, sample, band); exact sums, so that the order of frames does not matter.

    All frames look at the same thing, so an element scatters about its median by its noise alone: by 12 sigma it
    jumps. Sigma is 1.4826 / sqrt(2) of the median step from frame to frame, which one change amid the frames does not
    widen, and at least that of most elements, and 1 DN. A frame whose scatter about the medians, each at most those
    12 sigma, is 3 times that of most frames shows something else.

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
    jumping, odd = _strays(lines)
    if jumping.any():
        notes.append(f"{np.count_nonzero(jumping)} of {jumping.size} elements jump amid the frames")
    return MeanFrame(
        (total / count).astype(np.float32), noise.astype(np.float32), count, stuck, jumping, odd, tuple(notes)
    )


def as_references(
    dark: MeanFrame,
    white: MeanFrame,
    *,
    panel: ArrayLike = 1.0,
    saturated_dn: float | None = None,
    criteria: BadElementCriteria | None = None,
) -> tuple[References, tuple[str, ...]]:
    """Join dark and white into the references of a sweep, and say what was found.

    An element is bad where its dark frame is stuck, where either jumps amid its frames, or where
    :func:`pipeline.rectify.calibration.detector.find_bad_elements` says so.

    Parameters
    ----------
    panel
        Value of the white panel, one or (band,).
    saturated_dn
        Least DN of a saturated white frame; None where it is known not to be.

    Raises
    ------
    RigError : the frames are of two sizes, swapped, without light, do not show the same throughout, or too many
        elements would be bad.
    """
    if dark.mean.shape != white.mean.shape:
        raise RigError(f"dark is {dark.mean.shape} (sample, band), white {white.mean.shape}; take both anew")
    values = np.asarray(panel, np.float32)
    if values.shape not in ((), (dark.mean.shape[1],)):
        raise RigError(
            f"panel has shape {values.shape}, expected one value or one for each of {dark.mean.shape[1]} bands"
        )
    for name, frame in (("dark", dark), ("white", white)):
        _check_steady(name, frame)
    lit = np.count_nonzero(white.mean > dark.mean) / dark.mean.size
    if lit < LEAST_LIT:
        raise RigError(
            f"white is above dark in {100 * lit:.0f} % of the elements; are they swapped, or was the lamp off?"
        )
    bad = find_bad_elements(dark.mean, white.mean, criteria=criteria, saturated_dn=saturated_dn)
    bad |= dark.stuck | dark.jumping | white.jumping
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


def _strays(lines: NDArray[np.integer]) -> tuple[NDArray[np.bool_], tuple[int, ...]]:
    """Elements (sample, band) that jump, and frames that show something else; none where too few frames tell."""
    count, samples, bands = lines.shape
    jumping, scatter = np.zeros((samples, bands), np.bool_), np.zeros(count)
    if count < FRAMES_FOR_JUMPS:
        return jumping, ()
    blocks = [slice(start, start + _SAMPLES) for start in range(0, samples, _SAMPLES)]
    middle = [np.median(lines[:, block], axis=0) for block in blocks]
    sigma = [
        TO_SIGMA / np.sqrt(2) * np.median(np.abs(np.diff(lines[:, block].astype(np.int32), axis=0)), axis=0)
        for block in blocks
    ]
    least = max(float(np.median(np.concatenate(sigma))), LEAST_SIGMA_DN)
    for block, mid, own in zip(blocks, middle, sigma, strict=True):
        off = np.abs(lines[:, block] - mid) / np.maximum(own, least)
        jumping[block] = (off > JUMP_SIGMAS).any(axis=0)
        scatter += (np.minimum(off, JUMP_SIGMAS) ** 2).sum(axis=(1, 2))
    usual = max(float(np.median(scatter)), samples * bands)  # one sigma each
    return jumping, tuple(np.flatnonzero(scatter > ODD_FRAME**2 * usual).tolist())


def _check_steady(name: str, frame: MeanFrame) -> None:
    share = np.count_nonzero(frame.jumping) / frame.jumping.size
    if frame.odd_frames:
        first = ", ".join(map(str, frame.odd_frames[:5]))
        raise RigError(
            f"{len(frame.odd_frames)} of {frame.frames} frames of the {name} reference show something else than the "
            f"others ({first}); did the light change, or are bytes lost or added in it? Take both again"
        )
    if share > max(MOST_JUMPING, 1 / frame.jumping.shape[0]):
        raise RigError(
            f"{100 * share:.1f} % of the elements jump amid the frames of the {name} reference, at most "
            f"{100 * MOST_JUMPING:g} % can; did the light change, or are bytes lost or added in it? Take both again"
        )
