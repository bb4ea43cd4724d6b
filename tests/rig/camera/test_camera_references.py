"""References are exact means, and elements that do not answer are told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipeline.errors import RigError, ShapeError
from pipeline.rig.camera.camera_cubes import as_references, mean_frame


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


def shifted(taken: np.ndarray, at: int, count: int) -> np.ndarray:
    """Frames as they are read after so many bytes came in between, from a byte on."""
    written = np.ascontiguousarray(taken.transpose(0, 2, 1)).tobytes()
    data = (written[:at] + bytes(count) + written[at:])[: len(written)]
    return np.frombuffer(data, np.uint16).reshape(taken.shape[0], taken.shape[2], -1).transpose(0, 2, 1)


@settings(max_examples=60, deadline=None)
@example(frame=16, count=2, offset=0)
@given(st.integers(1, 31), st.integers(1, 16), st.integers(0, 799))
def test_shifted_frames_are_no_reference(frame: int, count: int, offset: int) -> None:
    """Bytes put in between change no element by more than its noise: it is bad, or the reference is refused."""
    rng = np.random.default_rng(frame)
    level = 64 + 3000 * (rng.random((40, 10)) < 0.02)
    dark = np.clip(np.rint(level + rng.normal(0, 4, (32, 40, 10))), 0, 4095).astype(np.uint16)
    whole, white = mean_frame(dark), mean_frame(frames(3500))
    found = mean_frame(shifted(dark, frame * 800 + offset, count))
    try:
        references, _ = as_references(found, white)
    except RigError:
        return
    assert references.bad is not None
    off = np.abs(references.dark - whole.mean)
    assert off[~references.bad].max() < 12 * 5


def test_references_that_are_not_steady() -> None:
    """A cloud amid the white frames, and rows that begin elsewhere in some frames, are refused; one hit is flagged."""
    dark, white = frames(64), frames(3000) + 10 * np.arange(40, dtype=np.uint16)[:, None]
    cloudy = white.copy()
    cloudy[30:] //= 2
    with pytest.raises(RigError, match=r"10 of 40 frames of the white reference show something else .*30, 31, 32"):
        as_references(mean_frame(dark), mean_frame(cloudy))
    rolled = white.copy()
    rolled[20:25] = np.roll(white[20:25], 3, axis=1)
    with pytest.raises(RigError, match="of the white reference"):
        as_references(mean_frame(dark), mean_frame(rolled))
    hit = dark.copy()
    hit[7, 11, 2] = 4000
    references, notes = as_references(mean_frame(hit), mean_frame(white))
    assert np.argwhere(references.bad).tolist() == [[11, 2]]
    assert "dark: 1 of 400 elements jump amid the frames" in notes
