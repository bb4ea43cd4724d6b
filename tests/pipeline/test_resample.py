"""Resampling: laws of the kernels, masks, and the hard cases of rectification."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.errors import ShapeError
from pipeline.rectify.resample import BLOCK_PX, Kernel, gather, kernel_taps, resample

KERNELS: tuple[Kernel, ...] = ("catmull-rom", "bilinear", "nearest")


def everywhere(lines: int, samples: int, shift: float = 0.0) -> np.ndarray:
    """All pixel centres of a sweep, shifted, as (n, 2) coordinates."""
    grid = np.meshgrid(np.arange(lines) + shift, np.arange(samples) + shift, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("kernel", KERNELS)
def test_weights_sum_to_one(kernel: Kernel) -> None:
    """Every kernel is a partition of unity, at negative positions too."""
    _, weight = kernel_taps(np.linspace(-5, 5, 1001), kernel)
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=2e-7)


@given(arrays(np.bool_, (9, 8)), st.floats(-1, 9), st.floats(-1, 8))
@settings(max_examples=60, deadline=None)
def test_constant_stays_constant_under_any_mask(valid: np.ndarray, line: float, sample: float) -> None:
    """Renormalised taps keep a constant, whichever samples are missing, or fail with weight 0."""
    values = np.full((9, 8, 2), 3.5, np.float32)
    values[~valid] = np.nan
    out, share = resample(values, valid, np.array([[line, sample]]))
    assert np.isnan(out).all() == (share[0] == 0)
    assert share[0] == 0 or (share[0] >= 0.5 and np.allclose(out, 3.5, rtol=1e-5))


def test_pixel_centres_come_back_unchanged() -> None:
    """At pixel centres resampling is the identity."""
    values = np.random.default_rng(1).random((7, 9, 3), np.float32)
    for kernel in KERNELS:
        out, share = resample(values, np.ones((7, 9), bool), everywhere(7, 9), kernel)
        np.testing.assert_array_equal(out.reshape(values.shape), values)
        assert (share == 1).all()


def test_catmull_rom_keeps_parabolas() -> None:
    """Third-order accuracy: a parabola inside the sweep is met exactly."""
    y, x = np.mgrid[:12, :12].astype(np.float32)
    values = (y * y - 2 * x * y + 3 * x)[..., None]
    at = np.random.default_rng(2).uniform(2, 9, (50, 2))
    out, _ = resample(values, np.ones((12, 12), bool), at)
    np.testing.assert_allclose(out[:, 0], at[:, 0] ** 2 - 2 * at[:, 1] * at[:, 0] + 3 * at[:, 1], atol=2e-4)


@pytest.mark.parametrize("bands", [2, 270, 513])
def test_bands_do_not_mix(bands: int) -> None:
    """Each band of a many-band cube is what the band alone would give."""
    values = np.random.default_rng(3).random((6, 7, bands), np.float32)
    valid = np.ones((6, 7), bool)
    at = np.random.default_rng(4).uniform(0, 5, (40, 2))
    out, _ = resample(values, valid, at)
    alone, _ = resample(np.ascontiguousarray(values[..., -1:]), valid, at)
    np.testing.assert_allclose(out[:, -1:], alone, rtol=2e-6)


def test_dead_sample_spoils_only_itself() -> None:
    """One invalid NaN sample fails where it is wanted and leaves the other centres exactly as they were."""
    values = np.random.default_rng(5).random((8, 8, 4), np.float32)
    valid = np.ones((8, 8), bool)
    whole, _ = resample(values, valid, everywhere(8, 8))
    values[3, 4], valid[3, 4] = np.nan, False
    out, share = resample(values, valid, everywhere(8, 8))
    failed = np.isnan(out).any(axis=1)
    assert np.flatnonzero(failed).tolist() == [3 * 8 + 4]
    np.testing.assert_array_equal(out[~failed], whole[~failed])
    assert share[3 * 8 + 4] == 0


def test_nan_of_invalid_samples_does_not_leak() -> None:
    """Between pixels, masked NaN never shows: a point has a value or has weight 0."""
    rng = np.random.default_rng(6)
    values, valid = rng.random((30, 30, 3), np.float32), rng.random((30, 30)) > 0.2
    values[~valid] = np.nan
    out, share = resample(values, valid, everywhere(29, 29, 0.4))
    assert np.isfinite(out[share > 0]).all()
    assert 0.5 < (share > 0).mean() < 1


def test_borders_reach_half_a_pixel() -> None:
    """Points up to half a pixel beyond the outermost centres have values, farther ones and NaN do not."""
    values = np.ones((5, 6, 1), np.float32)
    at = np.array([[-0.49, 2], [4.49, 2], [2, -0.49], [2, 5.49], [4, 5], [-1.6, 2], [2, 6.6], [np.nan, 1]])
    _, share = resample(values, np.ones((5, 6), bool), at)
    assert (share > 0).tolist() == [True] * 5 + [False] * 3


def test_long_sweep_is_read_to_its_end() -> None:
    """Sweeps beyond 32 766 lines are read right up to the last line."""
    values = np.arange(33_000 * 3, dtype=np.float32).reshape(33_000, 3, 1)
    out, _ = resample(values, np.ones((33_000, 3), bool), np.array([[32_767.5, 1], [32_999, 2]]))
    np.testing.assert_allclose(out[:, 0], [32_767.5 * 3 + 1, 98_999])


@pytest.mark.parametrize(("shape", "points"), [((0, 4, 2), 3), ((4, 4, 2), 0), ((1, 1, 2), 3)])
def test_empty_and_tiny_sweeps(shape: tuple[int, int, int], points: int) -> None:
    """No lines, no points and a single sample give results of the right shape."""
    out, share = resample(np.ones(shape, np.float32), np.ones(shape[:2], bool), np.zeros((points, 2)))
    assert out.shape == (points, 2)
    assert (np.isfinite(out).all(axis=1) == (share > 0)).all()
    assert (share > 0).all() == (shape[0] > 0)


def test_read_only_values_are_accepted() -> None:
    """Arrays that may not be written, as read from a store, pass without a warning."""
    values = np.ones((4, 4, 1), np.float32)
    values.flags.writeable = False
    out, _ = resample(values, np.ones((4, 4), bool), np.array([[1.5, 1.5]]))
    assert out[0, 0] == pytest.approx(1)


def test_shapes_that_do_not_fit_are_named() -> None:
    """A mask of another sweep and coordinates of a whole grid are refused with their shapes."""
    values = np.ones((4, 4, 1), np.float32)
    with pytest.raises(ShapeError, match=r"\(4, 4, 1\) and \(4, 5\)"):
        resample(values, np.ones((4, 5), bool), np.zeros((1, 2)))
    with pytest.raises(ShapeError, match="flatten the grid"):
        resample(values, np.ones((4, 4), bool), np.zeros((2, 2, 2)))
    with pytest.raises(ValueError, match="'cubic'"):
        gather(values, np.zeros(1), np.zeros(1), "cubic")  # type: ignore[arg-type]


def test_scene_edges_are_repeated() -> None:
    """Far outside a scene the edge pixel is seen; inside, gather and resample agree."""
    planes = np.random.default_rng(7).random((5, 6, 2), np.float32)
    far = gather(planes, np.array([-50.0, 80.0]), np.array([2.0, 99.0]))
    np.testing.assert_array_equal(far, planes[[0, 4], [2, 5]])
    at = np.random.default_rng(8).uniform(1, 3, (20, 2))
    inside, _ = resample(planes, np.ones((5, 6), bool), at)
    np.testing.assert_allclose(gather(planes, at[:, 0], at[:, 1]), inside, rtol=1e-5)


def test_cost_is_a_small_multiple_of_a_copy() -> None:
    """On a sweep larger than the caches sixteen taps cost at most three copies of the same rows in the same blocks."""
    values = np.ones((160, 640, 270), np.float32)
    valid, table, at = np.ones((160, 640), bool), values.reshape(-1, 270), everywhere(156, 600, 1.3)
    rows = at[:, 0].astype(int) * 640 + at[:, 1].astype(int)

    def copy_rows() -> None:
        out = np.empty((len(at), 270), np.float32)
        for start in range(0, len(at), BLOCK_PX):
            out[start : start + BLOCK_PX] = np.take(table, rows[start : start + BLOCK_PX], axis=0)

    # the best of each on its own: the least of the ratios would pick the copy that was disturbed most
    assert least_seconds(lambda: resample(values, valid, at)) <= 3 * least_seconds(copy_rows)


def least_seconds(work: Callable[[], object], repeats: int = 6) -> float:
    """Least CPU time of this thread over some calls [s]."""
    spent = []
    for _ in range(repeats):
        start = time.thread_time()
        work()
        spent.append(time.thread_time() - start)
    return min(spent)
