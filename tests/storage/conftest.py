"""Where real data lie, and small scenes on disk."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real data sets; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("SPECTRALZOOM_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder} (set SPECTRALZOOM_DATA)")
    return folder


@pytest.fixture
def cube() -> NDArray[np.uint16]:
    """A small cube, (7, 9, 5) uint16."""
    return np.random.default_rng(3).integers(0, 4096, (7, 9, 5), dtype=np.uint16)
