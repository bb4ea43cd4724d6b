"""The spectral stem: projection of any bands in any order onto columns, and their normalisation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.models.network.spectral import LineSpec, Normalisation, SpectralBasis, band_widths

BASIS = SpectralBasis(400.0, 1000.0, 24)
BANDS = st.lists(st.sampled_from(range(400, 1001, 3)), min_size=1, max_size=40)  # repeats are likely


@given(BANDS, st.randoms(use_true_random=False))
def test_bands_in_any_order_give_the_same_columns(nanometres: list[int], random):
    """Permuting bands together with their wavelengths, also repeated ones, changes no column."""
    order = list(range(len(nanometres)))
    random.shuffle(order)
    wavelength = np.array(nanometres, float)
    values = np.cos(np.arange(len(nanometres)))
    matrix, reached = BASIS.matrix(wavelength)
    shuffled, same = BASIS.matrix(wavelength[order])
    assert (reached == same).all()
    assert values[order] @ shuffled == pytest.approx(values @ matrix, abs=1e-5)


@given(BANDS)
def test_reached_columns_keep_a_flat_spectrum(nanometres: list[int]):
    """The weights of a reached column sum to 1; a column that no band reaches is all zero."""
    matrix, reached = BASIS.matrix(np.array(nanometres, float))
    assert matrix.min() >= 0
    assert matrix.sum(axis=0) == pytest.approx(reached.astype(float), abs=1e-5)


def test_fifteen_and_270_bands_give_columns_of_one_scale():
    """A band is weighted by its spectral interval, so a smooth spectrum gives nearly the same columns."""

    def columns(bands: int) -> np.ndarray:
        wavelength = np.linspace(400, 1000, bands)
        return (0.3 + 0.2 * np.sin(wavelength / 120)) @ SpectralBasis(400, 1000, 12).matrix(wavelength)[0]

    assert columns(15) == pytest.approx(columns(270), abs=0.02)


def test_crowded_bands_share_the_weight_of_their_interval():
    """Bands at 500, 510 and 700 nm stand for 5, 100 and 95 nm of a column that is far wider than all of them."""
    matrix, _ = SpectralBasis(600.0, 600.0, 1).matrix(np.array([700.0, 500.0, 510.0]))
    assert matrix[:, 0] == pytest.approx(np.array([95, 5, 100]) / 200, abs=0.002)


@pytest.mark.parametrize("wavelength", [[550.0], [550.0, 550.0, 550.0]])
def test_a_single_wavelength_has_weight_one(wavelength: list[float]):
    """One band, or one given several times, determines its column alone."""
    assert band_widths(np.array(wavelength)).sum() == pytest.approx(1)
    matrix, reached = SpectralBasis.spanning(np.array(wavelength)).matrix(np.array(wavelength))
    assert reached.tolist() == [True]
    assert matrix.sum() == pytest.approx(1)


def _sample() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.normal(0.4, 0.1, (2000, 1)) + rng.normal(0, 0.01, (2000, 5)) * np.arange(1, 6)


def test_normalised_columns_are_uncorrelated():
    """Columns that nearly repeat each other get unit variance and no correlation."""
    normal = Normalisation.measured(_sample()).apply(_sample(), np.ones(5, bool))
    assert np.cov(normal.T) == pytest.approx(np.eye(5), abs=0.02)


def test_more_light_is_a_gain_and_a_shift():
    """A fraction e more light multiplies normalised columns by 1 + e and adds e times the gain shift."""
    normalisation = Normalisation.measured(_sample())
    reached = np.ones(5, bool)
    expected = normalisation.apply(_sample(), reached) * 1.1 + 0.1 * normalisation.gain_shift
    assert normalisation.apply(_sample() * 1.1, reached) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_missing_values_are_predicted_from_the_others(bad: float):
    """A value that is not finite counts as a column that no band reaches; without any value the median is taken."""
    normalisation = Normalisation.measured(_sample())
    known = np.array([True, True, False, False, True])
    broken = np.stack([np.full(5, 0.4), np.where(known, 0.5, bad), np.full(5, bad)])
    found = normalisation.apply(broken, np.ones(5, bool))
    assert found[0] == pytest.approx(normalisation.apply(broken[0], np.ones(5, bool)), abs=1e-5)
    assert found[1] == pytest.approx(normalisation.apply(broken[1], known), abs=1e-5)
    assert not found[2].any()


def test_unreached_columns_are_predicted_by_regression():
    """The error of a column that nearly repeats its neighbours is that of a least-squares fit, within 2 %."""
    sample = _sample()
    reached = np.array([True, True, False, True, True])
    normalisation = Normalisation.measured(sample)
    normal = (sample - normalisation.centre) / normalisation.spread
    fitted, *_ = np.linalg.lstsq(normal[:, reached], normal[:, 2], rcond=None)
    told = normalisation.apply(sample, reached) @ np.linalg.inv(normalisation.whitening)
    off = np.std(told[:, 2] - normal[:, 2])
    assert off == pytest.approx(np.std(normal[:, reached] @ fitted - normal[:, 2]), rel=0.02)
    assert off < 0.4 * np.std(normal[:, 2])
    assert told[:, reached] == pytest.approx(normal[:, reached], abs=1e-3)


@given(st.floats(0.01, 1), st.floats(1, 16), st.floats(1, 16), st.integers(0, 2))
def test_capture_planes_are_0_at_the_reference(light: float, step: float, binned: float, at: int):
    """Half the exposure adds a quarter, twice the spacing or binning a half, each to its own plane alone."""
    here = LineSpec(light, step, binned)
    factor = [1.0, 1.0, 1.0]
    factor[at] = 0.5 if at == 0 else 2.0
    more = LineSpec(light * factor[0], step * factor[1], binned * factor[2])
    assert more.planes - here.planes == pytest.approx(np.eye(3)[at] * [0.25, 0.5, 0.5], abs=1e-5)
    assert (here.planes >= 0).all()
    assert not LineSpec().planes.any()
    assert not LineSpec(light=4.0).planes.any()  # a capture better than the reference counts as the reference
