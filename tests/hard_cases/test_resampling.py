"""Hard cases of resampling: band counts, long sweeps, NaN, step edges, few pixels, float32 positions, threads."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.resample import resample

KERNELS: tuple[Kernel, ...] = ("catmull-rom", "bilinear", "nearest")


def ramp(lines: int, samples: int, bands: int = 1) -> np.ndarray:
    """Return values (line, sample, band) that grow by 1 a sample, by 10 a line and by 1000 a band."""
    line, sample, band = np.ogrid[:lines, :samples, :bands]
    values: np.ndarray = (10.0 * line + sample + 1000.0 * band).astype(np.float32)
    return values


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("bands", [1, 2, 128, 129, 270, 512, 513, 939])
def test_bands_of_a_cube_match_the_same_band_alone(kernel: Kernel, bands: int) -> None:
    """With 1 to 939 bands, the first, middle and last band of a uint16 cube match that band alone as float32."""
    values = np.random.default_rng(bands).integers(0, 60_000, (7, 6, bands), dtype=np.uint16)
    at = np.random.default_rng(1).uniform(0, 5, (30, 2))
    out, fraction = resample(values, np.ones((7, 6), bool), at, kernel)
    for band in {0, bands // 2, bands - 1}:
        alone, _ = resample(values[..., band : band + 1].astype(np.float32), np.ones((7, 6), bool), at, kernel)
        np.testing.assert_allclose(out[:, band], alone[:, 0], rtol=1e-5, atol=0.02)
    assert (fraction > 0).all()


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("lines", [32_766, 32_767, 32_768, 40_000])
def test_line_numbers_beyond_16_bits_are_resampled_exactly(kernel: Kernel, lines: int) -> None:
    """Sweeps of 32 766 to 40 000 lines return exact values at their first, middle and last lines."""
    at = np.array([[lines - 1, 3], [lines - 1, 0], [lines - 3, 2], [lines // 2, 1], [32_766 - 3, 2]])
    out, _ = resample(ramp(lines, 4), np.ones((lines, 4), bool), at, kernel)
    np.testing.assert_array_equal(out[:, 0], 10 * at[:, 0] + at[:, 1])


def test_fraction_is_never_above_one() -> None:
    """If only taps of negative weight are invalid, the valid taps sum to more than 1; the fraction is limited to 1."""
    valid = np.ones((9, 9), bool)
    valid[:, [2, 5]] = False
    out, fraction = resample(np.full((9, 9, 1), 40, np.float32), valid, np.array([[4, 3.5]]))
    np.testing.assert_allclose(out, 40, rtol=1e-6)
    assert fraction.tolist() == [1]


@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_nearest_rounds_halves_up(kind: type[np.generic]) -> None:
    """Positions halfway between pixels take the next pixel, so no pixel is taken twice or left out."""
    at = np.array([[0.5, 0], [1.5, 0], [2.5, 0], [3, 0.5], [3, 1.5]])
    out, _ = resample(ramp(6, 4).astype(kind), np.ones((6, 4), bool), at, "nearest")
    assert out[:, 0].tolist() == [10, 20, 30, 31, 32]


def test_nan_band_of_valid_samples_affects_no_other_band() -> None:
    """A band without light is NaN in valid samples: it stays NaN, the other bands are finite, the fraction is 1."""
    values = ramp(6, 6, 3)
    values[..., 1] = np.nan
    out, fraction = resample(values, np.ones((6, 6), bool), np.array([[2.5, 2.5], [5, 5]]))
    assert np.isnan(out[:, 1]).all()
    assert np.isfinite(out[:, [0, 2]]).all()
    assert (fraction == 1).all()


def test_overshoot_at_a_step_is_kept() -> None:
    """At a step from 0 to 65 535 Catmull-Rom overshoots the uint16 range on both sides; no value wraps around."""
    values = np.zeros((8, 8, 1), np.uint16)
    values[:, 4:] = 65_535
    at = np.stack([np.full(57, 3.5), np.linspace(0, 7, 57)], axis=1)
    out, _ = resample(values, np.ones((8, 8), bool), at)
    assert out.min() < -1000
    assert out.max() > 66_535
    assert (np.diff(out[(at[:, 1] >= 3) & (at[:, 1] <= 4), 0]) >= 0).all()


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("kind", [np.float32, np.uint16])
def test_positions_without_a_line_give_nan(kernel: Kernel, kind: type[np.generic]) -> None:
    """A block of the grid that no line reaches is NaN with a fraction of 0, and raises no warning."""
    at = np.array([[np.nan, np.nan], [np.nan, 2], [np.inf, 1], [-np.inf, -np.inf], [1e300, 0]])
    out, fraction = resample(ramp(5, 5, 3).astype(kind), np.ones((5, 5), bool), at, kernel)
    assert out.shape == (5, 3)
    assert np.isnan(out).all()
    assert not fraction.any()


def test_float64_positions_keep_offsets_that_float32_loses() -> None:
    """At line 32 768 float32 positions are rounded to 1/256 px; float64 positions keep offsets of 1e-5 and 1e-3 px."""
    values = np.tile(np.array([[[0.0]], [[1.0]]], np.float32), (16_386, 5, 1))
    at = np.array([[32_768 + 1e-5, 2], [32_768 + 1e-3, 2], [32_768.3, 2]])
    out, _ = resample(values, np.ones(values.shape[:2], bool), at, "bilinear")
    np.testing.assert_allclose(out[:, 0], at[:, 0] - 32_768, rtol=1e-5)
    coarse, _ = resample(values, np.ones(values.shape[:2], bool), at.astype(np.float32), "bilinear")
    np.testing.assert_allclose(coarse[:, 0], [0, 0, 0.30078125], atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("shape", [(1, 6), (6, 1), (1, 1), (2, 2), (3, 3)])
def test_images_smaller_than_the_kernel_return_their_pixels(kernel: Kernel, shape: tuple[int, int]) -> None:
    """Images of one line, one sample or up to 3 x 3 px return their values at centres; outside the fraction is 0."""
    values = ramp(*shape, 2)
    valid = np.ones(shape, bool)
    centres = np.argwhere(valid).astype(float)
    out, fraction = resample(values, valid, centres, kernel)
    np.testing.assert_array_equal(out.reshape(values.shape), values)
    assert (fraction == 1).all()
    for away in ([1, 0], [0, 1], [-1, -1]):
        assert not resample(values, valid, centres + np.multiply(away, shape), kernel)[1].any()


def test_concurrent_threads_give_the_results_of_one_thread() -> None:
    """Four threads also read read-only memory and leave torch's thread count unchanged."""
    rng = np.random.default_rng(3)
    values = rng.random((40, 40, 70), np.float32)
    valid = rng.random((40, 40, 70)) > 0.001
    values.flags.writeable = False
    places = [rng.uniform(-1, 40, (3000, 2)) for _ in range(8)]
    alone = [resample(values, valid, at) for at in places]
    before = torch.get_num_threads()
    together = threading.Barrier(4)

    def work(first: int) -> list[tuple[np.ndarray, np.ndarray]]:
        together.wait()
        return [resample(values, valid, at) for at in places[first::4] * 3]

    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(work, range(4)))
    assert torch.get_num_threads() == before
    for first, parts in enumerate(results):
        for part, wanted in zip(parts, alone[first::4] * 3, strict=True):
            np.testing.assert_array_equal(part[0], wanted[0])
            np.testing.assert_array_equal(part[1], wanted[1])


def test_new_threads_inherit_the_torch_thread_count() -> None:
    """A worker thread has the process's number of torch threads before and after it resamples."""

    def work() -> tuple[int, int]:
        before = torch.get_num_threads()
        resample(ramp(9, 9), np.ones((9, 9), bool), np.full((10, 2), 4.5))
        return before, torch.get_num_threads()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == (torch.get_num_threads(),) * 2
