"""Hard cases of the calibration: faults of the detector, the light and the references."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spectralzoom.pipeline.signal.calibrate import calibrate, find_bad_elements
from spectralzoom.pipeline.source import References

FULL = 4095


def frames(samples: int = 12, bands: int = 10) -> References:
    """Return references with a dark of 60.5 DN, a white of 2060.5 DN and a white reference of 1."""
    dark = np.full((samples, bands), 60.5, np.float32)
    return References(dark, dark + 2000, np.ones(bands, np.float32))


def test_sum_with_saturated_samples_is_invalid() -> None:
    """The docstring's limits: n F marks sums saturated throughout, n (F - 1) + 1 also sums saturated in part."""
    sums = np.array([4 * FULL, 4 * (FULL - 1) + 1, 4 * (FULL - 1)], np.uint16)
    raw = np.broadcast_to(sums[None, :, None], (1, 3, 2))
    assert calibrate(raw, frames(3, 2), saturated_dn=4 * FULL)[1].tolist() == [[False, True, True]]
    assert calibrate(raw, frames(3, 2), saturated_dn=4 * (FULL - 1) + 1)[1].tolist() == [[False, False, True]]


@pytest.mark.parametrize("kind", ["flagged", "unflagged"])
def test_dead_column_is_invalid(kind: str) -> None:
    """A column without response is NaN and invalid, flagged as bad or not; its neighbours stay valid."""
    references = frames()
    references.white[5] = references.dark[5]
    if kind == "flagged":
        references = replace(references, bad=find_bad_elements(references.dark, references.white))
    values, valid = calibrate(np.full((2, 12, 10), 500, np.uint16), references, saturated_dn=FULL)
    assert np.isnan(values[:, 5]).all()
    assert np.argwhere(~valid).tolist() == [[0, 5], [1, 5]]


NOT_FINITE = [{frame: value} for frame in ("dark", "white") for value in (np.nan, np.inf, -np.inf)]
NO_SENSE = [{"dark": 0, "white": above} for above in (-5, 0, 1e-39)]


@pytest.mark.parametrize("changed", [*NOT_FINITE, *NO_SENSE], ids=str)
def test_element_with_impossible_references_is_invalid(changed: dict[str, float]) -> None:
    """Non-finite frames, or a white below or close to the dark invalidate that element alone."""
    references = frames()
    for frame, value in changed.items():
        getattr(references, frame)[3, 7] = value
    values, valid = calibrate(np.full((1, 12, 10), 500, np.uint16), references, saturated_dn=FULL)
    assert np.argwhere(np.isnan(values)).tolist() == np.argwhere(~valid).tolist() == [[0, 3, 7]]


@pytest.mark.parametrize(("samples", "bands"), [(1, 1), (1, 10), (12, 1), (2, 2)])
def test_smallest_frames_calibrate(samples: int, bands: int) -> None:
    """One line, one sample and one band calibrate like any other; if all elements are bad, all values are NaN."""
    references = frames(samples, bands)
    raw = np.full((1, samples, bands), 1060, np.uint16)
    values, valid = calibrate(raw, references, saturated_dn=FULL)
    np.testing.assert_allclose(values, (1060 - 60.5) / 2000, rtol=1e-6)
    assert valid.all()
    values, valid = calibrate(raw, replace(references, bad=np.ones((samples, bands), np.bool_)), saturated_dn=FULL)
    assert np.isnan(values).all()
    assert not valid.any()
