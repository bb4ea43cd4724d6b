"""Components give spectra from scores: linear operations stay linear, and bands without a value are ignored."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.signal.components import Components

SEEDS = st.integers(0, 2**32 - 1)


def law_of(seed: int, bands: int = 12, count: int = 4, dead: tuple[int, ...] = ()) -> Components:
    """Return random components of some bands; ``dead`` bands have no value."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(0.1, 2, bands)
    noise = rng.uniform(0.01, 0.1, bands)
    axes = np.zeros((count, bands))
    lit = np.setdiff1d(np.arange(bands), dead)
    axes[:, lit] = np.linalg.qr(rng.normal(size=(len(lit), count)))[0].T
    mean[list(dead)] = noise[list(dead)] = np.nan
    return Components(mean, axes, noise)


def spectra_of(seed: int, bands: int = 12) -> np.ndarray:
    """Return a few spectra."""
    return np.random.default_rng([seed, 7]).uniform(0, 3, (2, 3, bands)).astype(np.float32)


@given(seed=SEEDS, dead=st.sampled_from([(), (0,), (3, 7)]))
def test_restoring_scores_is_a_projection(seed: int, dead: tuple[int, ...]) -> None:
    """A spectrum restored from scores has the same scores again, and so the same spectrum."""
    law = law_of(seed, dead=dead)
    axes = law.axes.T.astype(np.float32)
    once = law.restore(law.white(spectra_of(seed)) @ axes)
    np.testing.assert_allclose(law.restore(law.white(np.nan_to_num(once)) @ axes), once, rtol=1e-4, atol=1e-4)


@given(seed=SEEDS, dead=st.sampled_from([(), (5,), (2, 11)]))
def test_a_matrix_or_a_gain_acts_on_scores_as_on_spectra(seed: int, dead: tuple[int, ...]) -> None:
    """From scores they give what they give from restored spectra, with 0 in dead bands: a product, or other scores."""
    law = law_of(seed, dead=dead)
    rng = np.random.default_rng(seed)
    scores = rng.normal(0, 20, (2, 3, 4)).astype(np.float32)
    spectra = np.nan_to_num(law.restore(scores))
    matrix, gain = rng.normal(size=(12, 5)), rng.uniform(0.5, 2, 12)
    weights, offset = law.onto(matrix)
    np.testing.assert_allclose(scores @ weights + offset, spectra @ matrix, rtol=1e-3, atol=1e-3)
    turned, shift = law.scaled(gain)
    np.testing.assert_allclose(scores @ turned + shift, law.white(spectra * gain) @ law.axes.T, rtol=1e-3, atol=1e-2)


@given(seed=SEEDS, bands=st.lists(st.integers(0, 11), min_size=1, max_size=12))
def test_some_bands_are_restored_as_with_all(seed: int, bands: list[int]) -> None:
    """Components of some bands, in any order, restore the same values as all components do in those bands."""
    law = law_of(seed, dead=(4,))
    scores = np.random.default_rng(seed).normal(0, 20, (3, 4)).astype(np.float32)
    some = law.of_bands(bands)
    assert some.bands == len(bands)
    np.testing.assert_allclose(some.restore(scores), law.restore(scores)[:, bands], rtol=1e-5, atol=1e-5)


@given(seed=SEEDS)
def test_no_score_exceeds_the_stated_largest(seed: int) -> None:
    """`largest` bounds the scores of all spectra within a distance of the mean."""
    law = law_of(seed, dead=(1,))
    rng = np.random.default_rng(seed)
    reach = rng.uniform(0, 3, 12)
    spectra = (np.nan_to_num(law.mean) + reach * rng.choice([-1, 1], (50, 12))).astype(np.float32)
    assert np.abs(law.white(spectra) @ law.axes.T).max() <= law.largest(reach) * (1 + 1e-4)


@pytest.mark.parametrize("value", [np.nan, 0.0, 5.0])
def test_a_band_without_a_value_is_ignored(value: float) -> None:
    """Any value in it becomes 0 in whitened spectra, and only this band is restored as NaN."""
    law = law_of(1, dead=(6,))
    spectra = spectra_of(1)
    spectra[..., 6] = value
    white = law.white(spectra)
    assert (white[..., 6] == 0).all()
    missing = np.isnan(law.restore(white @ law.axes.T.astype(np.float32)))
    assert np.flatnonzero(missing.all(axis=(0, 1))).tolist() == [6]
    assert missing.sum() == 6


def test_a_nan_score_restores_nan() -> None:
    """A NaN score makes its own spectrum NaN and no other."""
    scores = np.zeros((2, 4), np.float32)
    scores[0, 2] = np.nan
    assert np.isnan(law_of(2).restore(scores)).all(axis=1).tolist() == [True, False]


def test_components_without_data_are_empty() -> None:
    """Lines without any value have 0 scores and are restored as NaN."""
    law = Components.empty(5)
    assert (len(law), law.bands, law.largest(np.ones(5))) == (0, 5, 0.0)
    assert np.isnan(law.restore(np.zeros((2, 3, 0), np.float32))).all()
    assert (law.white(np.full((2, 3, 5), np.nan)) == 0).all()
