"""Counts of values in 2^18 bins as wide as floating numbers are apart: percentiles of any range, mergeable exactly.

A bin is a float32 cut to its sign, exponent and 9 bits of mantissa: its width is at most 1/512 of the values in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

KEPT = 18  # bits of a float32 that name its bin
RELATIVE_WIDTH = 2.0**-9  # of a bin, at most

Bins = NDArray[np.int64]
Tally = tuple[Bins, Bins]  # bins, rising, and how many values lie in each


def count_bins(values: NDArray[np.generic]) -> Tally:
    """Count finite values, of which there is at least one; those beyond float32 count as its largest."""
    bins = bins_of(values)
    least = int(bins.min())
    tally = np.bincount(bins - least)
    there = np.flatnonzero(tally)
    return there + least, tally[there]


def bins_of(values: NDArray[np.generic]) -> Bins:
    """Bins of finite values: the order of bins is the order of values."""
    largest = np.finfo(np.float32).max
    single = np.clip(values, -largest, largest).astype(np.float32) + np.float32(0)  # + 0: -0 and 0 are one value
    bits = single.view(np.uint32)
    flipped = bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
    bins: Bins = (flipped >> np.uint32(32 - KEPT)).astype(np.int64)
    return bins


def edges_of(bins: Bins) -> NDArray[np.float64]:
    """Least value of each bin."""
    flipped = (bins << (32 - KEPT)).astype(np.uint32)
    bits = flipped ^ np.where(flipped >> 31, np.uint32(0x80000000), np.uint32(0xFFFFFFFF))
    return bits.view(np.float32).astype(np.float64)


def percentile(bins: Bins, tally: Bins, percent: float) -> float:
    """Where a share of the values lies below, straight through the bin that holds it."""
    reached = np.cumsum(tally)
    rank = percent / 100 * (reached[-1] - 1)
    at = int(np.searchsorted(reached, rank, side="right"))
    low, high = edges_of(bins[at] + np.arange(2))
    return float(low + (high - low) * (rank - (reached[at] - tally[at]) + 0.5) / tally[at])


def merge_bins(one: Tally, other: Tally) -> Tally:
    """Add up two tallies."""
    if not len(one[0]) or not len(other[0]):
        return one if len(one[0]) else other
    bins = np.concatenate([one[0], other[0]])
    order = np.argsort(bins, kind="stable")  # two rising runs: linear
    bins, tally = bins[order], np.concatenate([one[1], other[1]])[order]
    first = np.flatnonzero(np.concatenate([[True], bins[1:] != bins[:-1]]))
    return bins[first], np.add.reduceat(tally, first)
