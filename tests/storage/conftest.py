"""Where real data lie, and small scenes on disk."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray


@pytest.fixture
def cube() -> NDArray[np.uint16]:
    """A small cube, (7, 9, 5) uint16."""
    return np.random.default_rng(3).integers(0, 4096, (7, 9, 5), dtype=np.uint16)
