"""Resampling: properties of the kernels, masks, and special cases of rectification."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from spectralzoom.pipeline.rectify.kernels import Kernel, kernel_taps
from spectralzoom.pipeline.rectify.resample import BLOCK_PX, merge_lines, resample

KERNELS: tuple[Kernel, ...] = ("catmull-rom", "bilinear", "nearest")


def by_hand(values: np.ndarray, valid: np.ndarray, at: np.ndarray, kernel: Kernel) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted sums in float64, point by point and band by band, and the valid weight of each band."""
    usable = np.broadcast_to(valid if valid.ndim == 3 else valid[..., None], values.shape)
    out = np.full((len(at), values.shape[2]), np.nan)
    weight_of = np.zeros((len(at), values.shape[2]))
    for point, place in enumerate(at):
        lines, samples = (kernel_taps(place[[axis]], kernel) for axis in (0, 1))
        total, weight = np.zeros(values.shape[2]), np.zeros(values.shape[2])
        for line, down in zip(lines[0][0], lines[1][0].astype(float), strict=True):
            for sample, across in zip(samples[0][0], samples[1][0].astype(float), strict=True):
                if 0 <= line < values.shape[0] and 0 <= sample < values.shape[1]:
                    here = usable[line, sample]
                    weight[here] += down * across
                    total[here] += down * across * values[line, sample, here]
        held = weight >= 0.5
        out[point, held] = total[held] / weight[held]
        weight_of[point] = weight
    return out, weight_of


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("by_element", [False, True])
def test_resampling_equals_explicit_sums(kernel: Kernel, by_element: bool) -> None:
    """Masks by sample and by element give the explicit sums, band by band, also at the borders."""
    rng = np.random.default_rng(11)
    values = rng.random((9, 8, 5), np.float32)
    valid = rng.random((9, 8)) > 0.1
    if by_element:
        valid = valid[..., None] & (rng.random((9, 8, 5)) > 0.1)
    values[~valid] = np.nan
    at = rng.uniform(-1.5, 10, (400, 2))
    out, fraction = resample(values, valid, at, kernel)
    wanted, weight = by_hand(values, valid, at, kernel)
    sure = np.abs(weight - 0.5) > 1e-5
    np.testing.assert_allclose(out[sure], wanted[sure], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(fraction > 0, np.isfinite(out).any(axis=1))


@given(arrays(np.bool_, (9, 8)), st.floats(-1, 9), st.floats(-1, 8))
@settings(max_examples=30, deadline=None)
def test_a_constant_stays_constant_under_any_mask(valid: np.ndarray, line: float, sample: float) -> None:
    """Renormalised taps keep the constant for any missing samples, or give NaN with weight 0."""
    values = np.full((9, 8, 2), 3.5, np.float32)
    values[~valid] = np.nan
    out, fraction = resample(values, valid, np.array([[line, sample]]))
    assert np.isnan(out).all() == (fraction[0] == 0)
    assert fraction[0] == 0 or (fraction[0] >= 0.5 and np.allclose(out, 3.5, rtol=1e-5))


def test_catmull_rom_reproduces_parabolas() -> None:
    """The kernel has third-order accuracy, so a parabola inside of the sweep is exact."""
    y, x = np.mgrid[:12, :12].astype(np.float32)
    at = np.random.default_rng(2).uniform(2, 9, (50, 2))
    out, _ = resample((y * y - 2 * x * y + 3 * x)[..., None], np.ones((12, 12), bool), at)
    np.testing.assert_allclose(out[:, 0], at[:, 0] ** 2 - 2 * at[:, 1] * at[:, 0] + 3 * at[:, 1], atol=2e-4)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("bands", [1, 80])
def test_resampling_does_not_depend_on_the_blocks(kernel: Kernel, bands: int) -> None:
    """All points together, single points and any order give the same bits, with masks and at borders."""
    rng = np.random.default_rng(13)
    values = rng.random((14, 15, bands), np.float32)
    valid = rng.random((14, 15, bands)) > 0.01
    at = rng.uniform(-1, 15, (BLOCK_PX + 300, 2))
    out, fraction = resample(values, valid, at, kernel)
    order = rng.permutation(len(at))
    shuffled, shuffled_fraction = resample(values, valid, at[order], kernel)
    np.testing.assert_array_equal(shuffled, out[order])
    np.testing.assert_array_equal(shuffled_fraction, fraction[order])
    for point in (*range(60), BLOCK_PX - 1, BLOCK_PX, len(at) - 1):
        np.testing.assert_array_equal(resample(values, valid, at[point : point + 1], kernel)[0], out[[point]])


def test_lines_of_one_dwell_are_averaged() -> None:
    """The mean of each sample is over its valid lines. A line alone keeps its bits."""
    values = np.random.default_rng(18).random((6, 3, 2), np.float32)
    valid = np.ones((6, 3), bool)
    values[2, 1], valid[2, 1] = np.nan, False
    valid[4:, 0] = False
    merged, known = merge_lines(values, valid, np.array([0, 1, 4]))
    np.testing.assert_array_equal(merged[0], values[0])
    np.testing.assert_allclose(merged[1, 0], values[1:4, 0].mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(merged[1, 1], values[[1, 3], 1].mean(axis=0), rtol=1e-6)
    assert np.isnan(merged[2, 0]).all()
    assert known.tolist() == [[True] * 3, [True] * 3, [False, True, True]]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_values_of_invalid_elements_do_not_matter(kernel: Kernel, kind: type[np.generic]) -> None:
    """Zero and any other number at invalid elements give the same result, and the input stays unchanged."""
    rng = np.random.default_rng(19)
    values = rng.integers(1, 60_000, (9, 9, 3)).astype(kind)
    valid = rng.random((9, 9, 3)) > 0.1
    kept = values.copy()
    at = rng.uniform(-0.4, 8.4, (100, 2))
    results = (resample(given, valid, at, kernel) for given in (values, values * valid))
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(values, kept)
