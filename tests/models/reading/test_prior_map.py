"""What is known of a field after a look: laws of the memory with a reader and without, and of what changed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import models.reading.prior_map as prior_map
from models.network.sizes import CELL_PX, TemporalSizes
from models.network.temporal_reader import TemporalReader
from models.reading.prior_map import (
    FAINTEST,
    ClassProbabilities,
    CurrentVisit,
    PriorMap,
    TemporalAgreement,
    as_captured,
    carried,
    changed_fractions,
    changed_from,
    compare,
    faded,
    first_probabilities,
    fuse,
    in_classes,
    pooled,
)
from pipeline.geometry.grid import UNLABELLED, SceneGrid

CLASSES, COLUMNS = 3, 4
SHAPE = (24, 20)
seeds = st.integers(0, 2**16)


def log_probabilities(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> NDArray[np.float32]:
    """Probabilities of classes drawn anew for each pixel, from sure to unsure."""
    logits = rng.normal(0, 2, (*shape, CLASSES))
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True)), np.float32)


def an_observation(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> CurrentVisit:
    """A look in detail at all of a field."""
    coarse = rng.normal(size=(*(-(-side // CELL_PX) for side in shape), COLUMNS)).astype(np.float32)
    return CurrentVisit(log_probabilities(rng, shape), np.ones(shape, np.bool_), coarse, 0.05, 2)


def a_prior_map(rng: np.random.Generator, shape: tuple[int, int] = SHAPE, days: float = 3.0) -> PriorMap:
    """What was seen some days ago."""
    coarse_pass = an_observation(rng, shape)
    return PriorMap(first_probabilities(coarse_pass), coarse_pass.coarse, days)


def a_reader(seed: int = 0) -> TemporalReader:
    """A reader as chance made it, in which nothing is idle."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = TemporalReader(TemporalSizes(CLASSES, COLUMNS, width=8, coarse_width=4)).eval()
        torch.nn.init.normal_(reader.leave.weight, std=0.3)
    return reader


READERS = pytest.mark.parametrize("reader", [None, a_reader()], ids=["without a reader", "with one"])


def test_exposure_of_visits_adds_up_and_fades() -> None:
    """After 30 days one e-th of the earlier exposure is left, and lines 2 px apart give a quarter of theirs."""
    rng, seen = np.random.default_rng(1), np.arange(SHAPE[1]) < np.full(SHAPE, 7)
    visit = replace(an_observation(rng), light=0.4, seen=seen)
    after = fuse(a_prior_map(rng, days=30.0), visit, None)
    np.testing.assert_allclose(after.light, 0.0125 / math.e + np.where(seen, 0.1, 0.0), rtol=1e-5)


@READERS
@given(seed=seeds)
def test_probabilities_stay_probabilities(reader: TemporalReader | None, seed: int) -> None:
    """What is believed sums to 1 but for what the faintest classes are raised by, and is never fainter than is kept."""
    rng = np.random.default_rng(seed)
    after = fuse(a_prior_map(rng), an_observation(rng), reader)
    assert after.log_probability.min() >= np.float32(FAINTEST)
    total = np.exp(after.log_probability.astype(np.float64)).sum(axis=-1)
    assert total.min() > 1 - 1e-5
    assert total.max() < 1 + CLASSES * math.exp(FAINTEST) + 1e-5


@READERS
@given(seed=seeds)
def test_ages_count_days_where_nobody_looked(reader: TemporalReader | None, seed: int) -> None:
    """A pixel that was looked at is new, one that was not is older by the days between."""
    rng = np.random.default_rng(seed)
    memory, coarse_pass = a_prior_map(rng), an_observation(rng)
    seen = rng.random(SHAPE) < 0.5
    after = fuse(
        replace(memory, probabilities=replace(memory.probabilities, age_days=np.full(SHAPE, 2.0, np.float32))),
        replace(coarse_pass, seen=seen),
        reader,
    )
    np.testing.assert_array_equal(after.age_days, np.where(seen, 0.0, 5.0).astype(np.float32))


@READERS
@given(seed=seeds)
def test_a_memory_of_this_minute_is_left_alone_where_nobody_looked(reader: TemporalReader | None, seed: int) -> None:
    """No time went by and nothing was seen: what is believed stays, but for rounding; what was seen is weighed."""
    rng = np.random.default_rng(seed)
    memory, coarse_pass = a_prior_map(rng, days=0.0), an_observation(rng)
    seen = rng.random(SHAPE) < 0.5
    after = fuse(memory, replace(coarse_pass, seen=seen), reader).log_probability
    before = memory.probabilities.log_probability
    np.testing.assert_allclose(np.exp(after[~seen]), np.exp(before[~seen]), atol=2e-5)
    assert np.abs(np.exp(after[seen]) - np.exp(before[seen])).max() > 0.01
    np.testing.assert_allclose(np.exp(carried(memory, reader).log_probability), np.exp(before), atol=2e-5)


@given(seed=seeds, days=st.floats(0, 0.99))
def test_the_reader_has_its_say_as_the_day_goes_by(seed: int, days: float) -> None:
    """Each pixel that nobody looked at lies as far between its memory and what a whole day would have made of it."""
    rng = np.random.default_rng(seed)
    reader, memory = a_reader(seed), a_prior_map(rng, days=days)
    before, after = np.exp(memory.probabilities.log_probability), np.exp(carried(memory, reader).log_probability)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prior_map, "SETTLED_DAYS", 1e-9)
        whole = np.exp(carried(replace(memory, days=max(days, 1e-9)), reader).log_probability)
    np.testing.assert_allclose(after, before + days * (whole - before), atol=3e-5)


@READERS
def test_one_that_knows_nothing_takes_the_other(reader: TemporalReader | None) -> None:
    """Where the memory is empty today's look stands, where the look is the memory does; both empty: nothing."""
    rng = np.random.default_rng(4)
    memory, coarse_pass = a_prior_map(rng), an_observation(rng)
    before, today = memory.probabilities.log_probability.copy(), coarse_pass.log_probability.copy()
    before[:8], today[4:12] = np.nan, np.nan
    ages = np.where(np.isnan(before[..., 0]), np.nan, 0.0).astype(np.float32)
    after = fuse(
        replace(memory, probabilities=ClassProbabilities(before, ages, np.ones(SHAPE, np.float32))),
        replace(coarse_pass, log_probability=today),
        reader,
    )
    np.testing.assert_array_equal(after.log_probability[:4], np.maximum(today[:4], np.float32(FAINTEST)))
    assert np.isnan(after.log_probability[4:8]).all()
    assert np.isnan(after.age_days[4:8]).all()
    assert np.isfinite(after.log_probability[8:]).all()
    assert (after.classes()[0][4:8] == 255).all()


def test_a_surer_look_speaks_against_a_memory_and_a_doubtful_one_does_not() -> None:
    """Without a reader 0.99 for another class wins over 0.9, 0.6 does not; two that agree are surer together."""
    before = np.log(np.array([[[0.9, 0.05, 0.05]] * 3], np.float32))
    today = np.log(np.array([[[0.005, 0.99, 0.005], [0.2, 0.6, 0.2], [0.8, 0.1, 0.1]]], np.float32))
    coarse = np.zeros((1, 1, COLUMNS), np.float32)
    coarse_pass = CurrentVisit(today, np.ones((1, 3), np.bool_), coarse, 1.0, 1)
    after = fuse(
        PriorMap(first_probabilities(replace(coarse_pass, log_probability=before)), None, 0.0), coarse_pass, None
    )
    assert after.classes()[0].tolist() == [[1, 0, 0]]
    assert after.classes()[1][0, 2] == pytest.approx(0.9 * 0.8 / (0.9 * 0.8 + 2 * 0.05 * 0.1))


def test_a_memory_is_worth_nothing_in_the_end() -> None:
    """After many years all classes are as likely; at once nothing has faded."""
    told = log_probabilities(np.random.default_rng(1))
    np.testing.assert_allclose(faded(told, np.full(SHAPE, 1e5, np.float32)), -math.log(CLASSES), atol=1e-6)
    np.testing.assert_allclose(faded(told, np.zeros(SHAPE, np.float32)), np.maximum(told, FAINTEST), atol=1e-5)


@pytest.mark.parametrize("shape", [(80, 36), (33, 21), (7, 5)])
def test_swaths_of_rows_read_the_same_as_the_whole(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    """However few rows are read at a time, and whatever is left of a coarse pixel at the border."""
    rng = np.random.default_rng(7)
    memory, coarse_pass, reader = a_prior_map(rng, shape), an_observation(rng, shape), a_reader(3)
    whole = fuse(memory, coarse_pass, reader)
    monkeypatch.setattr(prior_map, "ROWS", 8)
    np.testing.assert_allclose(fuse(memory, coarse_pass, reader).log_probability, whole.log_probability, atol=2e-5)


def test_a_reader_sees_means_of_the_pixels_that_are_known() -> None:
    """Of each 2 x 2, be it of a part at the border; NaN of those of which nothing is known, column by column."""
    columns = np.arange(30, dtype=np.float32).reshape(3, 5, 2)
    columns[0, 1], columns[1, 2, 0], columns[:2, 2:4, 1] = np.nan, np.inf, np.nan
    nan = math.nan
    expected = [[[22 / 3, 25 / 3], [26 / 3, nan], [13, 14]], [[21, 22], [25, 26], [28, 29]]]
    np.testing.assert_allclose(pooled(columns), np.array(expected, np.float32), rtol=1e-6)


def test_coarse_looks_that_cannot_be_compared_change_nothing() -> None:
    """Without the coarse pass of before, or where it has no value, today's may be anything."""
    rng = np.random.default_rng(9)
    memory, coarse_pass, reader = a_prior_map(rng), an_observation(rng), a_reader(5)
    other = replace(coarse_pass, coarse=rng.normal(size=coarse_pass.coarse.shape).astype(np.float32))
    blind, nothing = replace(memory, coarse=None), replace(memory, coarse=np.full_like(coarse_pass.coarse, np.nan))
    found = [fuse(one, seen, reader).log_probability for one in (blind, nothing) for seen in (coarse_pass, other)]
    for one in found[1:]:
        np.testing.assert_array_equal(one, found[0])
    assert not np.array_equal(fuse(memory, coarse_pass, reader).log_probability, found[0])


def test_a_fresh_reader_weighs_both_witnesses_by_its_gates() -> None:
    """Untaught: .73 of the memory, .27 of its product to the power .9 with the look to the power .5."""
    rng = np.random.default_rng(2)
    memory, coarse_pass = a_prior_map(rng, days=0.0), an_observation(rng)
    reader = TemporalReader(TemporalSizes(CLASSES, COLUMNS)).eval()
    old, new = (np.exp(one.log_probability.astype(np.float64)) for one in (memory.probabilities, coarse_pass))
    old /= old.sum(axis=-1, keepdims=True)
    product, replaced = old ** (1 / (1 + math.exp(-2.2))) * new**0.5, 1 / (1 + math.e)
    expected = (1 - replaced) * old + replaced * product / product.sum(axis=-1, keepdims=True)
    found = fuse(memory, coarse_pass, reader).log_probability
    np.testing.assert_allclose(np.exp(found), np.maximum(expected, math.exp(FAINTEST)), atol=1e-5)


@given(seed=seeds, order=st.permutations(range(CLASSES)))
def test_classes_find_their_numbers(seed: int, order: list[int]) -> None:
    """Brought to another order and back probabilities are the same, and NaN stays."""
    told = log_probabilities(np.random.default_rng(seed))
    told[0, 0] = np.nan
    there = in_classes(told, order)
    np.testing.assert_allclose(there[1:], told[1:][..., order], atol=1e-6)
    np.testing.assert_allclose(in_classes(there, np.argsort(order).tolist()), told, atol=1e-5)
    assert np.isnan(there[0, 0]).all()


def test_a_removed_class_says_little_of_a_new_one() -> None:
    """Where a class went that was almost certain, no other class is; without a removed one a new one is uniform."""
    before = np.log(np.array([[[0.001, 0.001, 0.998]]], np.float32))
    np.testing.assert_allclose(np.exp(in_classes(before, (0, 1, -1)))[0, 0], [0.25, 0.25, 0.5], atol=1e-3)
    np.testing.assert_allclose(np.exp(in_classes(before, (0, 1)))[0, 0], [0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.exp(in_classes(before, (2, 1, 0, -1)))[0, 0, 3], 0.25 / 1.25, atol=1e-6)


def test_another_field_is_known_by_its_agreement() -> None:
    """The same field agrees with itself; one with its classes drawn anew is another; nothing in common says nothing."""
    rng = np.random.default_rng(11)
    memory = a_prior_map(rng)
    same = CurrentVisit(memory.probabilities.log_probability, np.ones(SHAPE, np.bool_), memory.coarse, 1.0, 1)  # type: ignore[arg-type]
    whole = np.s_[:, :]
    found = compare(memory, same, memory.probabilities, whole)
    assert found.agreement == 1.0
    assert not found.is_of_another_field
    assert compare(memory, an_observation(rng), memory.probabilities, whole).is_of_another_field
    unseen = compare(memory, replace(same, seen=np.zeros(SHAPE, np.bool_)), memory.probabilities, whole)
    assert math.isnan(unseen.agreement)
    assert not unseen.is_of_another_field


def test_a_field_of_one_class_is_no_other_field() -> None:
    """Where everything is one class in memory and look alike chance would agree as well: they agree."""
    told = np.log(np.tile(np.array([0.98, 0.01, 0.01], np.float32), (*SHAPE, 1)))
    coarse_pass = CurrentVisit(told, np.ones(SHAPE, np.bool_), np.zeros((12, 10, COLUMNS), np.float32), 1.0, 1)
    memory = PriorMap(first_probabilities(coarse_pass), None, 1.0)
    assert not compare(memory, coarse_pass, memory.probabilities, np.s_[:, :]).is_of_another_field


def sure_of(classes: NDArray[np.integer], how: float) -> CurrentVisit:
    """A look in detail that gives every pixel of (y, x) its class with the same probability."""
    told = np.full((*classes.shape, CLASSES), (1 - how) / (CLASSES - 1), np.float32)
    np.put_along_axis(told, np.asarray(classes, np.intp)[..., None], how, axis=-1)
    coarse = np.zeros((*(side // CELL_PX for side in classes.shape), COLUMNS), np.float32)
    return CurrentVisit(np.log(told), np.ones(classes.shape, np.bool_), coarse, 0.05, 2)


def test_a_harvest_overnight_is_seen() -> None:
    """Of rows of a crop, two of every five columns, a sure look finds none: soil is drawn, and those rows changed."""
    rows = np.zeros(SHAPE, np.uint8)
    rows[:, np.arange(SHAPE[1]) % 5 < 2] = 1
    before, today = sure_of(rows, 0.99), sure_of(np.zeros(SHAPE, np.uint8), 0.98)
    memory = PriorMap(first_probabilities(before), before.coarse, 1.0)
    after = fuse(memory, today, None)
    assert not after.classes()[0].any()
    found = compare(memory, today, after, np.s_[:, :])
    assert not found.is_of_another_field  # soil between the rows is as it was
    assert found.changed[1, 0] == np.count_nonzero(rows) == found.changed.sum() - np.trace(found.changed)
    np.testing.assert_array_equal(
        changed_fractions(changed_from(memory, after) != UNLABELLED, SceneGrid(*SHAPE, 5)), np.float32(0.4)
    )


def two_maps(seed: int, truth: tuple[NDArray[np.int64], NDArray[np.int64]], noise: float) -> TemporalAgreement:
    """Maps of two days' ground whose confidences are right: noise added to each class's own signal, and Bayes."""
    rng, size = np.random.default_rng(seed), 3

    def look(classes: NDArray[np.int64]) -> NDArray[np.float32]:
        blocks = rng.normal(0, noise, (*(side // 4 for side in classes.shape), size)).repeat(4, 0).repeat(4, 1)
        signal = (np.eye(size)[classes] + blocks) / noise**2  # errors come in blocks of 4 x 4 px
        return np.asarray(signal - np.log(np.exp(signal).sum(axis=-1, keepdims=True)), np.float32)

    before, now = (look(classes) for classes in truth)
    nothing = np.zeros((2, *truth[0].shape), np.float32)
    today = CurrentVisit(now, np.ones(truth[0].shape, np.bool_), np.zeros((1, 1, 1), np.float32), 1.0, 1)
    memory = PriorMap(ClassProbabilities(before, *nothing), None, 1.0)
    return compare(memory, today, ClassProbabilities(now, *nothing), np.s_[:, :])


@pytest.mark.parametrize("noise", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_two_maps_of_the_same_ground_tell_no_change(seed: int, noise: float) -> None:
    """Though up to one pixel in ten differs; the number that differ is the one expected of the confidences."""
    ground = np.random.default_rng(seed).integers(0, 3, (8, 8)).repeat(32, 0).repeat(32, 1)
    found = two_maps(seed, (ground, ground), noise)
    differing = found.changed.sum() - np.trace(found.changed)
    assert differing > 0
    assert differing == pytest.approx(found.expected.sum() - np.trace(found.expected), rel=0.3, abs=100)
    assert found.expected.sum() == pytest.approx(found.changed.sum(), rel=1e-3)
    assert not found.beyond.any()


def test_change_is_told_beyond_what_maps_differ_by() -> None:
    """A felled quarter: from forest to grass, most pixels that both maps are sure of, and no other pair."""
    ground = np.random.default_rng(1).integers(1, 3, (8, 8)).repeat(32, 0).repeat(32, 1)
    ground[:128, :128] = 0
    felled = np.where(ground == 0, 1, ground)
    found = two_maps(2, (ground, felled), 0.45)
    assert 0.8 * found.changed[0, 1] < found.beyond[0, 1] <= found.changed[0, 1]
    assert found.beyond.sum() == found.beyond[0, 1]


def test_a_field_under_snow_is_no_field_that_is_remembered() -> None:
    """Where a look is sure of one class that the memory has nowhere, the memory would only do harm: put aside."""
    rows = np.arange(SHAPE[1]) % 5 < 2
    before, snow = sure_of(np.broadcast_to(rows, SHAPE), 0.99), sure_of(np.full(SHAPE, 2), 0.9)
    memory = PriorMap(first_probabilities(before), before.coarse, 1.0)
    found = compare(memory, snow, fuse(memory, snow, None), np.s_[:, :])
    assert found.agreement == 0
    assert found.is_of_another_field


def test_a_patch_counts_its_pixels_of_another_class() -> None:
    """Sure pixels alone: 8 of 64 of one patch changed, in the next as many that nobody is sure of."""
    sure, other, expected_error = (
        np.log(np.array(one, np.float32)) for one in ([0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.4, 0.5, 0.1])
    )
    before = np.tile(sure, (8, 16, 1))
    now = before.copy()
    now[0, :8], now[0, 8:] = other, expected_error
    memory = PriorMap(ClassProbabilities(before, *np.zeros((2, 8, 16), np.float32)), None, 1.0)
    old = changed_from(memory, ClassProbabilities(now, *np.zeros((2, 8, 16), np.float32)))
    np.testing.assert_array_equal(old, np.where(now.argmax(axis=-1) == 1, np.where(np.arange(16) < 8, 0, 255), 255))
    np.testing.assert_array_equal(changed_fractions(old != UNLABELLED, SceneGrid(8, 16, 8)), [[0.125, 0.0]])


def test_only_captured_pixels_change() -> None:
    """The map of the others is an aged prior map: another class of it is no observation."""
    rng = np.random.default_rng(3)
    told = [np.log(np.where(np.arange(3) == one, 0.98, 0.01)) * np.ones((*SHAPE, 1)) for one in (0, 1)]
    before, after = (ClassProbabilities(one.astype(np.float32), *np.zeros((2, *SHAPE), np.float32)) for one in told)
    seen = rng.random(SHAPE) < 0.5
    aged = replace(after, age_days=np.where(seen, 0, 7).astype(np.float32))
    np.testing.assert_array_equal(changed_from(PriorMap(before, None, 7.0), aged) == 0, seen)


def test_a_patch_over_the_border_counts_its_pixels_on_the_scene() -> None:
    """A field of 20 x 20 px that changed everywhere changed by 1 in all four patches of 16 px."""
    assert (changed_fractions(np.ones((20, 20), np.bool_), SceneGrid(20, 20, 16)) == 1).all()


@READERS
@given(seed=seeds, visits=st.integers(2, 6))
def test_visits_elsewhere_change_nothing(reader: TemporalReader | None, seed: int, visits: int) -> None:
    """What is believed of a pixel after some days is the same, however often others were captured meanwhile."""
    memory = replace(a_prior_map(np.random.default_rng(seed), days=28.0), coarse=None)
    once, probabilities = carried(memory, reader), memory.probabilities
    for _ in range(visits):
        part = PriorMap(probabilities, None, 28.0 / visits)
        shown = carried(part, reader)
        probabilities = as_captured(part, shown)
    np.testing.assert_allclose(shown.log_probability, once.log_probability, atol=1e-3)
    np.testing.assert_allclose(shown.age_days, once.age_days, rtol=1e-5)


def test_each_pixel_has_the_light_of_its_own_lines() -> None:
    """Of lines that were captured again, closer together, more light is known than of the rest."""
    light = np.where(np.arange(SHAPE[1]) < np.full(SHAPE, 7), np.float32(0.8), np.float32(0.00625))
    visit = replace(an_observation(np.random.default_rng(1)), own_light=light)
    for found in (first_probabilities(visit).light, fuse(a_prior_map(np.random.default_rng(2)), visit, None).light):
        assert found[:, :7].min() > 0.79
        assert found[:, 7:].max() < 0.03


@READERS
@given(seed=seeds)
def test_a_memory_that_nobody_looks_at_is_carried(reader: TemporalReader | None, seed: int) -> None:
    """It is what recalling it by a look that sees nothing gives: as sure of itself as before or less, and older."""
    memory = a_prior_map(np.random.default_rng(seed))
    today = carried(memory, reader)
    assert np.allclose(np.exp(today.log_probability).sum(axis=-1), 1, atol=1e-4)
    assert np.array_equal(today.age_days, memory.probabilities.age_days + np.float32(memory.days))
    if reader is None:
        assert (today.log_probability.max(axis=-1) <= memory.probabilities.log_probability.max(axis=-1) + 1e-6).all()
        assert np.array_equal(today.classes()[0], memory.probabilities.classes()[0])
    else:
        assert not np.array_equal(today.log_probability, memory.probabilities.log_probability)
