"""Scores by least squares over the valid bands, and rare spectra that the components do not represent."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, poisson

from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import (
    PARTIAL,
    RESIDUAL_STEP,
    UNUSABLE,
    WHOLE,
    ResidualLaw,
    find_rare,
    residual_steps,
    score_lines,
)
from spectralzoom.pipeline.signal.rounding import whole_steps
from spectralzoom.pipeline.signal.subspace import SignalStatistics, components_of_field, find_components
from tests.pipeline.signal.made_spectra import Field, field_of, marked, restored, scored, statistics_of

SEEDS = st.integers(0, 2**32 - 1)
SHAPES = {"a pixel": (1, 1), "2 x 2 px": (2, 2), "a line of 8": (1, 8)}


@pytest.fixture(scope="module")
def condensed() -> tuple[Field, SignalStatistics, Components]:
    """Return a field of 3 materials in 60 bands, its statistics and its components."""
    made = field_of(11, bands=60)
    found = statistics_of(made.values)
    return made, found, find_components(found)


@settings(max_examples=10)
@given(seed=SEEDS)
def test_scores_with_missing_bands_equal_least_squares(seed: int) -> None:
    """With up to half of the bands missing, numpy's least squares over the others gives the same scores."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(24, 4)))[0].T
    law = Components(rng.uniform(0, 2, 24), axes, rng.uniform(0.1, 1, 24))
    values = rng.normal(1, 3, (2, 3, 24)).astype(np.float32)
    valid = rng.permuted(np.tile(np.arange(24) >= 12, (2, 3, 1)), axis=2)
    valid[0, 0] = True
    seen = score_lines(values, valid, law)
    for place in np.ndindex(2, 3):
        there = valid[place]
        white = (values[place] - law.mean)[there] / law.noise[there]
        wanted = np.linalg.lstsq(axes[:, there].T, white, rcond=None)[0]
        np.testing.assert_allclose(seen.scores[place], wanted, rtol=2e-3, atol=2e-2)


@settings(max_examples=10)
@given(seed=SEEDS)
def test_a_spectrum_is_scored_without_its_neighbours(condensed: tuple, seed: int) -> None:
    """Scores, quality and residual of some spectra, with missing bands, equal those of the whole field."""
    made, _, law = condensed
    rng = np.random.default_rng(seed)
    valid = rng.random((*made.values.shape[:2], 60)) > 0.3
    line, sample = rng.integers(0, 90, 2)
    part = np.s_[line : line + 3, sample : sample + 2]
    whole, alone = score_lines(made.values[:, :], valid, law), score_lines(made.values[part], valid[part], law)
    np.testing.assert_allclose(alone.scores, whole.scores[part], rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(alone.quality, whole.quality[part])
    np.testing.assert_allclose(alone.residual, whole.residual[part], rtol=1e-3)


def test_quality_depends_on_the_missing_bands(condensed: tuple) -> None:
    """Quality is 0 with all bands, 1 with at least half, else 2 with scores of 0 and no residual."""
    made, _, law = condensed
    valid = np.ones((1, 5, 60), np.bool_)
    for sample, missing in enumerate((0, 1, 30, 31, 60)):
        valid[0, sample, :missing] = False
    seen = score_lines(made.values[:1, :5], valid, law)
    assert seen.quality[0].tolist() == [WHOLE, PARTIAL, PARTIAL, UNUSABLE, UNUSABLE]
    assert (seen.scores[0, 3:] == 0).all()
    assert np.isnan(seen.residual[0]).tolist() == [False, False, False, True, True]


def test_invalid_spectra_are_unusable(condensed: tuple) -> None:
    """With a validity per spectrum and no missing band, the others keep their scores."""
    made, _, law = condensed
    valid = np.ones((4, 4), np.bool_)
    valid[2, 1] = False
    seen, plain = scored(made.values[:4, :4], law, valid), scored(made.values[:4, :4], law)
    assert np.argwhere(seen.quality == UNUSABLE).tolist() == [[2, 1]]
    np.testing.assert_array_equal(seen.scores[valid], plain.scores[valid])


def test_nan_counts_as_a_missing_band(condensed: tuple) -> None:
    """NaN in a valid spectrum is restored from the other bands, and its quality is partial."""
    made, _, law = condensed
    values = made.values[:2, :2].copy()
    values[1, 1, 20:25] = np.nan
    seen = scored(values, law)
    assert seen.quality.tolist() == [[WHOLE, WHOLE], [WHOLE, PARTIAL]]
    assert np.abs((restored(seen, law)[1, 1] - made.clean[1, 1]) / made.noise).max() < 3


def test_saturated_bands_are_restored_from_the_others(condensed: tuple) -> None:
    """With a third of the bands saturated in an area, their median error is below twice that of the other bands."""
    made, found, law = condensed
    values = made.values.copy()
    valid = np.ones(made.values.shape, np.bool_)
    values[30:40, 30:50, ::3], valid[30:40, 30:50, ::3] = 9.0, False
    seen = score_lines(values, valid, law)
    assert (seen.quality == PARTIAL).sum() == 200
    off = np.abs(restored(seen, law) - made.clean)[30:40, 30:50] / made.noise
    assert np.median(off[..., ::3]) < 2 * np.median(off[..., 1::3])
    assert not marked(values, found, law, valid).any()


def test_many_components_and_few_valid_bands_mark_nothing() -> None:
    """Half of the bands are saturated and there are half as many components: few degrees of freedom cause no alarm."""
    made = field_of(6, bands=30, materials=9)
    found = statistics_of(made.values)
    valid = np.ones(made.values.shape, np.bool_)
    valid[40:60, :, 1::2] = False
    assert not marked(made.values, found, find_components(found), valid).any()


def test_one_of_two_bands_suffices() -> None:
    """The valid band is restored, and the other one by their correlation in the field."""
    made = field_of(1, bands=2, materials=1)
    law = find_components(statistics_of(made.values))
    valid = np.ones((1, 2, 2), np.bool_)
    valid[0, 1, 0] = False
    seen = score_lines(made.values[:1, :2], valid, law)
    back = law.restore(seen.scores)[0, 1]
    assert seen.quality.tolist() == [[WHOLE, PARTIAL]]
    assert back[1] == pytest.approx(made.values[0, 1, 1], rel=1e-3)
    assert back[0] == pytest.approx(made.clean[0, 1, 0], abs=0.02)
    assert abs(law.mean[0] - made.clean[0, 1, 0]) > 0.05


@pytest.mark.parametrize("missing", [3, 6, 12, 24])
def test_a_run_of_missing_bands_is_restored_within_noise(missing: int) -> None:
    """Neighbouring saturated bands leave smooth directions open; the field's scores show the likely ones."""
    made = field_of(3, bands=60)
    law = components_of_field(statistics_of(made.values), np.linspace(400, 1000, 60), false_alarm=0.01, least=4)
    assert len(law) > 20
    run = np.s_[20 : 20 + missing]
    valid = np.ones(made.values.shape, np.bool_)
    valid[..., run] = False
    off = (law.restore(score_lines(made.values, valid, law).scores) - made.clean)[..., run] / law.noise[run]
    assert np.sqrt(np.mean(off**2)) < 1
    assert np.abs(off).max() < 6


def test_the_residual_law_follows_shot_noise() -> None:
    """Noise that grows with the signal is predicted by the scores, so bright spectra are not rarer than dark ones."""
    made = field_of(5, bands=60, materials=1, signal=40)
    level = 1 + np.clip((made.clean - 1) / np.ptp(made.clean), -0.45, 0.45).mean(axis=2, keepdims=True)
    values = (made.clean + (made.values - made.clean) * level).astype(np.float32)
    found = statistics_of(values)
    components = find_components(found)
    seen = scored(values, components)
    ratio = seen.residual / ResidualLaw.learned(found.spectra, components).expected(seen.scores)
    bright = level[..., 0] > np.median(level)
    assert seen.residual[bright].mean() > 1.05 * seen.residual[~bright].mean()
    assert ratio[bright].mean() == pytest.approx(ratio[~bright].mean(), rel=0.02)


def test_few_spectra_give_the_default_residual_law() -> None:
    """With fewer than 8 spectra per component the noise's own variance is expected of all."""
    made = field_of(2)
    law = ResidualLaw.learned(made.values[:2, :10].reshape(-1, 40), find_components(statistics_of(made.values)))
    assert (law.constant, law.freedom) == (1.0, 36.0)
    assert not law.slope.any()


@pytest.mark.parametrize("alarms", [1.0, 10.0])
@pytest.mark.parametrize("shape", [(64, 64), (8, 500), (1, 300), (2, 9)])
def test_noise_alone_marks_at_most_the_stated_number(shape: tuple[int, int], alarms: float) -> None:
    """Marks in 60 images of noise, edges included, stay within a Poisson quantile for a mean of ``alarms`` each.

    Windows mark up to 8 spectra at once, so that there are 8 times fewer independent events.
    """
    law = ResidualLaw(1.0, np.zeros(0), 50.0)
    total = 0
    for seed in range(60):
        noise = np.random.default_rng(seed).chisquare(50, shape) / 50
        total += int(find_rare(noise.astype(np.float32), law, alarms).sum())
    assert total <= 8 * poisson.ppf(0.999, 60 * alarms / 8)


def test_noise_of_a_field_marks_at_most_the_stated_number() -> None:
    """Noise, components and residual law are learned from each of 8 fields of materials, with 10 alarms each."""
    total = 0
    for seed in range(8):
        made = field_of(seed, (64, 64), 24)
        found = statistics_of(made.values)
        total += int(marked(made.values, found, find_components(found), alarms=10.0).sum())
    assert total <= 8 * poisson.ppf(0.999, 80 / 8)


def kept_of_planted(condensed: tuple, shape: tuple[int, int], sigma: float) -> float:
    """Plant a random signature of so many sigma per band at 36 places of a field; return the fraction marked."""
    made, found, law = condensed
    rng = np.random.default_rng(8)
    values, there = made.values.copy(), np.zeros(made.values.shape[:2], np.bool_)
    for line, sample in 4 + 15 * np.argwhere(np.ones((6, 6))):
        place = np.s_[line : line + shape[0], sample : sample + shape[1]]
        values[place] += (sigma * rng.choice([-1, 1], 60) * made.noise).astype(np.float32)
        there[place] = True
    return float(marked(values, found, law)[there].mean())


@pytest.mark.parametrize("sigma", [1.0, 2.0, 5.0, 20.0])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_planted_spectra_are_marked(condensed: tuple, shape: tuple[int, int], sigma: float) -> None:
    """A random signature of 1 to 20 sigma per band is planted at 36 places of a field of 60 bands.

    At 1 sigma more than half of the single pixels are marked, and nine in ten of the others.
    """
    kept = kept_of_planted(condensed, shape, sigma)
    assert kept >= (0.9 if sigma == 1 and shape != (1, 1) else 0.55 if sigma == 1 else 1.0)


def test_neighbours_are_found_together_below_the_threshold_of_one(condensed: tuple) -> None:
    """At 0.7 sigma per band few single pixels are rare, but most blocks and lines of 8 are."""
    kept = {name: kept_of_planted(condensed, shape, 0.7) for name, shape in SHAPES.items()}
    assert kept["a pixel"] < 0.3
    assert kept["2 x 2 px"] > kept["a pixel"] + 0.3
    assert kept["a line of 8"] > 0.9


def test_one_bright_spectrum_marks_only_itself(condensed: tuple) -> None:
    """A spectrum far from all components is rare; its neighbours are noise and are not marked."""
    made, found, law = condensed
    values = made.values.copy()
    values[50, 40, ::2] += 1.0
    assert np.argwhere(marked(values, found, law)).tolist() == [[50, 40]]


def test_windows_mark_all_of_their_own_spectra() -> None:
    """Blocks of 2 x 2 and lines of 8 in both directions are marked up to the image's corners, and nothing else is."""
    law = ResidualLaw(1.0, np.zeros(0), 200.0)
    for place in (np.s_[0:2, 0:2], np.s_[18:20, 28:30], np.s_[0, :8], np.s_[19, 22:], np.s_[12:, 29], np.s_[5, 9:17]):
        ratio = np.ones((20, 30), np.float32)
        freedom = 200 * ratio[place].size
        ratio[place] = 1.001 * chi2.isf(1e-3 / 4 / 600 / ratio[place].size, freedom) / freedom  # a part is not enough
        np.testing.assert_array_equal(find_rare(ratio, law, 1e-3), ratio > 1)


def test_unusable_spectra_are_never_rare() -> None:
    """NaN is not rare and does not hide its neighbours."""
    ratio = np.ones((20, 30), np.float32)
    ratio[5, 5], ratio[5, 6] = np.nan, 9
    assert np.argwhere(find_rare(ratio, ResidualLaw(1.0, np.zeros(0), 50.0), 1.0)).tolist() == [[5, 6]]


@pytest.mark.parametrize("sigma", [2.0, 20.0, 1e5])
def test_rare_spectra_are_stored_within_a_residual_step(condensed: tuple, sigma: float) -> None:
    """Rounded scores plus residual steps restore a spectrum to half a step, at any distance from the others."""
    made, _, law = condensed
    values = made.values[7, :20] + (sigma * np.random.default_rng(1).normal(size=(20, 60)) * made.noise).astype("f4")
    rounded = np.rint(scored(values[None], law).scores[0])
    back = law.restore(rounded) + residual_steps(values, rounded, law) * RESIDUAL_STEP * law.noise
    assert np.abs((back - values) / law.noise).max() <= RESIDUAL_STEP / 2 + 1e-6 * sigma + 1e-3


def test_missing_bands_have_no_residual(condensed: tuple) -> None:
    """Missing bands add nothing to the values restored from scores."""
    made, _, law = condensed
    values = made.values[:1, :4].reshape(4, 60) + 1
    valid = np.ones((4, 60), np.bool_)
    valid[1, 5:9] = False
    values[2, 30] = np.nan
    steps = residual_steps(values, np.zeros((4, len(law)), np.float32), law, valid)
    assert np.argwhere(steps == 0).tolist() == [[1, 5], [1, 6], [1, 7], [1, 8], [2, 30]]


@given(seed=SEEDS, step=st.sampled_from([1.5, 3.0, 6.0]), shape=st.tuples(*[st.integers(0, 13)] * 2, st.integers(0, 3)))
@settings(max_examples=20)
def test_coarse_steps_keep_the_means_of_blocks(seed: int, step: float, shape: tuple[int, int, int]) -> None:
    """No score errs by more than a step, and the mean of a whole 4 x 4 block by more than 1/32 of one."""
    scores = np.random.default_rng(seed).normal(0, 4, shape).astype(np.float32)
    off = whole_steps(scores, step) - scores / np.float32(step)
    assert np.abs(off).max(initial=0) <= 1
    lines, samples = (size // 4 * 4 for size in shape[:2])
    blocks = off[:lines, :samples].reshape(lines // 4, 4, samples // 4, 4, shape[2])
    assert np.abs(blocks.mean(axis=(1, 3))).max(initial=0) <= 1 / 32 + 1e-5
    rest = np.concatenate([off[lines:].ravel(), off[:, samples:].ravel()])
    assert np.abs(rest).max(initial=0) <= 0.5 + 1e-5


def test_a_signal_below_a_coarse_step_stays_in_the_means() -> None:
    """Half of a field is 0.25 sigma higher: rounding each score alone loses most of this difference, steps keep it."""
    scores = np.random.default_rng(5).normal(0, 0.5, (64, 64, 1)).astype(np.float32)
    scores[:, 32:] += 0.25
    seen = [half.mean() for half in np.split(scores, 2, axis=1)]
    kept = [half.mean() * 4 for half in np.split(whole_steps(scores, 4), 2, axis=1)]
    alone = [half.mean() * 4 for half in np.split(np.rint(scores / 4), 2, axis=1)]
    assert kept[1] - kept[0] == pytest.approx(seen[1] - seen[0], abs=0.02)
    assert alone[1] - alone[0] < 0.05


def test_blocks_with_a_non_finite_score_are_rounded_one_by_one() -> None:
    """Only the component of the non-finite score is affected; others keep their block means."""
    scores = np.random.default_rng(2).normal(0, 4, (32, 32, 2)).astype(np.float32)
    scores[1::4, 2::4, 0] = np.nan
    scores[2, 2, 0] = np.inf
    kept = whole_steps(scores, 3)
    alone = np.rint(scores / np.float32(3))
    np.testing.assert_array_equal(kept[..., 0], alone[..., 0])
    assert (kept[..., 1] != alone[..., 1]).any()


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_fine_steps_are_rounded_one_by_one(step: float) -> None:
    """The noise is larger than the steps, so it keeps the means."""
    scores = np.random.default_rng(2).normal(0, 4, (8, 8, 2)).astype(np.float32)
    np.testing.assert_array_equal(whole_steps(scores, step), np.rint(scores / np.float32(step)))
