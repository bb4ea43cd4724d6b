"""The signal subspace: existing components are found, noise gives none, and special fields are handled as stated."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.stats import binom

from spectralzoom.pipeline.signal.subspace import (
    SMALL_FIELD,
    SUMS,
    SignalStatistics,
    bands_alone,
    components_of_field,
    find_components,
    with_shared,
)
from tests.pipeline.signal.made_spectra import field_of, marked, restored, scored, statistics_of, with_noise

FALSE_ALARM = 0.1
TRIALS = 60


@settings(max_examples=12)
@given(cuts=st.lists(st.integers(1, 8), min_size=1, max_size=6), expected=st.sampled_from([0, 300_000, 800_000]))
def test_statistics_do_not_depend_on_blocks_of_lines(cuts: list[int], expected: int) -> None:
    """Blocks of any multiples of 4 lines give the same moments and chosen spectra as all lines at once."""
    values = field_of(3, (64, 40), 9).values
    whole = statistics_of(values, expected=expected)
    parts = SignalStatistics(9, expected or 64 * 40)
    ends = np.minimum(np.cumsum([0, *(4 * one for one in cuts), 64]), 64)
    for first, last in pairwise(ends.tolist()):
        parts.add(values[first:last], np.ones((last - first, 40), np.bool_))
    assert (parts.count, parts.means) == (whole.count, whole.means)
    np.testing.assert_allclose(parts.spectra, whole.spectra, atol=1e-6)
    np.testing.assert_allclose(parts.largest, np.abs(values - parts.origin).max(axis=(0, 1)), rtol=1e-5)
    one, other = (find_components(found) for found in (whole, parts))
    np.testing.assert_allclose(other.mean, one.mean, rtol=1e-6)
    np.testing.assert_allclose(other.noise, one.noise, rtol=1e-4)
    np.testing.assert_allclose(other.axes.T @ other.axes, one.axes.T @ one.axes, atol=1e-4)


def test_merged_statistics_equal_those_of_all_lines() -> None:
    """Two passes of different brightness, merged, have the moments and chosen spectra of all lines together.

    The second pass grows brighter, so that its sums from its first lines are not 0.
    """
    values = field_of(3, (64, 40), 9).values
    values[32:] += 0.5
    values[40:] += 0.5
    passes = [statistics_of(values[:32]), SignalStatistics(9, 32 * 40)]
    for first in (32, 40):
        some = values[first : first + (8 if first == 32 else 24)]
        passes[1].add(some, np.ones(some.shape[:2], np.bool_))
    merged, whole = passes[0].merged(passes[1]), statistics_of(values)
    assert (merged.count, merged.means) == (whole.count, whole.means)
    assert merged.origin is not None
    assert whole.origin is not None
    for total, products, count in (("total", "single", merged.count), ("block_total", "block", merged.means)):
        one, other = (getattr(found, total) / count + found.origin for found in (merged, whole))
        np.testing.assert_allclose(one, other, rtol=1e-5)
        one, other = (
            getattr(found, products) / count - np.outer(getattr(found, total), getattr(found, total)) / count**2
            for found in (merged, whole)
        )
        np.testing.assert_allclose(one, other, atol=1e-4 * np.abs(other).max())
    np.testing.assert_allclose(np.sort(merged.spectra, axis=0), np.sort(whole.spectra, axis=0), atol=1e-5)


@pytest.mark.parametrize("bands", [2, 12])
def test_statistics_are_restored_from_arrays(bands: int) -> None:
    """Every sum, count and spectrum is equal, and more lines may be added."""
    values = field_of(1, (32, 32), bands).values
    found = statistics_of(values)
    back = SignalStatistics.of_arrays({name: array.copy() for name, array in found.arrays().items()})
    for name in SUMS:
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))
    np.testing.assert_array_equal(back.spectra, found.spectra)
    for one in (found, back):
        one.add(values[:8], np.ones((8, 32), np.bool_))
    np.testing.assert_array_equal(find_components(back).axes, find_components(found).axes)


def test_empty_statistics_are_restored_from_arrays() -> None:
    """Before the first line there is no component."""
    assert len(find_components(SignalStatistics.of_arrays(SignalStatistics(5, 100).arrays()))) == 0


@pytest.mark.parametrize("bands", [24, 60])
@pytest.mark.parametrize("materials", [1, 2, 4])
def test_the_number_of_materials_is_the_number_of_components(bands: int, materials: int) -> None:
    """The components represent the field without noise to half a sigma."""
    made = field_of(materials, bands=bands, materials=materials)
    found = find_components(statistics_of(made.values), least=1)
    assert len(found) == materials
    left = made.clean - found.restore(scored(made.clean.astype(np.float32), found).scores)
    assert np.abs(left / made.noise).max() < 0.5


@pytest.mark.parametrize("signal", [300.0, 3000.0, 20_000.0])
def test_a_bright_field_has_no_additional_components(signal: float) -> None:
    """At any ratio of signal to noise, rounding of sums creates no component and no rare spectrum."""
    made = field_of(2, signal=signal)
    found = statistics_of(made.values)
    components = find_components(found, least=1)
    assert len(components) == 3
    np.testing.assert_allclose(components.noise, made.noise, rtol=0.03)
    assert not marked(made.values, found, find_components(found)).any()


def test_a_weak_component_shared_by_neighbours_is_found() -> None:
    """A component with 3 % of a pixel's noise variance, varying over some px, shows only in means of 4 x 4 spectra."""
    made = field_of(5, (192, 192))
    rng = np.random.default_rng(6)
    direction = rng.normal(size=40)
    direction /= np.linalg.norm(direction)
    amount = gaussian_filter(rng.normal(size=(192, 192)), 5)
    weak = np.sqrt(0.03) * (amount / amount.std())[..., None] * direction * made.noise
    found = find_components(statistics_of(made.values + weak.astype(np.float32)), least=1)
    assert len(found) == 4
    assert np.sum((found.axes @ direction) ** 2) > 0.6
    assert len(find_components(statistics_of(made.values), least=1)) == 3


@pytest.mark.parametrize("bands", [12, 32])
def test_noise_alone_gives_components_at_most_at_the_stated_rate(bands: int) -> None:
    """The count in 60 fields of noise is at most the 99.9 % quantile for a false-alarm rate of 10 %."""
    alarms = 0
    for seed in range(TRIALS):
        values = with_noise(np.full((48, 48, bands), 100.0), np.linspace(1, 3, bands), seed)
        alarms += len(find_components(statistics_of(values), least=0, false_alarm=FALSE_ALARM)) > 0
    assert alarms <= binom.ppf(0.999, TRIALS, FALSE_ALARM)


@pytest.mark.parametrize(
    ("seed", "bands", "materials", "missing", "within"),
    [
        *((8, 50, 0, 0, 0.03), (8, 50, 1, 0, 0.03), (8, 50, 5, 0, 0.03)),
        *((2, 1, 1, 0, 0.05), (2, 2, 1, 0, 0.05), (2, 8, 1, 0, 0.05), (0, 4, 1, 72, 0.08)),
    ],
)
def test_noise_is_estimated_in_every_band(seed: int, bands: int, materials: int, missing: int, within: float) -> None:
    """The error is below 3 % with any materials, 5 % with few bands, and 8 % with over half of the field missing."""
    made = field_of(seed, (128, 128), bands, materials)
    valid = np.broadcast_to(np.arange(128) >= missing, (128, 128))
    np.testing.assert_allclose(find_components(statistics_of(made.values, valid)).noise, made.noise, rtol=within)


def test_noise_is_estimated_in_bands_of_different_units() -> None:
    """One band's unit is a ten-millionth of the others'."""
    made = field_of(8, (128, 128), 20, 3)
    scale = np.where(np.arange(20) == 4, 1e7, 1.0)
    noise = find_components(statistics_of((made.values * scale).astype(np.float32))).noise
    np.testing.assert_allclose(noise / scale, made.noise, rtol=0.05)


@pytest.mark.parametrize("bands", [1, 2, 8])
def test_up_to_8_bands_keep_all_components(bands: int) -> None:
    """Only the rounding to a step is lost, and no spectrum is rare."""
    made = field_of(4, bands=bands, materials=min(bands, 2))
    found = statistics_of(made.values)
    components = find_components(found)
    assert len(components) == bands
    off = restored(scored(made.values, components), components) - made.values
    assert np.sqrt(np.mean((off / components.noise) ** 2)) == pytest.approx(np.sqrt(1 / 12), rel=0.05)
    assert not marked(made.values, found, components).any()


def test_few_bands_are_stored_in_steps_of_the_camera() -> None:
    """Whole multiples of such a step are exact. A missing band is predicted from the others."""
    values = np.rint(field_of(4, bands=3, materials=2).values / 0.01).astype(np.float32) * np.float32(0.01)
    components = bands_alone(statistics_of(values), np.full(3, 0.01))
    np.testing.assert_allclose(restored(scored(values, components), components), values, atol=1e-5)
    holes = values.copy()
    holes[5, 7, 1] = np.nan
    found = restored(scored(holes, components, np.isfinite(holes)), components)
    assert abs(found[5, 7, 1] - values[5, 7, 1]) < 0.5 * values[..., 1].std()


def test_small_fields_keep_a_weak_difference_of_a_small_part() -> None:
    """A hundredth of the spectra differs by a third of a sigma. No test detects it, but a small field keeps it."""
    bands = 120
    wavelength = np.linspace(400, 1000, bands)
    smooth = np.exp(-0.5 * ((wavelength - 700) / 40) ** 2)
    values = 10 + np.random.default_rng(3).normal(size=(64, 100, bands)).astype(np.float32)
    values[:8, :8] += (0.35 * smooth / np.linalg.norm(smooth)).astype(np.float32)
    found = statistics_of(values)
    few = find_components(found, least=4)
    all_smooth = components_of_field(found, wavelength, false_alarm=0.01, least=4)
    part = np.zeros(values.shape[:2], np.bool_)
    part[:8, :8] = True
    seen = values[part].mean(axis=0) - values[~part].mean(axis=0)
    kept = [restored(scored(values, one), one) for one in (few, all_smooth)]
    along = [(one[part].mean(axis=0) - one[~part].mean(axis=0)) @ smooth / (seen @ smooth) for one in kept]
    assert along[0] < 0.5
    assert along[1] == pytest.approx(1, abs=0.1)
    assert len(few) == 4 < len(all_smooth) <= 28
    np.testing.assert_allclose(all_smooth.axes @ all_smooth.axes.T, np.eye(len(all_smooth)), atol=1e-9)


def test_large_fields_keep_only_significant_components() -> None:
    """From half a million spectra on, the statistical test alone selects the components."""
    found = statistics_of(field_of(2, bands=60).values)
    wavelength = np.linspace(400, 900, 60)
    proved = len(find_components(found, least=4))
    counts = []
    for found.expected in (SMALL_FIELD - 1, SMALL_FIELD):
        counts.append(len(components_of_field(found, wavelength, false_alarm=0.01, least=4)))
    assert counts[0] > counts[1] == proved


@pytest.mark.parametrize("wavelength", [np.full(60, 550.0), np.linspace(400, 900, 60)[::-1]])
def test_smooth_directions_need_different_wavelengths(wavelength: np.ndarray) -> None:
    """Bands of one wavelength add no direction; descending wavelengths work like ascending ones."""
    found = statistics_of(field_of(2, bands=60).values)
    components = components_of_field(found, wavelength, false_alarm=0.01, least=4)
    assert (len(components) > len(find_components(found, least=4))) == (np.ptp(wavelength) > 0)


def test_lines_without_valid_spectra_have_no_component() -> None:
    """The mean is NaN in every band."""
    components = find_components(statistics_of(np.full((8, 8, 12), np.nan, np.float32), np.zeros((8, 8), np.bool_)))
    assert len(components) == 0
    assert np.isnan(components.mean).all()


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_constant_values_have_the_least_number_of_components(value: float) -> None:
    """Without noise and signal these components restore the value exactly, and no spectrum is rare."""
    values = np.full((48, 48, 12), value, np.float32)
    found = statistics_of(values)
    components = find_components(found, least=2)
    assert len(components) == 2
    np.testing.assert_array_equal(restored(scored(values, components), components), values)
    assert not marked(values, found, components).any()


def test_one_material_has_the_least_number_of_components() -> None:
    """No component rises above the noise of a single spectrum, so the requested minimum is kept."""
    made = field_of(1, (128, 128), materials=0)
    found = statistics_of(made.values)
    assert len(find_components(found, least=0)) == 0
    assert [len(find_components(found, least=least)) for least in (1, 4)] == [1, 4]
    np.testing.assert_allclose(find_components(found).noise, made.noise, rtol=0.03)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (3, 7), (8, 8)])
def test_fewer_spectra_than_bands_are_restored(shape: tuple[int, int]) -> None:
    """There are fewer components than spectra, or the minimum, and the residual is below the noise."""
    made = field_of(7, (16, 16), 80)
    values = made.values[: shape[0], : shape[1]]
    found = statistics_of(values)
    components = find_components(found)
    assert len(components) <= max(shape[0] * shape[1] - 1, 4)
    off = (components.restore(scored(values, components).scores) - values) / made.noise
    assert np.sqrt(np.mean(off**2)) < 1
    assert not marked(values, found, components).any()


def test_nan_and_infinite_values_are_left_out() -> None:
    """Spectra with missing bands change neither the number of components nor the noise."""
    made = field_of(2, (128, 128))
    values = made.values.copy()
    values[3, 5] = np.nan
    values[:, 40] = np.inf
    values[10:20, 10:20, 7] = np.nan
    components = find_components(statistics_of(values), least=1)
    assert len(components) == 3
    np.testing.assert_allclose(components.noise, made.noise, rtol=0.03)


def test_a_dead_element_in_every_column_leaves_the_components() -> None:
    """If no spectrum is whole, those with most of their bands determine the components to one sigma."""
    made = field_of(2, (128, 128), signal=10)
    values = made.values.copy()
    values[:, np.arange(128), np.arange(128) * 7 % 40] = np.nan
    components = find_components(statistics_of(values), least=1)
    left = made.clean - components.restore(scored(made.clean.astype(np.float32), components).scores)
    assert len(components) >= 3
    assert np.abs(left / made.noise).max() < 1


def test_dead_columns_and_bands_are_left_out() -> None:
    """A band without light is NaN in mean and noise and 0 in axes. The other bands are as without it."""
    made = field_of(2)
    values = np.insert(made.values, 11, np.nan, axis=2)
    valid = np.ones(made.values.shape[:2], np.bool_)
    valid[:, 20:23] = False
    components = find_components(statistics_of(values, valid), least=1)
    alone = find_components(statistics_of(made.values, valid), least=1)
    assert np.flatnonzero(np.isnan(components.noise)).tolist() == [11]
    assert (components.axes[:, 11] == 0).all()
    np.testing.assert_allclose(np.delete(components.noise, 11), alone.noise)
    np.testing.assert_allclose(np.abs(np.delete(components.axes, 11, axis=1)), np.abs(alone.axes), atol=1e-9)


def test_a_band_that_starts_late_counts_from_its_first_line() -> None:
    """A band without values in the first lines has the mean of the other lines."""
    made = field_of(2)
    values = made.values.copy()
    values[:64, :, 5] = np.nan
    components = find_components(statistics_of(values))
    assert components.mean[5] == pytest.approx(values[64:, :, 5].mean(), abs=3 * made.noise[5] + 0.05)
    assert np.isfinite(components.noise).all()


@pytest.mark.parametrize("what", ["drift", "cloud"])
def test_an_effect_shared_by_the_bands_of_a_line_is_one_component(what: str) -> None:
    """The effect is a dark frame's drift of 3 sigma, or light that falls to a third; neither makes a spectrum rare."""
    made = field_of(9)
    drift = 3 * np.linspace(0, 1, 96)[:, None, None] * np.random.default_rng(1).normal(size=40) * made.noise
    light = gaussian_filter(np.where(np.arange(96) < 50, 1.0, 0.35), 1.0)[:, None, None]
    clean, there = (made.clean + drift, np.s_[-16:]) if what == "drift" else (made.clean * light, np.s_[46:54])
    values = with_noise(clean, made.noise, 9)
    found = statistics_of(values)
    components = find_components(found, least=1)
    assert len(components) == 4
    assert not marked(values, found, components).any()
    left = (values - components.restore(scored(values, components).scores)) / made.noise
    assert np.abs(left[there].mean(axis=(0, 1))).max() < 0.15


def test_a_direction_shared_by_rare_spectra_becomes_a_component() -> None:
    """Residuals of 200 rare spectra along one direction add it as the last axis, orthonormal to the others."""
    components = find_components(statistics_of(field_of(3).values), least=1)
    rng = np.random.default_rng(2)
    shared = rng.normal(size=40)
    shared -= components.axes.T @ (components.axes @ shared)
    shared /= np.linalg.norm(shared)
    residuals = (rng.normal(0, 12, (200, 1)) * shared + rng.normal(size=(200, 40))).astype(np.float32)
    more = with_shared(components, residuals, 0.01)
    assert len(more) == 4
    np.testing.assert_array_equal(more.axes[:3], components.axes)
    np.testing.assert_allclose(more.axes @ more.axes.T, np.eye(4), atol=1e-9)
    assert abs(more.axes[3] @ shared) > 0.99


def test_residuals_of_noise_add_no_component() -> None:
    """The residuals of these rare spectra have no common direction."""
    components = find_components(statistics_of(field_of(3).values), least=1)
    residuals = np.random.default_rng(4).normal(0, 3, (400, 40)).astype(np.float32)
    assert len(with_shared(components, residuals, 0.001)) == 3
    assert len(with_shared(replace(components, axes=np.eye(40)), residuals, 0.001)) == 40  # no direction is left
