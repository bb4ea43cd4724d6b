"""Statistics of a capture's spectra, beside its raw cubes: a file of numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.signal.subspace import SignalStatistics
from storage.arrays.layout import damage_named

STATISTICS = "statistics.npz"


def write_statistics(folder: Path, found: SignalStatistics) -> None:
    """Store the statistics of a capture in its folder."""
    np.savez(folder / STATISTICS, allow_pickle=False, **found.arrays())


def read_statistics(folder: Path) -> SignalStatistics:
    """Read the statistics of a capture (IncompleteStoreError: they are missing or damaged)."""
    with damage_named(str(folder / STATISTICS)), np.load(folder / STATISTICS) as stored:
        return SignalStatistics.of_arrays(stored)
