"""Resampling at scattered points: a sweep's lines with masks, as rows of one table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.lazy import deferred
from pipeline.rectify.kernels import Kernel, Rows, Unlocked, Windows, taps_of, weighted_rows, windows

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")

Values: TypeAlias = NDArray[np.float32] | NDArray[np.uint16]

LEAST_WEIGHT = 0.5
ROUNDING = 1e-6
BLOCK_PX = 16384  # smaller blocks pay calls, and larger ones gain nothing


def divisor(total: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the divisor of a sum, from the weight that was usable: 1 for all of it, up to rounding; NaN below half."""
    whole = np.where(np.abs(total - 1) <= ROUNDING, np.float32(1), total)
    return np.where(whole >= LEAST_WEIGHT, whole, np.float32(np.nan))


def divide_rows(out: NDArray[np.float32], at: Rows, by: NDArray[np.float32]) -> None:
    """Divide the rows ``at`` of ``out``, in place, where there is something to divide by other than 1."""
    other = np.flatnonzero(by != 1)
    out[at[other]] /= by[other, None]


@dataclass(frozen=True)
class Damage:
    """Single elements that may not be used, in samples of which other bands may."""

    bands: Rows  # (k,) that have any
    kind: NDArray[np.int32]  # (line * sample,) row of ``usable``; 0 where a sample has none
    usable: torch.Tensor  # (kind, k) float32, 1 or 0
    sound: NDArray[np.bool_]  # (line, sample) of a window's corner: it has none

    def mend(
        self, out: NDArray[np.float32], at: Rows, index: torch.Tensor, weight: torch.Tensor, total: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Divide the weighted sums in the rows ``at`` of ``out`` by the weight that was usable in each band.

        ``total`` (n,) is the weight on usable samples; unusable elements have entered the sums as 0. Tells of each
        point whether it has a value in any band.
        """
        fraction = np.empty((len(at), len(self.bands)), np.float32)
        weighted_rows(self.usable, torch.from_numpy(self.kind[index.numpy()]), weight, fraction)
        point, column = _places(np.abs(fraction - total[:, None]) > ROUNDING)  # few: the rest is divided as samples are
        own, rest = divisor(fraction[point, column]), divisor(total)
        apart = at[point], self.bands[column]
        mended = out[apart] / own
        divide_rows(out, at, rest)
        out[apart] = mended
        failed = np.where(np.isnan(rest), out.shape[1] - np.bincount(point, minlength=len(at)), 0)
        failed += np.bincount(point[np.isnan(own)], minlength=len(at))
        known: NDArray[np.bool_] = failed < out.shape[1]
        return known


@dataclass(frozen=True)
class LineTable:
    """A sweep, ready to be read by one kernel."""

    shape: tuple[int, int]  # lines, samples
    rows: NDArray[Any]  # (line * sample, band) as captured, for a kernel of one tap
    terms: torch.Tensor  # the same in float32, for weighted sums
    usable: NDArray[np.bool_] | None  # (line * sample,); None: all are
    whole: NDArray[np.bool_] | None  # (line, sample) of a window's corner: all its samples are usable
    damage: Damage | None

    def read(self, placed: Windows, out: NDArray[Any], fraction: NDArray[np.float32]) -> None:
        """Write the points' values (n, band), and (n,) the usable fraction of the kernel's weight."""
        whole = _lies_on(placed, self.shape, self.whole)
        if placed.taps == 1:
            if whole.any():
                corner = placed.corner if whole.all() else np.where(whole, placed.corner, 0)
                index = (corner[0] * self.shape[1] + corner[1]).astype(np.intp)
                np.take(self.rows, index, axis=0, out=out, mode="clip")  # numpy copies once more in its other modes
            out[~whole] = np.nan if out.dtype == np.float32 else 0
            fraction[:] = whole
        elif whole.all():
            self._read_whole(placed, out, fraction)
        else:
            for which, read in ((whole, self._read_whole), (~whole, self._read_partial)):
                points = np.flatnonzero(which)
                read(placed.chosen(points), out, fraction, points)

    def _read_whole(
        self, placed: Windows, out: NDArray[np.float32], fraction: NDArray[np.float32], at: Rows | None = None
    ) -> None:
        """Points (the block's ``at``, or all) whose windows lie on usable samples altogether."""
        index, weight = placed.flat_index(self.shape), placed.joint_weight()
        weighted_rows(self.terms, index, weight, out, at)
        fraction[... if at is None else at] = 1
        if self.damage is not None:
            touched = np.flatnonzero(~_lies_on(placed, self.shape, self.damage.sound))
            here, taps = touched if at is None else at[touched], torch.from_numpy(touched)
            one = np.ones(len(touched), np.float32)
            fraction[here] = self.damage.mend(out, here, index[taps], weight[taps], one)

    def _read_partial(self, placed: Windows, out: NDArray[np.float32], fraction: NDArray[np.float32], at: Rows) -> None:
        """Points that miss taps: NaN and 0 where they fail, else what is there, renormalised."""
        out[at], fraction[at] = np.nan, 0
        near = np.flatnonzero(placed.touches(self.shape))
        flat, joint = self._usable_taps(placed.chosen(near))
        total = reduce(np.add, joint.T)  # tap by tap, as the sums of a mask by element run: the same to the last bit
        index, weight, at = torch.from_numpy(flat), torch.from_numpy(joint), at[near]
        weighted_rows(self.terms, index, weight, out, at)
        if self.damage is None:
            whole = divisor(total)
            divide_rows(out, at, whole)
            known = ~np.isnan(whole)
        else:
            known = self.damage.mend(out, at, index, weight, total)
        fraction[at] = np.where(known, np.minimum(total, 1), 0)

    def _usable_taps(self, placed: Windows) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """(n, tap * tap) rows and weights; a tap that may not be used has weight 0 and the row of one that may."""
        line, sample = placed.taps_by_axis()
        weight = placed.weight.copy()
        for along, index, size in ((weight[0], line, self.shape[0]), (weight[1], sample, self.shape[1])):
            along *= ((index >= 0) & (index < size)).T
            index.clip(0, max(size - 1, 0), out=index)
        flat = np.repeat(line * self.shape[1], placed.taps, axis=1) + np.tile(sample, (1, placed.taps))
        joint = Windows(placed.corner, weight).joint_weight().numpy()
        if self.usable is not None:
            usable = self.usable[flat]
            joint *= usable
            flat[~usable] = np.argmax(self.usable)  # 0 times a NaN would still be a NaN
        return flat, joint


def table_for(values: Values, valid: NDArray[np.bool_], kernel: Kernel) -> LineTable:
    """Make lines (line, sample, band), valid by sample or by element, ready for one kernel."""
    taps = taps_of(kernel)
    lines, samples, bands = values.shape
    rows: NDArray[Any] = np.ascontiguousarray(values).reshape(lines * samples, bands)
    if rows.dtype != np.uint16 or taps > 1:
        rows = rows.astype(np.float32, copy=False)
    damage = None
    if valid.ndim == 3:
        rows, valid, damage = _apart(rows, valid, taps)
    whole, usable = None, None
    if not valid.all():
        whole, usable = _windows_all(valid, taps), np.ascontiguousarray(valid).ravel()
    terms = torch.empty(0)
    if taps > 1:  # read-only memory is fine: nothing here writes to it
        terms = torch.from_numpy(rows if rows.flags.writeable else np.asarray(Unlocked(rows)))
    return LineTable((lines, samples), rows, terms, usable, whole, damage)


def _apart(
    rows: NDArray[Any], valid: NDArray[np.bool_], taps: int
) -> tuple[NDArray[Any], NDArray[np.bool_], Damage | None]:
    """Part a mask by element into one by sample (any band) and the damage of single elements.

    Those are 0 in the rows given back, for sums; NaN for a kernel of one tap, which copies.
    """
    complete: NDArray[np.bool_] = np.all(valid, axis=2)
    lacking = np.flatnonzero(~complete)
    missing = ~valid.reshape(rows.shape)[lacking]
    some = ~missing.all(axis=1)
    usable = complete.copy()
    usable.ravel()[lacking] = some
    lacking, missing = lacking[some], missing[some]
    if not len(lacking):
        return rows, usable, None
    sample, band = _places(missing)
    place = lacking[sample], band
    if taps == 1 or rows[place].any():  # zeros that the caller has written spare the copy
        rows = rows.astype(np.float32)
        rows[place] = np.nan if taps == 1 else 0
    if taps == 1:
        return rows, usable, None
    bands, column = np.unique(band, return_inverse=True)
    counts = np.ones((len(lacking) + 1, len(bands)), np.float32)
    counts[sample + 1, column] = 0
    kind = np.zeros(len(rows), np.int32)
    kind[lacking] = np.arange(1, len(counts))
    sound = _windows_all((kind == 0).reshape(usable.shape), taps)
    return rows, usable, Damage(bands, kind, torch.from_numpy(counts), sound)


def _places(mask: NDArray[np.bool_]) -> tuple[Rows, Rows]:
    """Rows and columns where a mask holds; np.nonzero of two dimensions is far slower."""
    row, column = np.divmod(np.flatnonzero(mask), max(mask.shape[1], 1))
    return row, column


def _windows_all(mask: NDArray[np.bool_], taps: int) -> NDArray[np.bool_]:
    """Mark corners of windows within which the mask holds, (line, sample) -> less ``taps - 1`` both ways."""
    for axis in (0, 1):
        size = max(mask.shape[axis] - taps + 1, 0)
        held = mask.take(range(size), axis=axis)
        for tap in range(1, taps):
            held &= mask.take(range(tap, tap + size), axis=axis)
        mask = held
    return mask


def _lies_on(placed: Windows, shape: tuple[int, int], corners: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(n,) whether a window lies on the sweep, and its corner among those told."""
    inside = placed.inside(shape)
    if corners is not None and inside.any():
        line, sample = np.where(inside, placed.corner, 0).astype(np.intp)
        inside &= corners[line, sample]
    return inside


def resample(
    values: Values,
    valid: NDArray[np.bool_],
    coordinates: NDArray[np.float64],
    kernel: Kernel = "catmull-rom",
    *,
    out: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Read a sweep (line, sample, band), float32 or uint16, at scattered coordinates, leaving out what is not valid.

    Taps that are not valid or lie off the sweep count nothing and the rest is renormalised; a point whose valid taps
    weigh less than a half fails. Where single elements are invalid this holds for each band on its own. Values of what
    is invalid, NaN included, never reach the result. A point's result does not depend on the other points of the call.

    Parameters
    ----------
    valid
        (line, sample) whether a sample may be used, or (line, sample, band) whether an element may. Where ``values``
        holds 0 at single invalid elements the lines need not be copied.
    coordinates
        (n, 2) float64 line and sample, NaN for points off the sweep. [px of the sweep]
    out
        (n, band) array of the result's type to write to; memory used before spares the page faults of fresh memory.

    Returns
    -------
    (n, band) float32, NaN where the point failed in that band; ``nearest`` gives uint16 back as the same uint16, 0
    where the point failed (float32 with NaN if single elements are invalid). And (n,) float32, the fraction of the
    kernel's weight that lay on samples with a valid band (0..1): 0 where the point failed in every band.
    """
    coordinates = np.asarray(coordinates, np.float64)
    low, high = (
        extreme.reduce(coordinates[:, 0], initial=away) for extreme, away in ((np.fmin, np.inf), (np.fmax, -np.inf))
    )
    first, stop = 0, 0  # of the lines that a tap of any point can lie on
    if low <= high:
        first, stop = np.clip((np.floor(low) - 1, np.floor(high) + 3), 0, len(values)).astype(int).tolist()
    table = table_for(values[first:stop], valid[first:stop], kernel)
    shape, kind = (len(coordinates), values.shape[2]), table.rows.dtype
    out = np.empty(shape, kind) if out is None else out
    fraction = np.zeros(len(coordinates), np.float32)
    for start in range(0, len(out), BLOCK_PX):
        block = slice(start, start + BLOCK_PX)
        placed = windows(coordinates[block], kernel)
        placed.corner[0] -= first
        table.read(placed, out[block], fraction[block])
    return out, fraction


def merge_lines(
    values: Values, valid: NDArray[np.bool_], starts: NDArray[np.intp]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Average the lines of each dwell, those taken while the mirror stood still; they lie next to each other.

    ``starts`` (dwell,) are the ascending numbers of the first line of each, the first being 0. The mask is by sample or
    by element.

    (dwell, sample, band) float32 mean of the valid lines, NaN where there is none (a line alone as it was; the input
    itself, uint16 too, where every line is alone); and whether there is any, with the dimensions of ``valid``.
    """
    counts = np.diff(starts, append=len(values))
    if len(starts) == len(values):
        return values, valid
    merged, known = values[starts].astype(np.float32), valid[starts]
    several = np.flatnonzero(counts > 1)
    starts, counts = starts[several], counts[several]
    mask = valid if valid.ndim == 3 else valid[..., None]
    total = np.zeros((len(starts), *values.shape[1:]))  # float64 holds the sums of any dwell's uint16
    number = np.zeros((len(starts), *mask.shape[1:]), np.intp)
    for member in range(counts.max(initial=0)):
        held = np.flatnonzero(counts > member)
        line = starts[held] + member
        total[held] += np.where(mask[line], values[line], 0)
        number[held] += mask[line]
    merged[several] = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
    known[several] = (number > 0).reshape(len(starts), *valid.shape[1:])
    return merged, known
