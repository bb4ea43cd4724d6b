"""References are exact means, and elements that do not answer are told."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import RigError, ShapeError
from pipeline.rig.camera_references import as_references, mean_frame


def frames(level: float, count: int = 40, shape: tuple[int, int] = (40, 10)) -> np.ndarray:
    """Noisy frames (frame, sample, band) around a level."""
    rng = np.random.default_rng(3)
    return np.clip(np.rint(rng.normal(level, 4, (count, *shape))), 0, 4095).astype(np.uint16)


def test_mean_and_noise_are_exact() -> None:
    """They are those of float64 over all frames, in any order."""
    taken = frames(200, 200)
    found = mean_frame(taken)
    np.testing.assert_array_equal(found.mean, taken.mean(axis=0).astype(np.float32))
    np.testing.assert_allclose(found.noise, taken.std(axis=0, ddof=1), rtol=1e-6)
    np.testing.assert_array_equal(mean_frame(taken[::-1]).mean, found.mean)


def test_stuck_and_dead_elements_are_told() -> None:
    """One that never changes and one that hardly responds are bad, and the notes count them."""
    dark, white = frames(64), frames(3000)
    dark[:, 3, 4] = 70
    white[:, 20, 5] = 66
    references, notes = as_references(mean_frame(dark), mean_frame(white), panel=0.5)
    assert references.bad is not None
    assert np.argwhere(references.bad).tolist() == [[3, 4], [20, 5]]
    assert references.panel.tolist() == [0.5] * 10
    assert "dark: the mean of 40 frames; 1 of 400 elements are stuck" in notes
    assert "2 of 400 elements are bad" in notes


def test_one_frame() -> None:
    """A single frame is its own mean, and says that it cannot tell stuck elements."""
    found = mean_frame(frames(64, 1))
    assert not found.noise.any()
    assert not found.stuck.any()
    assert "1 frames cannot tell stuck elements; take 8 or more" in found.notes


def test_references_that_do_not_fit() -> None:
    """Swapped frames, two sizes and a panel of other bands are refused."""
    dark, white = mean_frame(frames(64)), mean_frame(frames(3000))
    with pytest.raises(RigError, match="are they swapped, or was the lamp off"):
        as_references(white, dark)
    with pytest.raises(RigError, match="take both anew"):
        as_references(dark, mean_frame(frames(3000, shape=(40, 9))))
    with pytest.raises(RigError, match="one value or one for each of 10 bands"):
        as_references(dark, white, panel=[1, 2])
    with pytest.raises(ShapeError, match="at least one frame"):
        mean_frame(np.zeros((0, 2, 3), np.uint16))
