"""Resampling at scattered points: masked for captured sweeps, with repeated edges for scenes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.rectify.kernels import Kernel, kernel_taps, outer_index, tensor_rows, weighted_rows, windows
from pipeline.rectify.line_table import Values, table_for

__all__ = ["BLOCK_PX", "Kernel", "gather", "kernel_taps", "merge_lines", "resample", "to_uint16"]

BLOCK_PX = 16384  # smaller blocks pay calls, and larger ones gain nothing


def gather(
    planes: NDArray[np.float32], y: NDArray[np.float64], x: NDArray[np.float64], kernel: Kernel = "catmull-rom"
) -> NDArray[np.float32]:
    """Interpolate an image at scattered points; outside, the edge pixel is repeated.

    Parameters
    ----------
    planes
        (row, column, component) float32, without NaN.
    y, x
        (n,) rows and columns; integers are pixel centres. [px]

    Returns
    -------
    (n, component) float32. A point's result does not depend on the other points of the call.
    """
    import torch

    rows, columns, components = planes.shape
    table = tensor_rows(np.ascontiguousarray(planes, np.float32).reshape(rows * columns, components))
    out = np.empty((len(y), components), np.float32)
    for block in _blocks(len(out)):
        placed = windows(np.stack([y[block], x[block]], axis=1), kernel)
        edge = np.flatnonzero(~placed.inside((rows, columns)))
        row, column = placed.chosen(edge).taps_by_axis()
        placed.corner[:, edge] = 0
        index = placed.flat_index((rows, columns))
        clipped = outer_index(row.clip(0, rows - 1), column.clip(0, columns - 1), columns)
        index[torch.from_numpy(edge)] = torch.from_numpy(clipped).to(index.dtype)
        weighted_rows(table, index, placed.joint_weight(), out[block])
    return out


def resample(
    values: Values,
    valid: NDArray[np.bool_],
    coordinates: NDArray[np.float64],
    kernel: Kernel = "catmull-rom",
    *,
    out: NDArray[Any] | None = None,
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Read a sweep at scattered coordinates, leaving out what is not valid.

    Taps that are not valid or lie off the sweep count nothing and the rest is renormalised; a point whose valid taps
    weigh less than a half fails. Where single elements are invalid this holds for each band on its own. Values of what
    is invalid, NaN included, never reach the result. A point's result does not depend on the other points of the call.

    Parameters
    ----------
    values
        (line, sample, band) float32 or uint16.
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
    where the point failed (float32 with NaN if single elements are invalid). And (n,) float32, the share of the
    kernel's weight that lay on samples with a valid band (0..1): 0 where the point failed in every band.

    Raises
    ------
    ShapeError : the mask does not fit the values, the coordinates are not pairs, or ``out`` does not fit.
    """
    _check_mask(values, valid)
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise ShapeError(f"expected coordinates (n, 2) of line and sample, got {coordinates.shape}; flatten the grid")
    coordinates = np.asarray(coordinates, np.float64)
    first, stop = _lines_in_reach(coordinates[:, 0], len(values))
    table = table_for(values[first:stop], valid[first:stop], kernel)
    out = _checked_out(out, (len(coordinates), values.shape[2]), table.rows.dtype)
    share = np.zeros(len(coordinates), np.float32)
    for block in _blocks(len(out)):
        placed = windows(coordinates[block], kernel)
        placed.corner[0] -= first
        table.read(placed, out[block], share[block])
    return out, share


def merge_lines(
    values: Values, valid: NDArray[np.bool_], starts: NDArray[np.intp]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Average the lines of each dwell: those taken while the mirror stood still.

    Parameters
    ----------
    values
        (line, sample, band) float32 or uint16, the lines of one dwell next to each other.
    valid
        (line, sample) or (line, sample, band).
    starts
        (dwell,) ascending number of the first line of each; the first is 0.

    Returns
    -------
    (dwell, sample, band) float32 mean of the valid lines, NaN where there is none (a line alone as it was; the input
    itself, uint16 too, where every line is alone); and whether there is any, with the dimensions of ``valid``.

    Raises
    ------
    ShapeError : ``starts`` does not part the lines, or the mask does not fit the values.
    """
    _check_mask(values, valid)
    counts = np.diff(starts, append=len(values))
    if (counts < 1).any() or (starts[:1] != 0).any() or len(starts) == 0 < len(values):
        raise ShapeError(f"expected ascending first lines from 0 on, below {len(values)}, got {starts.tolist()[:8]}")
    if len(starts) == len(values):
        return values, valid
    merged, known = values[starts].astype(np.float32), valid[starts]
    several = np.flatnonzero(counts > 1)
    merged[several], known[several] = _means(values, valid, starts[several], counts[several])
    return merged, known


def _means(
    values: Values, valid: NDArray[np.bool_], starts: NDArray[np.intp], counts: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean over the valid of ``counts`` lines from ``starts`` on; summed in float64, which holds any dwell's uint16."""
    mask = valid if valid.ndim == 3 else valid[..., None]
    total = np.zeros((len(starts), *values.shape[1:]))
    number = np.zeros((len(starts), *mask.shape[1:]), np.intp)
    for member in range(counts.max(initial=0)):
        held = np.flatnonzero(counts > member)
        line = starts[held] + member
        total[held] += np.where(mask[line], values[line], 0)
        number[held] += mask[line]
    mean = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
    return mean, (number > 0).reshape(len(starts), *valid.shape[1:])


def to_uint16(values: NDArray[np.floating]) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Round to uint16, halves to even, clipped to its range first: what overshoots an edge would wrap around.

    Returns
    -------
    uint16, 0 for NaN; and where there was a value. Both shaped as the input.
    """
    known = ~np.isnan(values)
    held = np.where(known, values, 0)
    np.clip(held, 0, np.iinfo(np.uint16).max, out=held)
    return np.rint(held, out=held).astype(np.uint16), known


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, BLOCK_PX):
        yield slice(start, min(start + BLOCK_PX, count))


def _lines_in_reach(place: NDArray[np.float64], lines: int) -> tuple[int, int]:
    """First line that a tap of any point can lie on, and the one after the last; none where no point has a place."""
    least, most = np.fmin.reduce(place, initial=np.inf), np.fmax.reduce(place, initial=-np.inf)
    if least > most:
        return 0, 0
    first, stop = np.clip((np.floor(least) - 1, np.floor(most) + 3), 0, lines).astype(int).tolist()
    return first, stop


def _checked_out(out: NDArray[Any] | None, shape: tuple[int, int], kind: np.dtype[Any]) -> NDArray[Any]:
    if out is None:
        return np.empty(shape, kind)
    if out.shape != shape or out.dtype != kind or not out.flags.c_contiguous:
        raise ShapeError(f"expected out {shape} of {kind}, rows next to each other, got {out.shape} of {out.dtype}")
    return out


def _check_mask(values: Values, valid: NDArray[np.bool_]) -> None:
    if values.ndim != 3 or valid.shape not in (values.shape[:2], values.shape):
        raise ShapeError(
            "expected values (line, sample, band) with a mask (line, sample) or (line, sample, band), "
            f"got {values.shape} and {valid.shape}"
        )
