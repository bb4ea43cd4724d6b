"""The loop over changes is the formula that it stands for."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulator.compiled_loops import greatest_changes

ROUNDING = 1e-3


@pytest.mark.parametrize("binning", [1, 3])
def test_greatest_change_of_numbers(binning: int) -> None:
    """Means of changes with their signs, rounding left out, over the unit: the greatest of all shifts and bands."""
    rng = np.random.default_rng(binning)
    finest = rng.uniform(-100, 1000, (4, 6 * binning, 11)).astype(np.float32)
    change = rng.normal(0, 2, finest.shape).astype(np.float32)
    light, scale = finest + change, rng.uniform(1, 9, (4, 6, 11)).astype(np.float32)
    found = np.zeros(6)
    greatest_changes(light, finest, scale, binning, ROUNDING, found)
    kept = np.where(np.abs(light - finest) > ROUNDING * np.abs(finest), light - finest, 0)
    wanted = (np.abs(kept.reshape(4, 6, binning, 11).mean(axis=2)) / scale).max(axis=(0, 2))
    np.testing.assert_allclose(found, wanted, rtol=1e-4)


def test_rounding_is_no_change() -> None:
    """What differs by rounding alone changes nothing."""
    finest = np.full((1, 2, 3), 1000.0, np.float32)
    found = np.zeros(2)
    greatest_changes(finest + np.float32(0.9), finest, np.ones((1, 2, 3), np.float32), 1, ROUNDING, found)
    assert found.tolist() == [0.0, 0.0]
