"""Resampling by short separable kernels: masked for captured sweeps, with repeated edges for scenes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from pipeline.errors import ShapeError

Kernel = Literal["catmull-rom", "bilinear", "nearest"]

LEAST_WEIGHT = 0.5
ROUNDING = 1e-6
BLOCK_PX = 2048  # the gathered rows and the block's result stay in cache; larger blocks pay page faults


def kernel_taps(position: NDArray[np.float64], kernel: Kernel) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Give the pixels that each position reads and their weights, along one axis.

    Parameters
    ----------
    position
        (n,) finite coordinates; integers are pixel centres. [px]

    Returns
    -------
    (n, tap) indices, not clipped to any image, and (n, tap) weights that sum to 1; 4, 2 or 1 taps.
    """
    if kernel == "nearest":
        index = np.floor(position + 0.5).astype(np.int64)
        return index[:, None], np.ones((len(position), 1), np.float32)
    base = np.floor(position)
    t = (position - base).astype(np.float32)
    weights: tuple[NDArray[np.float32], ...]
    if kernel == "bilinear":
        first, weights = 0, (1 - t, t)
    elif kernel == "catmull-rom":
        first, weights = -1, _catmull_rom(t)
    else:
        raise ValueError(f"kernel must be 'catmull-rom', 'bilinear' or 'nearest', got {kernel!r}")
    index = base.astype(np.int64)[:, None] + np.arange(first, first + len(weights))
    return index, np.stack(weights, axis=1)


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
    rows, columns, components = planes.shape
    table = _tensor(planes.reshape(-1, components))
    out = np.empty((len(y), components), np.float32)
    for block in _blocks(len(y)):
        row, down = kernel_taps(y[block], kernel)
        column, across = kernel_taps(x[block], kernel)
        np.clip(row, 0, rows - 1, out=row)
        np.clip(column, 0, columns - 1, out=column)
        out[block] = _weighted_rows(table, _outer_index(row, column, columns), _outer_weight(down, across))
    return out


def resample(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    coordinates: NDArray[np.float64],
    kernel: Kernel = "catmull-rom",
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read a sweep at scattered coordinates, leaving out what is not valid.

    Taps that are not valid or lie off the sweep count nothing and the rest is renormalised; a point whose valid taps
    weigh less than a half fails. Values of invalid samples, NaN included, never reach the result.

    Parameters
    ----------
    values
        (line, sample, band) float32.
    valid
        (line, sample) whether a sample may be used.
    coordinates
        (n, 2) line and sample, NaN for points off the sweep. [px of the sweep]

    Returns
    -------
    (n, band) float32, NaN where the point failed, and (n,) float32 share of the kernel's weight that was valid (0..1,
    0 where failed).

    Raises
    ------
    ShapeError : the mask does not fit the values, or the coordinates are not pairs.
    """
    _check_shapes(values, valid, coordinates)
    out = np.empty((len(coordinates), values.shape[2]), np.float32)
    share = np.zeros(len(coordinates), np.float32)
    table = _tensor(values.reshape(-1, values.shape[2]))
    mask = None if valid.all() else np.ascontiguousarray(valid)
    for block in _blocks(len(coordinates)):
        known = np.isfinite(coordinates[block].sum(axis=1)) & (valid.size > 0)
        index, weight = _masked_taps(_rows_of(coordinates[block], known), values.shape[:2], mask, kernel)
        total = _sum_of_taps(weight)
        held = total >= LEAST_WEIGHT
        weight = _renormalised(_rows_of(weight, held), _rows_of(total, held))
        read = _weighted_rows(table, _rows_of(index, held), weight)
        if len(read) < len(known):
            known[known] = held
            out[block][~known] = np.nan
        _put_rows(out[block], known, read)
        _put_rows(share[block], known, np.minimum(total[held], 1))
    return out, share


def _sum_of_taps(weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum of each row's weights; a product with ones, for numpy's sums of short rows cost more than the gather."""
    total: NDArray[np.float32] = weight @ np.ones(weight.shape[1], np.float32)
    return total


def _renormalised(weight: NDArray[np.float32], total: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weights over their total, in place; rows that are whole up to rounding stay as they are."""
    partial = np.flatnonzero(np.abs(total - 1) > ROUNDING)
    if len(partial):
        weight[partial] /= total[partial, None]
    return weight


def _rows_of(array: NDArray[np.generic], chosen: NDArray[np.bool_]) -> NDArray[Any]:
    """``array[chosen]``, without the copy where all are chosen: the rule, in the middle of a sweep."""
    return array if chosen.all() else array[chosen]


def _put_rows(array: NDArray[np.generic], chosen: NDArray[np.bool_], rows: NDArray[np.generic]) -> None:
    if len(rows) == len(array):
        array[:] = rows
    else:
        array[chosen] = rows


def _masked_taps(
    coordinates: NDArray[np.float64], shape: tuple[int, ...], mask: NDArray[np.bool_] | None, kernel: Kernel
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Flat indices and weights of all taps; a tap that may not be used has weight 0 and the index of one that may."""
    line, down = kernel_taps(coordinates[:, 0], kernel)
    sample, across = kernel_taps(coordinates[:, 1], kernel)
    for index, weight, size in ((line, down, shape[0]), (sample, across, shape[1])):
        if len(index) and (index.min() < 0 or index.max() >= size):
            weight *= (index >= 0) & (index < size)
            np.clip(index, 0, size - 1, out=index)
    flat, joint = _outer_index(line, sample, shape[1]), _outer_weight(down, across)
    if mask is not None:
        usable = mask.ravel()[flat]
        joint *= usable
        flat[~usable] = np.argmax(mask)  # 0 times a NaN would still be a NaN
    return flat, joint


def _catmull_rom(t: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """Weights of the four taps around a fraction t in 0..1 (Keys, 1981, a = -1/2)."""
    half = np.float32(0.5)
    s = 1 - t
    first, last = -half * t * s * s, -half * s * t * t
    second = 1 + t * t * (np.float32(1.5) * t - np.float32(2.5))
    return first, second, 1 - first - second - last, last


def _outer_index(row: NDArray[np.int64], column: NDArray[np.int64], columns: int) -> NDArray[np.int64]:
    # Repeated and tiled rows: broadcasting (n, 4, 1) over (n, 1, 4) runs loops of four and takes three times as long.
    return np.repeat(row * columns, column.shape[1], axis=1) + np.tile(column, (1, row.shape[1]))


def _outer_weight(down: NDArray[np.float32], across: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.repeat(down, across.shape[1], axis=1) * np.tile(across, (1, down.shape[1]))


def _weighted_rows(table: torch.Tensor, index: NDArray[np.int64], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum of ``weight`` times the table's rows ``index``, (n, tap) -> (n, column)."""
    if not len(index):
        return np.empty((0, table.shape[1]), np.float32)
    with _one_thread():
        bags = torch.nn.functional.embedding_bag(
            torch.from_numpy(index), table, per_sample_weights=torch.from_numpy(weight), mode="sum"
        )
    rows: NDArray[np.float32] = bags.numpy()
    return rows


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to this thread: blocks are too short to share, and waiting for a second core cost 10x under load."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _tensor(array: NDArray[np.float32]) -> torch.Tensor:
    """View an array as a tensor; read-only memory is fine, for nothing here writes to it."""
    array = np.ascontiguousarray(array, dtype=np.float32)
    if array.flags.writeable:
        return torch.from_numpy(array)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return torch.from_numpy(array)


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, BLOCK_PX):
        yield slice(start, min(start + BLOCK_PX, count))


def _check_shapes(values: NDArray[np.float32], valid: NDArray[np.bool_], coordinates: NDArray[np.float64]) -> None:
    if values.ndim != 3 or valid.shape != values.shape[:2]:
        raise ShapeError(
            f"expected values (line, sample, band) with a mask (line, sample), got {values.shape} and {valid.shape}"
        )
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise ShapeError(f"expected coordinates (n, 2) of line and sample, got {coordinates.shape}; flatten the grid")
