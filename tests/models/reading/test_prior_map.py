"""The prior map of a field: its fusion with a visit, with and without a temporal reader, and changes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import spectralzoom.models.reading.prior_map as prior_map
from spectralzoom.models.network.sizes import CELL_PX, TemporalSizes
from spectralzoom.models.network.temporal_reader import TemporalReader
from spectralzoom.models.reading.prior_map import (
    ClassProbabilities,
    CurrentVisit,
    PriorMap,
    carried,
    first_probabilities,
    fuse,
)

CLASSES, COLUMNS = 3, 4
SHAPE = (24, 20)
seeds = st.integers(0, 2**16)


def log_probabilities(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> NDArray[np.float32]:
    """Return log-probabilities of classes drawn for each pixel, from sure to unsure."""
    logits = rng.normal(0, 2, (*shape, CLASSES))
    return np.asarray(logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True)), np.float32)


def an_observation(rng: np.random.Generator, shape: tuple[int, int] = SHAPE) -> CurrentVisit:
    """Return a visit that captured a whole field in detail."""
    coarse = rng.normal(size=(*(-(-side // CELL_PX) for side in shape), COLUMNS)).astype(np.float32)
    return CurrentVisit(log_probabilities(rng, shape), np.ones(shape, np.bool_), coarse, 0.05, 2)


def a_prior_map(rng: np.random.Generator, shape: tuple[int, int] = SHAPE, days: float = 3.0) -> PriorMap:
    """Return the prior map that a visit left some days ago."""
    coarse_pass = an_observation(rng, shape)
    return PriorMap(first_probabilities(coarse_pass), coarse_pass.coarse, days)


def a_return(
    seed: int, shape: tuple[int, int] = SHAPE, days: float = 3.0
) -> tuple[np.random.Generator, PriorMap, CurrentVisit]:
    """Return a prior map, the visit some days after it, and the generator that drew both."""
    rng = np.random.default_rng(seed)
    return rng, a_prior_map(rng, shape, days), an_observation(rng, shape)


def a_reader(seed: int = 0) -> TemporalReader:
    """Return a temporal reader with random weights, none of them idle."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        reader = TemporalReader(TemporalSizes(CLASSES, COLUMNS, width=8, coarse_width=4)).eval()
        torch.nn.init.normal_(reader.leave.weight, std=0.3)
    return reader


READERS = pytest.mark.parametrize("reader", [None, a_reader()], ids=["without a reader", "with one"])


def test_exposure_of_visits_adds_up_and_fades() -> None:
    """After 30 days 1/e of the earlier exposure is left; lines 2 px apart give a quarter of theirs."""
    rng = np.random.default_rng(1)
    seen = np.arange(SHAPE[1]) < np.full(SHAPE, 7)
    visit = replace(an_observation(rng), light=0.4, seen=seen)
    after = fuse(a_prior_map(rng, days=30.0), visit, None)
    np.testing.assert_allclose(after.light, 0.0125 / math.e + np.where(seen, 0.1, 0.0), rtol=1e-5)


@READERS
@given(seed=seeds)
def test_fused_probabilities_sum_to_1(reader: TemporalReader | None, seed: int) -> None:
    """Only raising the faintest classes to the stored minimum adds to the sum."""
    rng = np.random.default_rng(seed)
    after = fuse(a_prior_map(rng), an_observation(rng), reader)
    assert after.log_probability.min() >= np.float32(prior_map.FAINTEST)
    total = np.exp(after.log_probability.astype(np.float64)).sum(axis=-1)
    assert total.min() > 1 - 1e-5
    assert total.max() < 1 + CLASSES * math.exp(prior_map.FAINTEST) + 1e-5


@READERS
@given(seed=seeds)
def test_ages_grow_where_pixels_are_not_captured(reader: TemporalReader | None, seed: int) -> None:
    """A captured pixel has age 0; any other is older by the days between."""
    rng, memory, coarse_pass = a_return(seed)
    seen = rng.random(SHAPE) < 0.5
    after = fuse(
        replace(memory, probabilities=replace(memory.probabilities, age_days=np.full(SHAPE, 2.0, np.float32))),
        replace(coarse_pass, seen=seen),
        reader,
    )
    np.testing.assert_array_equal(after.age_days, np.where(seen, 0.0, 5.0).astype(np.float32))


@READERS
@given(seed=seeds)
def test_a_fresh_prior_map_stays_where_pixels_are_not_captured(reader: TemporalReader | None, seed: int) -> None:
    """After 0 days its probabilities are the same but for rounding; captured pixels change."""
    rng, memory, coarse_pass = a_return(seed, days=0.0)
    seen = rng.random(SHAPE) < 0.5
    after = fuse(memory, replace(coarse_pass, seen=seen), reader).log_probability
    before = memory.probabilities.log_probability
    np.testing.assert_allclose(np.exp(after[~seen]), np.exp(before[~seen]), atol=2e-5)
    assert np.abs(np.exp(after[seen]) - np.exp(before[seen])).max() > 0.01
    np.testing.assert_allclose(np.exp(carried(memory, reader).log_probability), np.exp(before), atol=2e-5)


@given(seed=seeds, days=st.floats(0, 0.99))
def test_the_reader_is_phased_in_over_the_first_day(seed: int, days: float) -> None:
    """A pixel that was not captured moves from the prior map to the reader's result in proportion to the time."""
    reader = a_reader(seed)
    memory = a_prior_map(np.random.default_rng(seed), days=days)
    before, after = np.exp(memory.probabilities.log_probability), np.exp(carried(memory, reader).log_probability)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prior_map, "SETTLED_DAYS", 1e-9)
        whole = np.exp(carried(replace(memory, days=max(days, 1e-9)), reader).log_probability)
    np.testing.assert_allclose(after, before + days * (whole - before), atol=3e-5)


@READERS
def test_unknown_pixels_take_the_other_source(reader: TemporalReader | None) -> None:
    """A visit fills an empty prior map, and the other way round; a pixel that is empty in both stays unknown."""
    _, memory, coarse_pass = a_return(4)
    before, today = memory.probabilities.log_probability.copy(), coarse_pass.log_probability.copy()
    before[:8], today[4:12] = np.nan, np.nan
    ages = np.where(np.isnan(before[..., 0]), np.nan, 0.0).astype(np.float32)
    after = fuse(
        replace(memory, probabilities=ClassProbabilities(before, ages, np.ones(SHAPE, np.float32))),
        replace(coarse_pass, log_probability=today),
        reader,
    )
    np.testing.assert_array_equal(after.log_probability[:4], np.maximum(today[:4], np.float32(prior_map.FAINTEST)))
    assert np.isnan(after.log_probability[4:8]).all()
    assert np.isnan(after.age_days[4:8]).all()
    assert np.isfinite(after.log_probability[8:]).all()
    assert (after.classes()[0][4:8] == 255).all()


def test_a_confident_visit_overrules_the_prior_map() -> None:
    """Without a reader 0.99 for another class wins over 0.9, and 0.6 does not; two that agree are surer together."""
    before = np.log(np.array([[[0.9, 0.05, 0.05]] * 3], np.float32))
    today = np.log(np.array([[[0.005, 0.99, 0.005], [0.2, 0.6, 0.2], [0.8, 0.1, 0.1]]], np.float32))
    visit = CurrentVisit(today, np.ones((1, 3), np.bool_), np.zeros((1, 1, COLUMNS), np.float32), 1.0, 1)
    after = fuse(PriorMap(first_probabilities(replace(visit, log_probability=before)), None, 0.0), visit, None)
    assert after.classes()[0].tolist() == [[1, 0, 0]]
    assert after.classes()[1][0, 2] == pytest.approx(0.9 * 0.8 / (0.9 * 0.8 + 2 * 0.05 * 0.1))


def test_a_prior_map_fades_to_equal_probabilities() -> None:
    """After many years all classes are equally likely; after 0 days nothing has faded."""
    told = log_probabilities(np.random.default_rng(1))
    np.testing.assert_allclose(prior_map.faded(told, np.full(SHAPE, 1e5, np.float32)), -math.log(CLASSES), atol=1e-6)
    np.testing.assert_allclose(
        prior_map.faded(told, np.zeros(SHAPE, np.float32)), np.maximum(told, prior_map.FAINTEST), atol=1e-5
    )


@pytest.mark.parametrize("shape", [(80, 36), (33, 21), (7, 5)])
def test_row_blocks_are_fused_like_the_whole(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    """The field is read 8 rows at a time, and its border may cut a coarse pixel."""
    _, memory, coarse_pass = a_return(7, shape)
    reader = a_reader(3)
    whole = fuse(memory, coarse_pass, reader)
    monkeypatch.setattr(prior_map, "ROWS", 8)
    np.testing.assert_allclose(fuse(memory, coarse_pass, reader).log_probability, whole.log_probability, atol=2e-5)


def test_pooled_columns_are_means_of_known_pixels() -> None:
    """Each 2 x 2 block is averaged, also partial ones at the border; a column without a known pixel is NaN."""
    columns = np.arange(30, dtype=np.float32).reshape(3, 5, 2)
    columns[0, 1], columns[1, 2, 0], columns[:2, 2:4, 1] = np.nan, np.inf, np.nan
    expected = [[[22 / 3, 25 / 3], [26 / 3, math.nan], [13, 14]], [[21, 22], [25, 26], [28, 29]]]
    np.testing.assert_allclose(prior_map.pooled(columns), np.array(expected, np.float32), rtol=1e-6)


def test_coarse_columns_without_a_counterpart_are_ignored() -> None:
    """Without the earlier coarse columns, or where they are NaN, those of the current visit may be anything."""
    rng, memory, coarse_pass = a_return(9)
    reader = a_reader(5)
    other = replace(coarse_pass, coarse=rng.normal(size=coarse_pass.coarse.shape).astype(np.float32))
    blind, nothing = replace(memory, coarse=None), replace(memory, coarse=np.full_like(coarse_pass.coarse, np.nan))
    found = [fuse(one, seen, reader).log_probability for one in (blind, nothing) for seen in (coarse_pass, other)]
    for one in found[1:]:
        np.testing.assert_array_equal(one, found[0])
    assert not np.array_equal(fuse(memory, coarse_pass, reader).log_probability, found[0])


def test_an_untrained_reader_weighs_both_sources_by_its_gates() -> None:
    """The result is .73 of the prior map, and .27 of its product to the power .9 with the visit to the power .5."""
    _, memory, coarse_pass = a_return(2, days=0.0)
    old, new = (np.exp(one.log_probability.astype(np.float64)) for one in (memory.probabilities, coarse_pass))
    old /= old.sum(axis=-1, keepdims=True)
    product, replaced = old ** (1 / (1 + math.exp(-2.2))) * new**0.5, 1 / (1 + math.e)
    expected = (1 - replaced) * old + replaced * product / product.sum(axis=-1, keepdims=True)
    found = fuse(memory, coarse_pass, TemporalReader(TemporalSizes(CLASSES, COLUMNS)).eval()).log_probability
    np.testing.assert_allclose(np.exp(found), np.maximum(expected, math.exp(prior_map.FAINTEST)), atol=1e-5)


@given(seed=seeds, order=st.permutations(range(CLASSES)))
def test_reordering_classes_and_back_changes_nothing(seed: int, order: list[int]) -> None:
    """Probabilities move with their classes, and NaN stays."""
    told = log_probabilities(np.random.default_rng(seed))
    told[0, 0] = np.nan
    there = prior_map.in_classes(told, order)
    np.testing.assert_allclose(there[1:], told[1:][..., order], atol=1e-6)
    np.testing.assert_allclose(prior_map.in_classes(there, np.argsort(order).tolist()), told, atol=1e-5)
    assert np.isnan(there[0, 0]).all()


def test_a_removed_class_leaves_the_others_uncertain() -> None:
    """A removed class of 0.998 does not make another certain; with none removed, a new class starts uniform."""
    before = np.log(np.array([[[0.001, 0.001, 0.998]]], np.float32))
    np.testing.assert_allclose(np.exp(prior_map.in_classes(before, (0, 1, -1)))[0, 0], [0.25, 0.25, 0.5], atol=1e-3)
    np.testing.assert_allclose(np.exp(prior_map.in_classes(before, (0, 1)))[0, 0], [0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.exp(prior_map.in_classes(before, (2, 1, 0, -1)))[0, 0, 3], 0.25 / 1.25, atol=1e-6)


def sure_of(classes: NDArray[np.integer], how: float) -> CurrentVisit:
    """Return a visit in detail that gives every pixel of (y, x) its class with the same probability."""
    told = np.full((*classes.shape, CLASSES), (1 - how) / (CLASSES - 1), np.float32)
    np.put_along_axis(told, np.asarray(classes, np.intp)[..., None], how, axis=-1)
    coarse = np.zeros((*(side // CELL_PX for side in classes.shape), COLUMNS), np.float32)
    return CurrentVisit(np.log(told), np.ones(classes.shape, np.bool_), coarse, 0.05, 2)


def test_a_harvest_overnight_is_detected() -> None:
    """A confident visit finds soil in two of every five columns, where a crop was: exactly these pixels changed."""
    rows = np.zeros(SHAPE, np.uint8)
    rows[:, np.arange(SHAPE[1]) % 5 < 2] = 1
    before, today = sure_of(rows, 0.99), sure_of(np.zeros(SHAPE, np.uint8), 0.98)
    memory = PriorMap(first_probabilities(before), before.coarse, 1.0)
    after = fuse(memory, today, None)
    assert not after.classes()[0].any()
    found = prior_map.compare(memory, today, after, np.s_[:, :])
    assert found.changed[1, 0] == np.count_nonzero(rows) == found.changed.sum() - np.trace(found.changed)
    np.testing.assert_array_equal(prior_map.changed_from(memory, after), np.where(rows == 1, 1, 255))


def two_maps(seed: int, truth: tuple[NDArray[np.int64], ...], noise: float) -> prior_map.TemporalAgreement:
    """Compare maps of two days whose confidences are right: each class's own signal plus noise, and Bayes."""
    rng = np.random.default_rng(seed)
    size = 3

    def look(classes: NDArray[np.int64]) -> NDArray[np.float32]:
        blocks = rng.normal(0, noise, (*(side // 4 for side in classes.shape), size)).repeat(4, 0).repeat(4, 1)
        signal = (np.eye(size)[classes] + blocks) / noise**2  # errors come in blocks of 4 x 4 px
        return np.asarray(signal - np.log(np.exp(signal).sum(axis=-1, keepdims=True)), np.float32)

    before, now = (look(classes) for classes in truth)
    nothing = np.zeros((2, *truth[0].shape), np.float32)
    today = CurrentVisit(now, np.ones(truth[0].shape, np.bool_), np.zeros((1, 1, 1), np.float32), 1.0, 1)
    memory = PriorMap(ClassProbabilities(before, *nothing), None, 1.0)
    return prior_map.compare(memory, today, ClassProbabilities(now, *nothing), np.s_[:, :])


@pytest.mark.parametrize("noise", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_two_maps_of_the_same_ground_show_no_change(seed: int, noise: float) -> None:
    """Up to one pixel in ten differs, about as many as the confidences let expect."""
    ground = np.random.default_rng(seed).integers(0, 3, (8, 8)).repeat(32, 0).repeat(32, 1)
    found = two_maps(seed, (ground, ground), noise)
    differing = found.changed.sum() - np.trace(found.changed)
    assert differing > 0
    assert differing == pytest.approx(found.expected.sum() - np.trace(found.expected), rel=0.3, abs=100)
    assert found.expected.sum() == pytest.approx(found.changed.sum(), rel=1e-3)
    assert not found.beyond.any()


def test_change_is_reported_beyond_expected_differences() -> None:
    """In a felled quarter, 80 % or more of the pixels that went from forest to grass are reported, and no others."""
    ground = np.random.default_rng(1).integers(1, 3, (8, 8)).repeat(32, 0).repeat(32, 1)
    ground[:128, :128] = 0
    felled = np.where(ground == 0, 1, ground)
    found = two_maps(2, (ground, felled), 0.45)
    assert 0.8 * found.changed[0, 1] < found.beyond[0, 1] <= found.changed[0, 1]
    assert found.beyond.sum() == found.beyond[0, 1]


def test_only_confident_pixels_change() -> None:
    """8 pixels changed; as many beside them are unsure and do not count."""
    sure, other, unsure = np.log(np.array([[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.4, 0.5, 0.1]], np.float32))
    before = np.tile(sure, (8, 16, 1))
    now = before.copy()
    now[0, :8], now[0, 8:] = other, unsure
    memory = PriorMap(ClassProbabilities(before, *np.zeros((2, 8, 16), np.float32)), None, 1.0)
    old = prior_map.changed_from(memory, ClassProbabilities(now, *np.zeros((2, 8, 16), np.float32)))
    np.testing.assert_array_equal(old, np.where(now.argmax(axis=-1) == 1, np.where(np.arange(16) < 8, 0, 255), 255))


def test_only_captured_pixels_change() -> None:
    """The map of the others is an aged prior map, so another class there is no observation."""
    told = [np.log(np.where(np.arange(3) == one, 0.98, 0.01)) * np.ones((*SHAPE, 1)) for one in (0, 1)]
    before, after = (ClassProbabilities(one.astype(np.float32), *np.zeros((2, *SHAPE), np.float32)) for one in told)
    seen = np.random.default_rng(3).random(SHAPE) < 0.5
    aged = replace(after, age_days=np.where(seen, 0, 7).astype(np.float32))
    np.testing.assert_array_equal(prior_map.changed_from(PriorMap(before, None, 7.0), aged) == 0, seen)


@READERS
@given(seed=seeds, visits=st.integers(2, 6))
def test_visits_elsewhere_do_not_change_a_pixel(reader: TemporalReader | None, seed: int, visits: int) -> None:
    """Probabilities after 28 days are the same, however often other pixels were captured meanwhile."""
    memory = replace(a_prior_map(np.random.default_rng(seed), days=28.0), coarse=None)
    once = carried(memory, reader)
    probabilities = memory.probabilities
    for _ in range(visits):
        part = PriorMap(probabilities, None, 28.0 / visits)
        shown = carried(part, reader)
        probabilities = prior_map.as_captured(part, shown)
    np.testing.assert_allclose(shown.log_probability, once.log_probability, atol=1e-3)
    np.testing.assert_allclose(shown.age_days, once.age_days, rtol=1e-5)


def test_each_pixel_has_the_light_of_its_own_lines() -> None:
    """Pixels of lines that were captured again, closer together, have more light than the rest."""
    light = np.where(np.arange(SHAPE[1]) < np.full(SHAPE, 7), np.float32(0.8), np.float32(0.00625))
    visit = replace(an_observation(np.random.default_rng(1)), own_light=light)
    for found in (first_probabilities(visit).light, fuse(a_prior_map(np.random.default_rng(2)), visit, None).light):
        assert found[:, :7].min() > 0.79
        assert found[:, 7:].max() < 0.03


@READERS
@given(seed=seeds)
def test_a_prior_map_without_a_visit_is_carried(reader: TemporalReader | None, seed: int) -> None:
    """The prior map gets older; without a reader it keeps its classes and does not gain confidence."""
    memory = a_prior_map(np.random.default_rng(seed))
    today = carried(memory, reader)
    assert np.allclose(np.exp(today.log_probability).sum(axis=-1), 1, atol=1e-4)
    assert np.array_equal(today.age_days, memory.probabilities.age_days + np.float32(memory.days))
    if reader is None:
        assert (today.log_probability.max(axis=-1) <= memory.probabilities.log_probability.max(axis=-1) + 1e-6).all()
        assert np.array_equal(today.classes()[0], memory.probabilities.classes()[0])
    else:
        assert not np.array_equal(today.log_probability, memory.probabilities.log_probability)
