"""Bad elements are found and good ones left alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import RigError, ShapeError
from pipeline.rectify.calibration.detector import BadElementCriteria, find_bad_elements

Frame = NDArray[np.float64]


def simulated(samples: int = 640, bands: int = 20, seed: int = 0) -> tuple[Frame, Frame]:
    """Dark and white frames with noise, vignetting, a spectrum, 1 % of uneven response and a column of dust."""
    rng = np.random.default_rng(seed)
    dark = np.rint(64 + rng.normal(0, 0.7, (samples, bands)))
    along = np.cos(np.linspace(-0.6, 0.6, samples))[:, None] ** 4
    light = 3000 * along * np.exp(-(np.linspace(-1.5, 1.5, bands) ** 2))
    light *= rng.normal(1, 0.01, light.shape)
    light[samples // 3] *= 0.6
    return dark, dark + light + rng.normal(0, 1, light.shape)


def test_faults_are_found_and_nothing_else() -> None:
    """Hot, dead, odd and missing elements are bad, side by side too; dust, vignetting and noise are not."""
    dark, white = simulated()
    dark[100, 3] += 50
    white[200, 5] = dark[200, 5]
    white[639, 6] = dark[639, 6]
    white[300:302, 8] += 1500
    white[400, 9] = 0.6 * (white[400, 9] - dark[400, 9]) + dark[400, 9]
    dark[500, 1] = np.nan
    found = np.argwhere(find_bad_elements(dark, white)).tolist()
    assert found == [[100, 3], [200, 5], [300, 8], [301, 8], [400, 9], [500, 1], [639, 6]]


@pytest.mark.parametrize("samples", [2, 3, 5, 12])
def test_few_samples_are_not_accused(samples: int) -> None:
    """With hardly anything to compare a sound detector stays sound."""
    for seed in range(20):
        dark, white = simulated(samples, seed=seed)
        white[samples // 3] = dark[samples // 3] + 1.5 * (white[samples // 3] - dark[samples // 3])
        assert not find_bad_elements(dark, white).any()


def test_one_sample_or_band() -> None:
    """One sample has nothing to be compared with; in one band a dead element is found all the same."""
    assert not find_bad_elements(*simulated(1)).any()
    dark, white = simulated(200, 1)
    white[150] = dark[150]
    assert [150, 0] in np.argwhere(find_bad_elements(dark, white)).tolist()


def test_bands_without_light_are_not_judged() -> None:
    """Where nothing responds no element is called dead, even where white lies below dark."""
    dark, white = simulated()
    white[:, :4] = dark[:, :4] - 8
    assert not find_bad_elements(dark, white)[:, :4].any()


def test_saturated_white_is_bad() -> None:
    """A white frame at full scale says nothing of the response."""
    dark, white = simulated()
    limit = np.sort(white, axis=None)[-20]
    assert not find_bad_elements(dark, white).any()
    np.testing.assert_array_equal(find_bad_elements(dark, white, saturated_dn=limit), white >= limit)


def test_more_than_a_detector_can_have_is_refused() -> None:
    """Frames that would put out too many elements are named as the fault; the limit can be set."""
    dark, white = simulated()
    white[4::9] = dark[4::9]
    with pytest.raises(RigError, match=r"1[01]\.\d % of the elements look bad, at most 5 % can be"):
        find_bad_elements(dark, white)
    assert find_bad_elements(dark, white, criteria=BadElementCriteria(most=0.2))[4::9].all()


def test_frames_must_fit() -> None:
    """Frames of two sizes are refused."""
    with pytest.raises(ShapeError, match=r"\(4, 3\) and \(4, 2\)"):
        find_bad_elements(np.zeros((4, 3)), np.zeros((4, 2)))
