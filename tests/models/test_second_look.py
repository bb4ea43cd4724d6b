"""Scores after a first round: laws of the re-scoring, and the divergence that it is made from."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.network import batches
from models.network.scorer import MOST_GAIN
from models.reading.inference import CoarseLook, look_coarsely, read_glance
from models.second_look import MOST_TIMES, rescore, surprise
from models.weights.files import Weights
from pipeline.errors import ShapeError
from pipeline.geometry.grid import SceneGrid

SHAPE = (9, 14)
COUNT = SHAPE[0] * SHAPE[1]


def drawn(seed: int, captured: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scores of all seats, some below 0; captured seats; surprises there."""
    rng = np.random.default_rng(seed)
    score = rng.exponential(0.2, COUNT) - 0.05
    seats = rng.permutation(COUNT)[:captured]
    return score, seats, np.maximum(score[seats], 0) * rng.uniform(0, 3, captured)


def rest(seats: np.ndarray) -> np.ndarray:
    """Seats that were not captured."""
    return np.setdiff1d(np.arange(COUNT), seats)


@pytest.mark.parametrize("relative", [False, True])
@settings(deadline=None)  # scipy is imported when it is first asked for
@given(st.integers(0, 999), st.integers(0, COUNT))
def test_a_surprise_as_expected_changes_no_score(relative: bool, seed: int, captured: int) -> None:
    """What is left keeps its score to the last bit; what was captured is worth nothing more."""
    score, seats, _ = drawn(seed, captured)
    again = rescore(score, seats, np.maximum(score[seats], 0), SHAPE, relative=relative)
    assert again[rest(seats)].tolist() == score[rest(seats)].tolist()
    assert not again[seats].any()


@pytest.mark.parametrize("relative", [False, True])
@settings(deadline=None)
@given(st.integers(0, 999), st.integers(0, 999))
def test_the_order_of_the_captured_seats_has_no_part_in_it(relative: bool, seed: int, order: int) -> None:
    """Any order of the same looks gives the same scores."""
    score, seats, found = drawn(seed)
    mixed = np.random.default_rng(order).permutation(len(seats))
    one = rescore(score, seats, found, SHAPE, relative=relative)
    np.testing.assert_allclose(one, rescore(score, seats[mixed], found[mixed], SHAPE, relative=relative), rtol=1e-13)


@settings(deadline=None)
@given(st.integers(0, 999), st.floats(1e-6, 1e6))
def test_scores_of_another_unit_expect_in_proportion(seed: int, unit: float) -> None:
    """Relative scores do not ask in what unit they are, nor in what unit surprises are: only their order counts."""
    score, seats, found = drawn(seed)
    one = rescore(score, seats, found, SHAPE, relative=True)
    np.testing.assert_allclose(rescore(score * unit, seats, found, SHAPE, relative=True), one * unit, rtol=1e-9)
    np.testing.assert_allclose(rescore(score, seats, found * unit, SHAPE, relative=True), one, rtol=1e-9)
    in_proportion = rescore(score, seats, 0.3 * np.maximum(score[seats], 0), SHAPE, relative=True)
    np.testing.assert_allclose(in_proportion[rest(seats)], score[rest(seats)], rtol=1e-12)


@settings(deadline=None)
@given(st.integers(0, 999), st.integers(0, 29), st.floats(1.1, 50))
def test_more_found_at_a_seat_never_lowers_a_score(seed: int, which: int, times: float) -> None:
    """Every seat is worth at least as much when one look showed more; its neighbours gain the most."""
    score, seats, found = drawn(seed)
    score = np.abs(score)
    more = found.copy()
    more[which] = found[which] * times + 0.1
    low, high = (rescore(score, seats, surprise, SHAPE) for surprise in (found, more))
    assert (high >= low * (1 - 1e-12)).all()


def test_what_one_look_shows_speaks_for_its_neighbours_first() -> None:
    """A surprise on the left raises the left more than the right, and a disappointment lowers it."""
    score, seats = np.full(COUNT, 0.1), np.array([4 * 14 + 2, 4 * 14 + 11])
    image = rescore(score, seats, np.array([0.5, 0.1]), SHAPE).reshape(SHAPE)
    assert image[4, 3] > image[4, 6] > image[4, 12]
    assert image[4, 3] > 0.15
    dull = rescore(score, seats, np.array([0.0, 0.1]), SHAPE).reshape(SHAPE)
    assert dull[4, 3] < dull[4, 6] < 0.1


def test_far_from_all_looks_the_ratio_is_that_of_the_field() -> None:
    """20 looks that showed half of what was expected: far away (8 + 10) / (8 + 20) of the score."""
    shape = (40, 40)
    score = np.full(1600, 0.2)
    seats = np.arange(20)
    again = rescore(score, seats, np.full(20, 0.1), shape)
    assert again[-1] == pytest.approx(0.2 * 18 / 28)
    assert rescore(score, seats, np.full(20, 0.1), shape, relative=True)[-1] == pytest.approx(0.2)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("found", [0.0, 1e-300, 1e300, np.nan, np.inf])
@pytest.mark.parametrize("expected", [0.0, -1.0, 1e-300, 1.0, 1e300])
def test_scores_stay_finite_whatever_was_expected_and_found(expected: float, found: float, relative: bool) -> None:
    """No division by next to nothing: a score changes by at most ``MOST_TIMES``."""
    score = np.full(COUNT, 0.5)
    seats = np.array([3, 40])
    score[seats] = expected
    with np.errstate(over="ignore"):
        again = rescore(score, seats, np.full(2, found), SHAPE, relative=relative)
    left = again[rest(seats)]
    assert np.isfinite(left).all()
    assert left.min() >= 0.5 / MOST_TIMES * (1 - 1e-12)
    assert left.max() <= 0.5 * MOST_TIMES * (1 + 1e-12)


def test_without_a_look_nothing_changes_and_scores_that_are_none_stay_so() -> None:
    """No captured seat: the same scores, NaN and -inf among them; a captured one that expected NaN says nothing."""
    score = np.array([0.1, np.nan, -np.inf, np.inf, -0.3, 0.2])
    np.testing.assert_array_equal(rescore(score, np.empty(0, int), np.empty(0), (2, 3)), score)
    again = rescore(score, np.array([1, 3]), np.array([5.0, 5.0]), (2, 3))
    np.testing.assert_array_equal(again, [0.1, 0.0, -np.inf, 0.0, -0.3, 0.2])


def test_what_was_seen_in_part_is_worth_the_rest() -> None:
    """Of a seat of which a quarter was seen three quarters of its score are left."""
    score = np.full(COUNT, 0.4)
    seats = np.array([5, 6])
    again = rescore(score, seats, score[seats], SHAPE, seen=np.array([0.25, 1.0]))
    assert again[seats].tolist() == pytest.approx([0.3, 0.0])


def test_looks_that_do_not_fit_are_refused() -> None:
    """Other lengths, seats of no grid and seats given twice."""
    score = np.ones(COUNT)
    with pytest.raises(ShapeError, match="expected 126 scores and one surprise and share for each"):
        rescore(score[:-1], np.array([1]), np.ones(1), SHAPE)
    with pytest.raises(ShapeError, match="one surprise and share for each"):
        rescore(score, np.array([1, 2]), np.ones(1), SHAPE)
    with pytest.raises(ShapeError, match="seat 126 is none of the 126 seats"):
        rescore(score, np.array([126]), np.ones(1), SHAPE)
    with pytest.raises(ShapeError, match="seat 7 was captured once and is given 2 times"):
        rescore(score, np.array([7, 7]), np.ones(2), SHAPE)


def _looked(weights: Weights, size: tuple[int, int]) -> tuple[CoarseLook, np.ndarray, np.ndarray]:
    grid = SceneGrid(*size, weights.config.patch, weights.config.factor)
    rng = np.random.default_rng(3)
    nm = np.linspace(450, 950, 6)
    seen = look_coarsely(weights, [rng.uniform(0.1, 0.5, (*grid.coarse_shape, 6))], nm, grid)
    seats = grid.valid_seats()[::3]
    p = grid.patch
    return seen, rng.normal(size=(len(seats), p, p, weights.config.columns)).astype(np.float32), seats


def test_a_surprise_is_the_divergence_from_the_glance(tiny: Callable[..., Weights]) -> None:
    """By hand, pixel by pixel from the logits of the whole scene; never negative, at most what a gain may be."""
    import torch
    import torch.nn.functional as F  # noqa: N812 - its usual name

    weights = tiny(0)
    seen, patches, seats = _looked(weights, (32, 48))
    found = surprise(weights, seen, patches, seats)
    with torch.inference_mode():
        coarse, fine = weights.segmenter(
            torch.from_numpy(seen.columns).permute(2, 0, 1)[None],
            torch.from_numpy(patches).permute(0, 3, 1, 2)[None], torch.from_numpy(seats)[None],
        )  # fmt: skip
        whole = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[0].log_softmax(0)
    for number, seat in enumerate(seats):
        y, x = seen.grid.seat_origin(seat)
        before, sure = whole[:, y : y + 8, x : x + 8], fine[0, number].log_softmax(0)
        by_hand = float((sure.exp() * (sure - before)).sum(0).mean())
        assert found[number] == pytest.approx(min(by_hand, MOST_GAIN), rel=1e-4, abs=1e-6)
    assert (found >= 0).all()
    assert found.max() <= MOST_GAIN


def test_a_surprise_goes_on_from_what_the_glance_kept(
    tiny: Callable[..., Weights], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a glance nothing is read again, and the figures are those of the coarse look."""
    weights = tiny(0)
    seen, patches, seats = _looked(weights, (32, 48))
    found, kept = surprise(weights, seen, patches, seats), read_glance(weights, seen)
    monkeypatch.setattr(batches, "read_coarse_packed", lambda segmenter, images, *rest: [1 / 0 for _ in images])
    np.testing.assert_array_equal(surprise(weights, kept, patches, seats), found)


def test_a_surprise_counts_the_scene_alone_and_any_order(tiny: Callable[..., Weights]) -> None:
    """A seat half beyond the scene counts by its half; patches in another order keep their surprise; none is empty."""
    weights = tiny(1)
    seen, patches, seats = _looked(weights, (28, 44))
    found = surprise(weights, seen, patches, seats)
    turned = surprise(weights, seen, patches[::-1].copy(), seats[::-1].copy())
    np.testing.assert_allclose(turned[::-1], found, rtol=1e-5, atol=1e-9)
    assert surprise(weights, seen, patches[:0], seats[:0]).shape == (0,)
    with pytest.raises(ShapeError, match="expected patches of shape"):
        surprise(weights, seen, patches[:1], seats)
    with pytest.raises(ShapeError, match="given more than once"):
        surprise(weights, seen, patches[:2], seats[[0, 0]])
