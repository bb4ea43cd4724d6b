"""Define short separable kernels: the pixels and weights of a position, and weighted sums of table rows.

The sums use ``torch.nn.functional.embedding_bag`` with the threads of the process; a worker with one core calls
``models.network.machine.use_one_thread``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

Kernel = Literal["catmull-rom", "bilinear", "nearest"]
Rows: TypeAlias = NDArray[np.intp]

BAG_VALUES = 2**18  # per call: sums are copied while they are still in the cache
TAPS = {"catmull-rom": 4, "bilinear": 2, "nearest": 1}


@dataclass(frozen=True)
class Windows:
    """Pixels that a block of points reads: ``tap`` x ``tap`` from a corner on, weighted along both axes."""

    corner: NDArray[np.float64]  # (2, n) first line and sample; whole numbers, NaN where the point has none
    weight: NDArray[np.float32]  # (2, tap, n)

    @property
    def points(self) -> int:
        """Return the number of points."""
        return int(self.weight.shape[2])

    @property
    def taps(self) -> int:
        """Return the taps along one axis."""
        return int(self.weight.shape[1])

    def chosen(self, which: Rows) -> Windows:
        """Return the windows of some of the points."""
        return Windows(self.corner[:, which], self.weight[:, :, which])

    def inside(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Return (n,) whether the whole window lies on an image of this (line, sample) shape."""
        last = np.array(shape)[:, None] - self.taps
        least, most = self.corner.min(axis=1, initial=0), self.corner.max(axis=1, initial=0)
        if (least >= 0).all() and (most <= last[:, 0]).all():  # usual in the middle of a sweep; False with a NaN
            return np.ones(self.points, np.bool_)
        return np.asarray(np.logical_and(*((self.corner >= 0) & (self.corner <= last))))

    def touches(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Return (n,) whether any tap lies on an image of this (line, sample) shape."""
        size = np.array(shape)[:, None]
        touching: NDArray[np.bool_] = np.logical_and(*((self.corner > -self.taps) & (self.corner < size)))
        return touching & bool(size.all())

    def joint_weight(self) -> torch.Tensor:
        """Return (n, tap * tap) products of the weights along both axes, lines first."""
        import torch

        down, across = _spread(self.taps)
        along_lines, along_samples = (torch.from_numpy(part) for part in self.weight)
        # Products with zeros and ones are exact, in whatever order they are summed, and much faster than broadcasting
        # (n, 4, 1) over (n, 1, 4), which runs loops of four.
        return torch.mm(along_lines.T, down).mul_(torch.mm(along_samples.T, across))

    def flat_index(self, shape: tuple[int, int]) -> torch.Tensor:
        """Return (n, tap * tap) rows of a (line * sample) table of this shape, for windows that lie inside."""
        import torch

        lines, samples = shape
        kind = np.int32 if lines * samples < 2**31 else np.int64  # half the bytes
        first = (self.corner[0] * samples + self.corner[1]).astype(kind)
        step = np.add.outer(np.arange(self.taps) * samples, np.arange(self.taps)).ravel().astype(kind)
        return torch.from_numpy(first)[:, None] + torch.from_numpy(step)

    def taps_by_axis(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (n, tap) lines and samples, not clipped to any image; the corners must be finite."""
        line, sample = self.corner.astype(np.int64)[:, :, None] + np.arange(self.taps)
        return line, sample


def windows(coordinates: NDArray[np.float64], kernel: Kernel) -> Windows:
    """Place the kernel around points, (n, 2) line and sample; integers are pixel centres. [px]"""
    position = np.array(coordinates.T, dtype=np.float64, order="C")
    if kernel == "nearest":
        return Windows(np.floor(position + 0.5), np.ones((2, 1, position.shape[1]), np.float32))
    with np.errstate(invalid="ignore"):  # infinity less infinity
        base = np.floor(position)
        position -= base
    t = position.astype(np.float32)
    weight = np.empty((2, TAPS[kernel], t.shape[1]), np.float32)
    if kernel == "bilinear":
        np.subtract(1, t, out=weight[:, 0])
        weight[:, 1] = t
    else:
        _catmull_rom(t, weight)
        base -= 1
    return Windows(base, weight)


def kernel_taps(position: NDArray[np.float64], kernel: Kernel) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the pixels that each of (n,) finite positions reads and their weights, along one axis.

    (n, tap) indices, not clipped to any image, and (n, tap) weights that sum to 1; 4, 2 or 1 taps.
    """
    placed = windows(np.stack([position, position], axis=1), kernel)
    return placed.taps_by_axis()[0], np.ascontiguousarray(placed.weight[0].T)


def weighted_rows(
    table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, out: NDArray[np.float32], at: Rows | None = None
) -> None:
    """Write sums of ``weight`` times the table's rows ``index``, (n, tap), to the rows ``at`` of ``out`` (or to all).

    Each sum runs over its taps in order, whatever the other points are.
    """
    import torch

    count, taps = index.shape
    size = max(BAG_VALUES // max(table.shape[1], 1), 64)
    starts = torch.arange(0, min(size, count) * taps, taps, dtype=index.dtype)
    for first in range(0, count if table.shape[1] else 0, size):
        part = slice(first, min(first + size, count))
        places, weights = index[part].view(-1), weight[part].view(-1)
        bags = torch.embedding_bag(table, places, starts[: part.stop - first], False, 0, False, weights, False)
        out[part if at is None else at[part]] = bags[0].numpy()


class Unlocked:
    """View of a read-only array as writable memory: torch warns otherwise, and a thread cannot silence warnings."""

    def __init__(self, array: NDArray[np.float32]) -> None:
        self.array = array  # keeps the memory
        self.__array_interface__ = {**array.__array_interface__, "data": (array.__array_interface__["data"][0], False)}


def _catmull_rom(t: NDArray[np.float32], weight: NDArray[np.float32]) -> None:
    """Write the weights of the four taps around a fraction t in 0..1, (2, n) -> (2, 4, n) (Keys, 1981, a = -1/2)."""
    half = np.float32(0.5)
    s = 1 - t
    first, second, third, last = (weight[:, tap] for tap in range(4))
    np.multiply(-half * t * s, s, out=first)
    np.multiply(-half * s * t, t, out=last)
    np.add(1, t * t * (np.float32(1.5) * t - np.float32(2.5)), out=second)
    np.subtract(1 - first - second, last, out=third)


@cache
def _spread(taps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return matrices (tap, tap * tap) of zeros and ones that repeat weights for every tap of the other axis."""
    import torch

    one = np.eye(taps, dtype=np.float32)
    row = np.ones((1, taps), np.float32)
    return torch.from_numpy(np.kron(one, row)), torch.from_numpy(np.kron(row, one))
