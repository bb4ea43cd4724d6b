"""Calibration: dark, white and panel to scene values; dead and saturated samples."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import ShapeError
from pipeline.rectify.calibrate import calibrate, reflectance
from pipeline.source import References


def frames(samples: int = 4, bands: int = 3) -> References:
    """References with a dark of 60 DN, a white of 1060 DN and a panel of value 2."""
    return References(
        dark=np.full((samples, bands), 60, np.float32),
        white=np.full((samples, bands), 1060, np.float32),
        panel=np.full(bands, 2, np.float32),
    )


def test_hand_worked_values() -> None:
    """Dark is 0, white is the panel, a quarter of the way is a quarter of the panel; below dark is negative."""
    raw = np.tile(np.array([60, 1060, 310, 10], np.uint16)[None, :, None], (2, 1, 3))
    values = reflectance(raw, frames())
    assert values.dtype == np.float32
    np.testing.assert_allclose(values[1, :, 0], [0, 2, 0.5, -0.1], atol=1e-6)


def test_saturated_band_puts_its_sample_out() -> None:
    """One saturated band makes the sample invalid, and no other."""
    raw = np.full((2, 4, 3), 500, np.uint16)
    raw[1, 2, 0] = 4095
    _, valid = calibrate(raw, frames(), saturated_dn=4095)
    assert np.argwhere(~valid).tolist() == [[1, 2]]


def test_dead_detector_cell_puts_its_sample_out() -> None:
    """Where white is not above dark in one band the value is NaN and the sample invalid on every line."""
    references = frames()
    references.white[3, 1] = 60
    values, valid = calibrate(np.full((2, 4, 3), 500, np.uint16), references, saturated_dn=4095)
    assert np.isnan(values[:, 3, 1]).all()
    assert np.isfinite(values).sum() == values.size - 2
    assert valid.tolist() == [[True, True, True, False]] * 2


def test_band_without_light_stays_alone() -> None:
    """A band that no sample is calibrated in is NaN, and the other bands remain usable."""
    references = frames()
    references.white[:, 2] = references.dark[:, 2]
    values, valid = calibrate(np.full((2, 4, 3), 500, np.uint16), references, saturated_dn=4095)
    assert np.isnan(values[..., 2]).all()
    assert np.isfinite(values[..., :2]).all()
    assert valid.all()


def test_all_dark_lines_are_zero_and_valid() -> None:
    """Lines at the dark level give exactly 0."""
    values, valid = calibrate(np.full((3, 4, 3), 60, np.uint16), frames(), saturated_dn=4095)
    assert (values == 0).all()
    assert valid.all()


def test_no_lines_give_no_values() -> None:
    """An empty block of lines passes through."""
    values, valid = calibrate(np.zeros((0, 4, 3), np.uint16), frames(), saturated_dn=4095)
    assert values.shape == (0, 4, 3)
    assert valid.shape == (0, 4)


def test_references_of_another_binning_are_refused() -> None:
    """The message names both sizes and says what to do."""
    with pytest.raises(ShapeError, match=r"8 samples and 3 bands, the dark frame \(4, 3\); take references"):
        calibrate(np.zeros((1, 8, 3), np.uint16), frames(), saturated_dn=4095)
    bad = References(frames().dark, frames().white, np.ones(5, np.float32))
    with pytest.raises(ShapeError, match=r"3 bands, the panel \(5,\)"):
        reflectance(np.zeros((1, 4, 3), np.uint16), bad)
    with pytest.raises(ShapeError, match=r"\(line, sample, band\)"):
        reflectance(np.zeros((4, 3), np.uint16), frames())
