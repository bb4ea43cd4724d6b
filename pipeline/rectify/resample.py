"""Resample a sweep's lines, with masks, at scattered points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.rectify.kernels import TAPS, Kernel, Rows, Unlocked, Windows, weighted_rows, windows

if TYPE_CHECKING:
    import torch

LEAST_WEIGHT = 0.5
ROUNDING = 1e-6
BLOCK_PX = 16384  # points at once: smaller blocks cost calls, larger ones gain nothing

Values = NDArray[np.floating] | NDArray[np.integer]
Floats32 = NDArray[np.float32]


def divisor(total: Floats32) -> Floats32:
    """Return the divisor of a sum by its usable weight: 1 for all of the weight, up to rounding; NaN below a half."""
    whole = np.where(np.abs(total - 1) <= ROUNDING, np.float32(1), total)
    return np.where(whole >= LEAST_WEIGHT, whole, np.float32(np.nan))


@dataclass(frozen=True)
class LineTable:
    """Lines of a sweep as rows of a table, with their masks."""

    shape: tuple[int, int]  # lines, samples
    terms: torch.Tensor  # (line * sample, band) float32
    usable: NDArray[np.bool_] | None = None  # (line * sample,) with a valid band; None: all
    whole: NDArray[np.bool_] | None = None  # (line, sample) of a window's corner: all its samples are usable
    elements: torch.Tensor | None = None  # (line * sample, band) float32, 1 for valid elements; None: valid by sample

    def read(self, placed: Windows, out: Floats32, fraction: Floats32) -> None:
        """Write the points' values (n, band), and (n,) the usable fraction of the kernel's weight."""
        import torch

        whole = placed.inside(self.shape)
        if self.whole is not None and whole.any():
            line, sample = np.where(whole, placed.corner, 0).astype(np.intp)
            whole &= self.whole[line, sample]
        if whole.all():
            fraction[:] = self._read_whole(placed, out)
            return
        points = np.flatnonzero(whole)
        out[~whole] = np.nan
        fraction[~whole] = 0
        fraction[points] = self._read_whole(placed.chosen(points), out, points)
        points = np.flatnonzero(~whole & placed.touches(self.shape))
        flat, joint = self._usable_taps(placed.chosen(points))
        total = reduce(np.add, joint.T)  # tap by tap, in the order of `weighted_rows`
        fraction[points] = self._read(torch.from_numpy(flat), torch.from_numpy(joint), total, out, points)

    def _read_whole(self, placed: Windows, out: Floats32, at: Rows | None = None) -> Floats32:
        """Write points whose windows lie wholly on usable samples."""
        total = np.ones(placed.points, np.float32)
        return self._read(placed.flat_index(self.shape), placed.joint_weight(), total, out, at)

    def _read(
        self, index: torch.Tensor, weight: torch.Tensor, total: Floats32, out: Floats32, at: Rows | None
    ) -> Floats32:
        """Write weighted sums, over their usable weight, to the rows ``at`` of ``out``; return the usable fraction.

        ``total`` (n,) is the weight on usable samples.
        """
        weighted_rows(self.terms, index, weight, out, at)
        if self.elements is None:
            by = divisor(total)
            other = np.flatnonzero(by != 1)
            out[other if at is None else at[other]] /= by[other, None]
            known = ~np.isnan(by)
        else:
            seen = np.empty((len(total), out.shape[1]), np.float32)
            weighted_rows(self.elements, index, weight, seen)
            by = divisor(seen)
            out[slice(None) if at is None else at] /= by
            known = np.asarray(~np.isnan(by).all(axis=1))
        return np.where(known, np.minimum(total, 1), np.float32(0))

    def _usable_taps(self, placed: Windows) -> tuple[NDArray[np.int64], Floats32]:
        """Return (n, tap * tap) rows and weights; an unusable tap has weight 0 and the row of a usable one."""
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
            flat[~usable] = np.argmax(self.usable)  # 0 times NaN is NaN
        return flat, joint


def _table(values: Values, valid: NDArray[np.bool_], kernel: Kernel) -> LineTable:
    """Make a table of lines (line, sample, band), valid by sample or by element."""
    import torch

    shape = (values.shape[0], values.shape[1])
    elements = None
    rows = np.ascontiguousarray(values, np.float32).reshape(-1, values.shape[2])
    if valid.ndim == 3:
        usable = np.asarray(valid.any(axis=2))
        if not (valid.all(axis=2) == usable).all():
            flat = valid.reshape(rows.shape)
            rows = np.where(flat, rows, np.float32(0))
            elements = torch.from_numpy(flat.astype(np.float32))
        valid = usable
    # read-only memory is fine: nothing here writes to it
    terms = torch.from_numpy(rows if rows.flags.writeable else np.asarray(Unlocked(rows)))
    if valid.all():
        return LineTable(shape, terms, elements=elements)
    whole = valid
    for axis in (0, 1):
        size = max(shape[axis] - TAPS[kernel] + 1, 0)
        shifted = (whole.take(range(tap, tap + size), axis=axis) for tap in range(TAPS[kernel]))
        whole = np.asarray(reduce(np.logical_and, shifted))
    return LineTable(shape, terms, np.ascontiguousarray(valid).ravel(), whole, elements)


def resample(
    values: Values, valid: NDArray[np.bool_], coordinates: NDArray[np.float64], kernel: Kernel = "catmull-rom"
) -> tuple[Floats32, Floats32]:
    """Read a sweep (line, sample, band) at scattered coordinates, without what is not valid.

    Taps that are not valid or lie off the sweep are left out, and the other weights are renormalised. A point whose
    valid taps weigh less than a half fails. With invalid elements this holds for each band separately. Invalid values,
    NaN included, never reach the result. A point's result does not depend on the other points of the call.

    Parameters
    ----------
    valid
        (line, sample) whether a sample is valid, or (line, sample, band) whether an element is.
    coordinates
        (n, 2) float64 line and sample, NaN for points off the sweep. [px of the sweep]

    Returns
    -------
    (n, band) float32, NaN where the point failed in that band. And (n,) float32, the fraction of the kernel's weight
    on samples with a valid band (0..1): 0 where the point failed in every band.
    """
    coordinates = np.asarray(coordinates, np.float64)
    low = np.fmin.reduce(coordinates[:, 0], initial=np.inf)
    high = np.fmax.reduce(coordinates[:, 0], initial=-np.inf)
    first, stop = 0, 0  # of the lines that a tap of any point can lie on
    if low <= high:
        first, stop = np.clip((np.floor(low) - 1, np.floor(high) + 3), 0, len(values)).astype(int).tolist()
    table = _table(values[first:stop], valid[first:stop], kernel)
    out = np.empty((len(coordinates), values.shape[2]), np.float32)
    fraction = np.zeros(len(coordinates), np.float32)
    for start in range(0, len(out), BLOCK_PX):
        block = slice(start, start + BLOCK_PX)
        placed = windows(coordinates[block], kernel)
        placed.corner[0] -= first
        table.read(placed, out[block], fraction[block])
    return out, fraction


def merge_lines(
    values: Values, valid: NDArray[np.bool_], starts: NDArray[np.intp]
) -> tuple[Floats32, NDArray[np.bool_]]:
    """Average the lines of each dwell: those taken at one place, which lie next to each other.

    ``starts`` (dwell,) are the ascending numbers of the first line of each, from 0. The mask is by sample or by
    element.

    The result is the (dwell, sample, band) float32 mean of the valid lines, NaN if there is none. Its mask has the
    dimensions of ``valid``.
    """
    mask = valid if valid.ndim == 3 else valid[..., None]
    total = np.add.reduceat(np.where(mask, values, 0), starts, axis=0, dtype=np.float64)
    number = np.add.reduceat(mask, starts, axis=0, dtype=np.intp)
    merged = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
    return merged.astype(np.float32), (number > 0).reshape(len(starts), *valid.shape[1:])
