"""The signal subspace: the components that are there are found, noise gives none, and hard fields do what is said."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.stats import binom

from pipeline.signal.subspace import (
    SMALL_FIELD,
    SUMS,
    SignalStatistics,
    bands_alone,
    components_of_field,
    find_components,
    with_shared,
)
from tests.pipeline.signal.made_spectra import field_of, marked, restored, scored, statistics_of, with_noise

FALSE_ALARM, TRIALS = 0.1, 60


@settings(max_examples=12)
@given(cuts=st.lists(st.integers(1, 8), min_size=1, max_size=6), expected=st.sampled_from([0, 300_000, 800_000]))
def test_statistics_do_not_depend_on_how_many_lines_come_at_a_time(cuts: list[int], expected: int) -> None:
    """Blocks of any multiples of 4 lines give the same moments and the same chosen spectra as all lines at once."""
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


def test_merged_statistics_are_those_of_all_lines() -> None:
    """Two passes of different brightness have together the mean, moments and largest values of one after the other."""
    values = field_of(3, (64, 40), 9).values
    values[32:] += 0.5
    passes = [statistics_of(values[:32]), statistics_of(values[32:])]
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
def test_statistics_come_back_of_arrays(bands: int) -> None:
    """Every sum, count and spectrum is as it was, and more lines may be added."""
    values = field_of(1, (32, 32), bands).values
    found = statistics_of(values)
    back = SignalStatistics.of_arrays({name: array.copy() for name, array in found.arrays().items()})
    for name in SUMS:
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))
    np.testing.assert_array_equal(back.spectra, found.spectra)
    for one in (found, back):
        one.add(values[:8], np.ones((8, 32), np.bool_))
    np.testing.assert_array_equal(find_components(back).axes, find_components(found).axes)


def test_statistics_of_nothing_come_back_of_arrays() -> None:
    """Before the first line there is no component, then as well as now."""
    assert len(find_components(SignalStatistics.of_arrays(SignalStatistics(5, 100).arrays()))) == 0


@pytest.mark.parametrize("bands", [24, 60])
@pytest.mark.parametrize("materials", [1, 2, 4])
def test_the_known_rank_is_found(bands: int, materials: int) -> None:
    """A field of so many materials has so many components, and they hold it."""
    made = field_of(materials, bands=bands, materials=materials)
    found = find_components(statistics_of(made.values), least=1)
    assert len(found) == materials
    left = made.clean - found.restore(scored(made.clean.astype(np.float32), found).scores)
    assert np.abs(left / made.noise).max() < 0.5


@pytest.mark.parametrize("signal", [300.0, 3000.0, 20_000.0])
def test_a_bright_field_has_no_more_components(signal: float) -> None:
    """However far the signal stands above the noise, rounding of sums makes no component and no rare spectrum."""
    made = field_of(2, signal=signal)
    found = statistics_of(made.values)
    components = find_components(found, least=1)
    assert len(components) == 3
    np.testing.assert_allclose(components.noise, made.noise, rtol=0.03)
    assert not marked(made.values, found, find_components(found)).any()


def test_a_weak_component_that_neighbours_share_is_found() -> None:
    """3 % of one pixel's noise variance, spread over some px, no single spectrum shows: the means of 4 x 4 do."""
    made, rng = field_of(5, (192, 192)), np.random.default_rng(6)
    direction = rng.normal(size=40)
    direction /= np.linalg.norm(direction)
    amount = gaussian_filter(rng.normal(size=(192, 192)), 5)
    weak = np.sqrt(0.03) * (amount / amount.std())[..., None] * direction * made.noise
    found = find_components(statistics_of(made.values + weak.astype(np.float32)), least=1)
    assert len(found) == 4
    assert np.sum((found.axes @ direction) ** 2) > 0.6
    assert len(find_components(statistics_of(made.values), least=1)) == 3


@pytest.mark.parametrize("bands", [12, 32])
def test_noise_alone_gives_no_more_components_than_stated(bands: int) -> None:
    """Of 120 fields of noise at most so many have a component that a rate of 10 % exceeds once in a thousand times."""
    noise, alarms = np.linspace(1, 3, bands), 0
    for seed in range(TRIALS):
        values = with_noise(np.full((48, 48, bands), 100.0), noise, seed)
        alarms += len(find_components(statistics_of(values), least=0, false_alarm=FALSE_ALARM)) > 0
    assert alarms <= binom.ppf(0.999, TRIALS, FALSE_ALARM)


@pytest.mark.parametrize(
    ("seed", "bands", "materials", "within"),
    [(8, 50, 0, 0.03), (8, 50, 1, 0.03), (8, 50, 5, 0.03), (2, 1, 1, 0.05), (2, 2, 1, 0.05), (2, 8, 1, 0.05)],
)
def test_noise_is_estimated_in_every_band(seed: int, bands: int, materials: int, within: float) -> None:
    """To 3 % whatever the materials; to 5 % by what neighbours differ by, where few bands do not predict each other."""
    made = field_of(seed, (128, 128), bands, materials)
    np.testing.assert_allclose(find_components(statistics_of(made.values)).noise, made.noise, rtol=within)


def test_noise_is_estimated_in_bands_of_different_units() -> None:
    """One band counts in millionths of the others' unit."""
    made, scale = field_of(8, (128, 128), 20, 3), np.where(np.arange(20) == 4, 1e7, 1.0)
    noise = find_components(statistics_of((made.values * scale).astype(np.float32))).noise
    np.testing.assert_allclose(noise / scale, made.noise, rtol=0.05)


def test_pixels_without_data_say_nothing_of_the_noise_of_few_bands() -> None:
    """More than half of the field is missing, and the noise of four bands is that of the rest."""
    made, valid = field_of(0, (128, 128), 4, 1), np.broadcast_to(np.arange(128) >= 72, (128, 128))
    np.testing.assert_allclose(find_components(statistics_of(made.values, valid)).noise, made.noise, rtol=0.08)


@pytest.mark.parametrize("bands", [1, 2, 8])
def test_all_of_few_bands_are_kept(bands: int) -> None:
    """Up to 8 bands have as many components: rounding to a step is all that is lost, and no spectrum is rare."""
    made = field_of(4, bands=bands, materials=min(bands, 2))
    found = statistics_of(made.values)
    components = find_components(found)
    assert len(components) == bands
    off = restored(scored(made.values, components), components) - made.values
    assert np.sqrt(np.mean((off / components.noise) ** 2)) == pytest.approx(np.sqrt(1 / 12), rel=0.05)
    assert not marked(made.values, found, components).any()


def test_few_bands_are_kept_in_steps_of_the_camera() -> None:
    """Whole multiples of such a step come back exactly; a missing band is what the others let expect."""
    made = field_of(4, bands=3, materials=2)
    values = np.rint(made.values / 0.01).astype(np.float32) * np.float32(0.01)
    components = bands_alone(statistics_of(values), np.full(3, 0.01))
    np.testing.assert_allclose(restored(scored(values, components), components), values, atol=1e-5)
    holes = values.copy()
    holes[5, 7, 1] = np.nan
    found = restored(scored(holes, components, np.isfinite(holes)), components)
    assert abs(found[5, 7, 1] - values[5, 7, 1]) < 0.5 * values[..., 1].std()


def test_small_fields_keep_a_weak_difference_of_a_small_part() -> None:
    """A hundredth of the spectra lies a third of a deviation apart: no test finds it; of a small field it stays."""
    rng, bands = np.random.default_rng(3), 120
    wavelength = np.linspace(400, 1000, bands)
    smooth = np.exp(-0.5 * ((wavelength - 700) / 40) ** 2)
    values = 10 + rng.normal(size=(64, 100, bands)).astype(np.float32)
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


def test_large_fields_keep_what_is_proved() -> None:
    """Half a million spectra are enough for the test alone."""
    found, wavelength = statistics_of(field_of(2, bands=60).values), np.linspace(400, 900, 60)
    proved, counts = len(find_components(found, least=4)), []
    for found.expected in (SMALL_FIELD - 1, SMALL_FIELD):
        counts.append(len(components_of_field(found, wavelength, false_alarm=0.01, least=4)))
    assert counts[0] > counts[1] == proved


@pytest.mark.parametrize("wavelength", [np.full(60, 550.0), np.linspace(400, 900, 60)[::-1]])
def test_smooth_directions_need_wavelengths_that_differ(wavelength: np.ndarray) -> None:
    """Bands of one wavelength add none; descending ones are as good as ascending."""
    found = statistics_of(field_of(2, bands=60).values)
    components = components_of_field(found, wavelength, false_alarm=0.01, least=4)
    assert (len(components) > len(find_components(found, least=4))) == (np.ptp(wavelength) > 0)


def test_all_dark_has_no_component() -> None:
    """Lines of which nothing may be used have no mean, no noise and no component."""
    found = statistics_of(np.full((8, 8, 12), np.nan, np.float32), np.zeros((8, 8), np.bool_))
    components = find_components(found)
    assert len(components) == 0
    assert np.isnan(components.mean).all()


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_values_that_never_change_have_nothing_to_say(value: float) -> None:
    """Without noise and signal the least number of components is kept, they give the value back, and none is rare."""
    values = np.full((48, 48, 12), value, np.float32)
    found = statistics_of(values)
    components = find_components(found, least=2)
    assert len(components) == 2
    np.testing.assert_array_equal(restored(scored(values, components), components), values)
    assert not marked(values, found, components).any()


def test_one_material_has_the_least_number_of_components() -> None:
    """A spectrum and its noise: no component rises above it, and what is asked for at least is kept."""
    made = field_of(1, (128, 128), materials=0)
    found = statistics_of(made.values)
    assert len(find_components(found, least=0)) == 0
    assert [len(find_components(found, least=least)) for least in (1, 4)] == [1, 4]
    np.testing.assert_allclose(find_components(found).noise, made.noise, rtol=0.03)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (3, 7), (8, 8)])
def test_fewer_spectra_than_bands_come_back(shape: tuple[int, int]) -> None:
    """There are fewer components than spectra, or the least number, and what they do not hold is noise."""
    made = field_of(7, (16, 16), 80)
    values = made.values[: shape[0], : shape[1]]
    found = statistics_of(values)
    components = find_components(found)
    assert len(components) <= max(shape[0] * shape[1] - 1, 4)
    off = (components.restore(scored(values, components).scores) - values) / made.noise
    assert np.sqrt(np.mean(off**2)) < 1
    assert not marked(values, found, components).any()


def test_nan_and_infinite_values_are_left_out() -> None:
    """Spectra that miss bands make no direction of it: the rank stays, and the noise."""
    made = field_of(2, (128, 128))
    values = made.values.copy()
    values[3, 5] = np.nan
    values[:, 40] = np.inf
    values[10:20, 10:20, 7] = np.nan
    components = find_components(statistics_of(values), least=1)
    assert len(components) == 3
    np.testing.assert_allclose(components.noise, made.noise, rtol=0.03)


def test_a_detector_with_a_dead_element_in_every_column_has_components() -> None:
    """Where no spectrum is whole those with most of their bands tell the materials, and the noise to a tenth."""
    made = field_of(2, (128, 128), signal=10)
    values = made.values.copy()
    values[:, np.arange(128), np.arange(128) * 7 % 40] = np.nan
    components = find_components(statistics_of(values), least=1)
    left = made.clean - components.restore(scored(made.clean.astype(np.float32), components).scores)
    assert len(components) >= 3
    assert np.abs(left / made.noise).max() < 1


def test_dead_columns_and_bands_take_no_part() -> None:
    """A band without light is NaN in mean and noise and 0 in axes; the others are as without it."""
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


def test_a_band_that_lights_up_late_counts_from_then() -> None:
    """A band of which the first lines have nothing has the mean of the others' lines."""
    made = field_of(2)
    values = made.values.copy()
    values[:64, :, 5] = np.nan
    components = find_components(statistics_of(values))
    assert components.mean[5] == pytest.approx(values[64:, :, 5].mean(), abs=3 * made.noise[5] + 0.05)
    assert np.isfinite(components.noise).all()


@pytest.mark.parametrize("what", ["drift", "cloud"])
def test_what_the_bands_of_a_line_share_is_one_more_component(what: str) -> None:
    """A dark frame's drift by 3 deviations, or light that falls to a third within some lines; nothing of it is rare."""
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


def test_full_scale_integers_keep_the_rank() -> None:
    """Values from 0 to 65 535 with a noise of some counts, as a raster has them."""
    made = field_of(4, materials=2, signal=1000)
    values = np.rint(made.values * 4000 - (made.values * 4000).min()).astype(np.float32)
    components = find_components(statistics_of(values), least=1)
    assert values.max() > 30_000
    assert len(components) == 2
    np.testing.assert_allclose(components.noise, made.noise * 4000, rtol=0.03)


def test_a_direction_that_rare_spectra_share_becomes_a_component() -> None:
    """Residuals of 200 rare spectra along one direction add that one, after the others, orthonormal to them."""
    made = field_of(3)
    components = find_components(statistics_of(made.values), least=1)
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


def test_residuals_of_noise_share_nothing() -> None:
    """Rare spectra each of its own kind add no component."""
    made = field_of(3)
    components = find_components(statistics_of(made.values), least=1)
    residuals = np.random.default_rng(4).normal(0, 3, (400, 40)).astype(np.float32)
    assert len(with_shared(components, residuals, 0.001)) == 3
    assert len(with_shared(replace(components, axes=np.eye(40)), residuals, 0.001)) == 40  # no direction is left
