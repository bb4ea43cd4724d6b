"""The spectral stem: any bands in any order onto columns, and their normalisation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.network.spectral import Normalisation, SpectralBasis, band_widths, checked_wavelengths, project
from pipeline.errors import WavelengthError

BASIS = SpectralBasis(400.0, 1000.0, 24)
BANDS = st.lists(st.sampled_from(range(400, 1001, 3)), min_size=1, max_size=40)  # repeats are likely


@given(BANDS, st.randoms(use_true_random=False))
def test_bands_in_any_order_give_the_same_columns(nanometres: list[int], random):
    """Permuting bands together with their wavelengths (descending ones, repeats) changes no column."""
    order = list(range(len(nanometres)))
    random.shuffle(order)
    wavelength, values = np.array(nanometres, float), np.cos(np.arange(len(nanometres)))
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


@given(BANDS, st.integers(2, 4))
def test_a_band_given_twice_shares_its_weight(nanometres: list[int], times: int):
    """Repeating every band leaves the columns as they are, whatever the bands hold."""
    wavelength, values = np.array(nanometres, float), np.sin(np.arange(len(nanometres)))
    once = values @ BASIS.matrix(wavelength)[0]
    again = np.tile(values, times) @ BASIS.matrix(np.tile(wavelength, times))[0]
    assert again == pytest.approx(once, abs=1e-5)


def test_fifteen_and_270_bands_give_columns_of_one_scale():
    """A smooth spectrum reads alike through few and many bands, because a band counts by the stretch it stands for."""

    def columns(bands: int) -> np.ndarray:
        wavelength = np.linspace(400, 1000, bands)
        return (0.3 + 0.2 * np.sin(wavelength / 120)) @ SpectralBasis(400, 1000, 12).matrix(wavelength)[0]

    assert columns(15) == pytest.approx(columns(270), abs=0.02)


def test_uneven_bands_count_by_their_stretch():
    """A hundred bands crowded around 500 nm do not outweigh the evenly spread rest of a column."""
    even = np.linspace(400, 1000, 61)
    crowded = np.concatenate([even, np.linspace(499, 501, 100)])
    basis = SpectralBasis(400, 1000, 6)
    assert crowded @ basis.matrix(crowded)[0] == pytest.approx(even @ basis.matrix(even)[0], abs=3)


@given(st.lists(st.sampled_from(range(300, 2500, 7)), min_size=2, max_size=30, unique=True))
def test_stretches_of_all_bands_make_up_the_spectrum(nanometres: list[int]):
    """Trapezoids from the first band to the last leave no gap and overlap nowhere."""
    wavelength = np.array(nanometres, float)
    assert band_widths(wavelength).sum() == pytest.approx(np.ptp(wavelength))


@pytest.mark.parametrize("wavelength", [[550.0], [550.0, 550.0, 550.0]])
def test_a_single_wavelength_has_weight_one(wavelength: list[float]):
    """One band alone, or one given several times, carries its column alone."""
    assert band_widths(np.array(wavelength)).sum() == pytest.approx(1)
    matrix, reached = SpectralBasis.spanning(np.array(wavelength)).matrix(np.array(wavelength))
    assert reached.tolist() == [True]
    assert matrix.sum() == pytest.approx(1)


def test_a_basis_has_no_more_columns_than_distinct_bands():
    """Two frames' bands make two columns, 270 bands the most that was asked for."""
    assert SpectralBasis.spanning(np.array([680.0, 800.0, 800.0])) == SpectralBasis(680, 800, 2)
    assert SpectralBasis.spanning(np.linspace(400, 1000, 270), 24).columns == 24


def test_two_columns_of_two_bands_keep_them_apart():
    """With as many columns as bands each column is mostly its own band."""
    matrix, _ = SpectralBasis(680, 800, 2).matrix(np.array([680.0, 800.0]))
    assert np.diag(matrix).min() > 0.85


@pytest.mark.parametrize(
    ("wavelength", "words"),
    [
        ([0.45, 0.9], "0.45 is outside 200-3000 nm.*micrometres"),
        ([450.0, np.nan], "nan is outside"),
        ([450.0, np.inf], "inf is outside"),
        ([], "each of 0 bands"),
    ],
)
def test_wavelengths_that_are_none_are_refused(wavelength: list[float], words: str):
    """Micrometres, numbers that are not finite, and no bands at all are named."""
    with pytest.raises(WavelengthError, match=words):
        BASIS.matrix(np.array(wavelength))


def test_a_wavelength_is_wanted_for_every_band():
    """The message says how many bands and how many wavelengths there are."""
    with pytest.raises(WavelengthError, match="each of 5 bands, got 3"):
        checked_wavelengths(np.array([400.0, 500.0, 600.0]), 5)


def _sample() -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.normal(0.4, 0.1, (2000, 1)) + rng.normal(0, 0.01, (2000, 5)) * np.arange(1, 6)


def test_normalised_columns_are_uncorrelated():
    """Columns that nearly repeat each other come out with unit variance and no correlation."""
    normal = Normalisation.measured(_sample()).apply(_sample(), np.ones(5, bool))
    assert np.cov(normal.T) == pytest.approx(np.eye(5), abs=0.02)


def test_normalisation_follows_the_order_of_columns():
    """Whitening is symmetric: permuted columns give the permuted result, with no sign or place exchanged."""
    sample, order = _sample(), [3, 0, 4, 2, 1]
    straight = Normalisation.measured(sample).apply(sample, np.ones(5, bool))
    permuted = Normalisation.measured(sample[:, order]).apply(sample[:, order], np.ones(5, bool))
    assert permuted == pytest.approx(straight[:, order], abs=1e-3)


def test_more_light_is_a_gain_and_a_shift():
    """Light brighter by a share e multiplies normalised columns by 1 + e and adds e times the gain shift."""
    normalisation, reached = Normalisation.measured(_sample()), np.ones(5, bool)
    bright = normalisation.apply(_sample() * 1.1, reached)
    expected = normalisation.apply(_sample(), reached) * 1.1 + 0.1 * normalisation.gain_shift
    assert bright == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_missing_counts_as_what_the_others_let_expect(bad: float):
    """A value that is not finite enters as a column that no band reaches; without any value it is the median's."""
    normalisation, known = Normalisation.measured(_sample()), np.array([True, True, False, False, True])
    broken = np.stack([np.full(5, 0.4), np.where(known, 0.5, bad), np.full(5, bad)])
    found = normalisation.apply(broken, np.ones(5, bool))
    assert found[0] == pytest.approx(normalisation.apply(broken[0], np.ones(5, bool)), abs=1e-5)
    assert found[1] == pytest.approx(normalisation.apply(broken[1], known), abs=1e-5)
    assert not found[2].any()


def test_dead_bands_leave_their_weight_to_the_rest():
    """A flat spectrum stays flat where bands are dead; a column without a band is NaN, and so is a pixel half dead."""
    nm = np.linspace(400, 1000, 30)
    matrix, _ = SpectralBasis(400.0, 1000.0, 8).matrix(nm)
    values = np.full((4, 30), 0.3)
    values[1, ::2], values[2, :8], values[3, :16] = np.nan, np.inf, np.nan
    found = project(values, matrix)
    assert found[:2] == pytest.approx(0.3, abs=1e-6)
    assert np.isnan(found[2]).tolist() == [True] + [False] * 7
    assert np.isnan(found[3]).all()


def test_unreached_columns_are_what_the_others_let_expect():
    """A column that nearly repeats its neighbours is told by them: left out, the result is nearly what it was."""
    sample, reached = _sample(), np.array([True, True, False, True, True])
    normalisation = Normalisation.measured(sample)
    normal = (sample - normalisation.centre) / normalisation.spread
    fitted, *_ = np.linalg.lstsq(normal[:, reached], normal[:, 2], rcond=None)
    told = normalisation.apply(sample, reached) @ np.linalg.inv(normalisation.whitening)
    off = np.std(told[:, 2] - normal[:, 2])
    assert off == pytest.approx(np.std(normal[:, reached] @ fitted - normal[:, 2]), rel=0.02)
    assert off < 0.4 * np.std(normal[:, 2])
    assert told[:, reached] == pytest.approx(normal[:, reached], abs=1e-3)


def test_what_unreached_columns_hold_does_not_matter():
    """Whatever number stands where no band reaches, the result is the same; without any column it is the median's."""
    normalisation, reached = Normalisation.measured(_sample()), np.array([True, True, False, False, True])
    one, other = (np.where(reached, 0.5, hidden) for hidden in (0.0, 99.0))
    assert (normalisation.apply(one, reached) == normalisation.apply(other, reached)).all()
    assert not normalisation.apply(one, np.zeros(5, bool)).any()
