"""Fixtures: an empty archive and a small cube."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.storage.store import Archive


@pytest.fixture
def cube() -> NDArray[np.uint16]:
    """Return a small cube, (7, 9, 5) uint16."""
    return np.random.default_rng(3).integers(0, 4096, (7, 9, 5), dtype=np.uint16)


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an empty archive in a folder."""
    return Archive.open(tmp_path)
