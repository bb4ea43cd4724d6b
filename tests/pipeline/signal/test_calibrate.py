"""Calibration: raw numbers to scene values, bad and saturated elements, mirror, and bad element search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import PoseError, RigError, SceneError, ShapeError
from spectralzoom.pipeline.geometry.mirror import mirror_throughput
from spectralzoom.pipeline.signal.calibrate import calibrate, check_frames, find_bad_elements, number_values
from spectralzoom.pipeline.source import References


def reflectance(raw: NDArray[np.uint16], references: References, position: object = None) -> NDArray[np.float32]:
    """Return scene values without saturation."""
    return calibrate(raw, references, saturated_dn=np.inf, position=position)[0]


def frames(samples: int = 4, bands: int = 3) -> References:
    """Return references with a dark of 60 DN, a white of 1060 DN and a white reference of value 2."""
    return References(
        dark=np.full((samples, bands), 60, np.float32),
        white=np.full((samples, bands), 1060, np.float32),
        white_reference=np.full(bands, 2, np.float32),
    )


def test_calibrated_values_are_those_worked_out_by_hand() -> None:
    """Dark gives 0, white the white reference, and values between are linear; below dark they are negative."""
    values = reflectance(np.tile(np.array([60, 1060, 310, 10], np.uint16)[None, :, None], (2, 1, 3)), frames())
    assert values.dtype == np.float32
    np.testing.assert_allclose(values[1, :, 0], [0, 2, 0.5, -0.1], atol=1e-6)


def test_sums_and_fractions_of_numbers_are_calibrated() -> None:
    """Numbers beyond 16 bits do not wrap, and fractions are kept."""
    for raw in (np.full((2, 6, 3), 100_000, np.uint32), np.full((2, 6, 3), 10.25, np.float32)):
        values, _ = calibrate(raw, frames(6), saturated_dn=np.inf)
        small, _ = calibrate(np.full(raw.shape, 10, np.uint16), frames(6), saturated_dn=np.inf)
        one, _ = calibrate(np.full(raw.shape, 11, np.uint16), frames(6), saturated_dn=np.inf)
        np.testing.assert_allclose(values, small + (raw - 10.0) * (one - small), rtol=1e-5)


@pytest.mark.parametrize(
    ("unlit", "bad", "hot", "out"),
    [
        ([], [], [(1, 2, 0), (1, 2, 1), (1, 2, 2)], [[1, 2]]),
        ([], [], [(1, 2, 0), (1, 2, 1), (1, 2, 2), (1, 3, 0)], [[1, 2, 0], [1, 2, 1], [1, 2, 2], [1, 3, 0]]),
        ([(3, 1)], [], [], [[0, 3, 1], [1, 3, 1]]),
        ([(3, 1)], [], [(0, 3, 2)], [[0, 3, 1], [0, 3, 2], [1, 3, 1]]),
        ([], [(1, 2)], [(0, 2, 2), (1, 0, 2)], [[0, 1, 2], [0, 2, 2], [1, 0, 2], [1, 1, 2]]),
        (
            [(n, 2) for n in range(4)],
            [],
            [(0, 0, 0), (0, 0, 1), (0, 3, 0)],
            [[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 3, 0]],
        ),
    ],
    ids=["sample", "band", "unlit", "both", "filled from saturated", "band without light"],
)
def test_an_invalid_element_invalidates_only_itself(unlit: list, bad: list, hot: list, out: list) -> None:
    """Saturated, unlit and wrongly filled elements are invalid; a sample is invalid if all its lit bands are."""
    references = replace(frames(), bad=np.zeros((4, 3), np.bool_))
    raw = np.full((2, 4, 3), 500, np.uint16)
    for place in unlit:
        references.white[place] = 60
    for place in bad:
        references.bad[place] = True
    for place in hot:
        raw[place] = 4095
    values, valid = calibrate(raw, references, saturated_dn=4095)
    assert np.argwhere(~valid).tolist() == out
    assert np.argwhere(np.isnan(values[0])).tolist() == [list(place) for place in sorted(unlit)]


def test_bad_elements_are_interpolated_along_the_line() -> None:
    """A bad element gets the value between its good neighbours in the band, or that of the only one."""
    raw = np.full((1, 6, 3), 60, np.uint16)
    raw[0, :, 1] = [4095, 160, 4095, 4095, 460, 560]
    bad = np.zeros((6, 3), np.bool_)
    bad[[0, 2, 3], 1] = True
    values, valid = calibrate(raw, replace(frames(6), bad=bad), saturated_dn=4095)
    np.testing.assert_allclose(values[0, :, 1], [0.2, 0.2, 0.4, 0.6, 0.8, 1.0], rtol=1e-6)
    assert valid.shape == (1, 6)
    assert valid.all()


def test_an_invalid_sample_fills_no_bad_element() -> None:
    """A sample with more than half of its bands bad is skipped when a neighbour's bad element is filled."""
    raw = np.broadcast_to(np.array([60, 160, 4000, 360], np.uint16)[None, :, None], (1, 4, 3))
    bad = np.zeros((4, 3), np.bool_)
    bad[2, :2] = bad[1, 2] = True
    values, valid = calibrate(raw, replace(frames(), bad=bad), saturated_dn=4095)
    np.testing.assert_allclose(values[0, 1, 2], 0.2, rtol=1e-6)
    assert np.argwhere(~valid).tolist() == [[0, 2]]


def test_bad_elements_are_filled_from_at_most_8_samples_away() -> None:
    """A farther neighbour does not count: the nearer one is used alone, and without one the element stays NaN."""
    raw = np.full((1, 30, 3), 60, np.uint16)
    raw[0, :, 1] = 60 + 10 * np.arange(30)
    bad = np.zeros((30, 3), np.bool_)
    bad[3:21, 1] = True
    values, valid = calibrate(raw, replace(frames(30), bad=bad), saturated_dn=4095)
    np.testing.assert_allclose(values[0, 3:11, 1], 0.02 * 2, rtol=1e-6)
    np.testing.assert_allclose(values[0, 13:21, 1], 0.02 * 21, rtol=1e-6)
    assert np.argwhere(~valid).tolist() == [[0, 11, 1], [0, 12, 1]]
    assert np.isnan(values[0, 11:13, 1]).all()


@given(arrays(np.bool_, (5, 4)), st.integers(0, 9))
def test_bad_elements_change_no_good_element(bad: NDArray[np.bool_], seed: int) -> None:
    """Good elements keep their values. A sample is invalid if more than half of its bands are bad."""
    raw = np.random.default_rng(seed).integers(0, 900, (3, 5, 4), dtype=np.uint16)
    values, valid = calibrate(raw, replace(frames(5, 4), bad=bad), saturated_dn=4095)
    np.testing.assert_array_equal(values[:, ~bad], reflectance(raw, frames(5, 4))[:, ~bad])
    lit = ~bad.all(axis=0)
    gone = ((bad & lit).sum(axis=1) * 2 > lit.sum()) | (not lit.any())
    whole = valid if valid.ndim == 2 else valid.any(axis=2)
    np.testing.assert_array_equal(~whole, np.broadcast_to(gone, (3, 5)))
    assert np.isfinite(values[:, ~gone][..., lit]).all() or valid.ndim == 3


def test_mirror_throughput_divides_the_values() -> None:
    """The throughput divides its line, so that the scene is the same at any position."""
    position = np.array([[0.0, 0.0], [0.3, -0.2]])
    values = reflectance(np.full((2, 4, 3), 560, np.uint16), replace(frames(), by_mirror=True), position=position)
    np.testing.assert_allclose(values[0, :, 0], 1, rtol=1e-6)
    np.testing.assert_allclose(values[1] * mirror_throughput(position[1]), values[0], rtol=1e-6)


def test_a_number_has_its_value_at_the_longest_exposure() -> None:
    """White of 5 ms and lines of up to 10 ms: a DN is half of what it is in the white frame."""
    exposure_ms = np.array([2, 10, np.nan])
    np.testing.assert_allclose(number_values(frames(), exposure_ms), 0.002)
    np.testing.assert_allclose(number_values(replace(frames(), exposure_ms=5.0), exposure_ms), 0.001)


def test_lines_without_a_position_are_invalid() -> None:
    """With references by the mirror, a line without a position is NaN. Calibration without positions is an error."""
    raw = np.full((2, 4, 3), 560, np.uint16)
    references = replace(frames(), by_mirror=True)
    values, valid = calibrate(raw, references, saturated_dn=4095, position=[[0.0, 0.0], [np.nan, 0.0]])
    assert np.isnan(values[1]).all()
    assert valid.tolist() == [[True] * 4, [False] * 4]
    with pytest.raises(PoseError, match="needs the lines' mirror positions"):
        calibrate(raw, references, saturated_dn=4095)


def test_calibration_does_not_depend_on_blocks() -> None:
    """Lines calibrated together have the same bits as lines calibrated one by one."""
    rng = np.random.default_rng(1)
    references = replace(frames(700, 200), bad=rng.random((700, 200)) < 0.01)
    raw = rng.integers(0, 4096, (5, 700, 200), dtype=np.uint16)
    values, valid = calibrate(raw, references, saturated_dn=4090)
    for n in range(5):
        one, known = calibrate(raw[n : n + 1], references, saturated_dn=4090)
        np.testing.assert_array_equal(values[n], one[0])
        np.testing.assert_array_equal(valid[n], known[0])


def test_references_of_another_binning_are_refused() -> None:
    """The message has both sizes and a remedy."""
    with pytest.raises(ShapeError, match=r"8 samples and 3 bands, the dark frame \(4, 3\); take references"):
        calibrate(np.zeros((1, 8, 3), np.uint16), frames(), saturated_dn=4095)
    bad = References(frames().dark, frames().white, np.ones(5, np.float32))
    with pytest.raises(ShapeError, match=r"3 bands, the white reference \(5,\)"):
        reflectance(np.zeros((1, 4, 3), np.uint16), bad)
    with pytest.raises(ShapeError, match=r"\(line, sample, band\)"):
        reflectance(np.zeros((4, 3), np.uint16), frames())


Frame = NDArray[np.float64]


def simulated(samples: int = 640, bands: int = 20, seed: int = 0) -> tuple[Frame, Frame]:
    """Return dark and white frames with noise, vignetting, a spectrum, 1 % of uneven response and a column of dust."""
    rng = np.random.default_rng(seed)
    dark = np.rint(64 + rng.normal(0, 0.7, (samples, bands)))
    along = np.cos(np.linspace(-0.6, 0.6, samples))[:, None] ** 4
    light = 3000 * along * np.exp(-(np.linspace(-1.5, 1.5, bands) ** 2))
    light *= rng.normal(1, 0.01, light.shape)
    light[samples // 3] *= 0.6
    return dark, dark + light + rng.normal(0, 1, light.shape)


def test_only_faulty_elements_are_found() -> None:
    """Hot, dead, deviating and missing elements are bad, also side by side; dust, vignetting and noise are not."""
    dark, white = simulated()
    dark[100, 3] += 50
    white[200, 5] = dark[200, 5]
    white[639, 6] = dark[639, 6]
    white[300:302, 8] += 1500
    white[400, 9] = 0.6 * (white[400, 9] - dark[400, 9]) + dark[400, 9]
    dark[500, 1] = np.nan
    found = np.argwhere(find_bad_elements(dark, white)).tolist()
    assert found == [[100, 3], [200, 5], [300, 8], [301, 8], [400, 9], [500, 1], [639, 6]]


def test_bands_without_light_have_no_dead_elements() -> None:
    """Elements of a band without any response are not called dead, even if white is below dark."""
    dark, white = simulated()
    white[:, :4] = dark[:, :4] - 8
    assert not find_bad_elements(dark, white)[:, :4].any()


@pytest.mark.parametrize(
    ("most", "camera"), [(4095.0, 4095), (1023.0, None), (255.0, 4095), (65535.0, None), (3000.0, 3000)]
)
def test_a_white_frame_at_full_scale_is_noted(most: float, camera: float | None) -> None:
    """The full scale is that of the camera, or of any number of bits; the note has the fraction of elements."""
    white = np.full((10, 10), most)
    white[:, :5] -= 0.6
    (note,) = check_frames("scan: ", np.full(white.shape, 60.0), white, camera)
    assert "scan: the white frame is at full scale" in note
    assert "in 50 % of the elements" in note
    assert check_frames("scan: ", np.full(white.shape, 60.0), white - 2, camera) == []


@pytest.mark.parametrize("hot", [0, 1])
def test_frames_without_light_between_them_are_refused(hot: int) -> None:
    """Exchanged frames, equal ones and two dark ones have none; an unlit part of a white frame may lie below dark."""
    dark, white = simulated()
    white[:hot, 0] = 60000
    for one in (dark, dark[::-1]):
        with pytest.raises(SceneError, match="scan: the white frame is not brighter than the dark one"):
            check_frames("scan: ", one, dark)
    with pytest.raises(SceneError, match=r"not brighter than the dark one \(\d % of its elements are\); exchange them"):
        check_frames("scan: ", white, dark)
    white[:, :7] = dark[:, :7] - 10
    assert check_frames("scan: ", dark, white) == []


def test_too_many_bad_elements_are_refused() -> None:
    """Frames with more than 5 % of bad elements are refused."""
    dark, white = simulated()
    white[4::9] = dark[4::9]
    with pytest.raises(RigError, match=r"1[01]\.\d % of the elements look bad, at most 5 % can be"):
        find_bad_elements(dark, white)
