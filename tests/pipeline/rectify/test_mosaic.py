"""Mosaics: weights of overlaps, pixels from simulated sweeps, and the cache of lines."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.rectify.mosaic import MosaicPart, edge_distance, mosaic
from spectralzoom.pipeline.signal.lines import LineCache

LINES, SAMPLES, BANDS = 300, 100, 2


def part(seed: int, points: int = 20, bands: int = 4) -> MosaicPart:
    """Return a part of random values; points that it does not reach are NaN."""
    rng = np.random.default_rng(seed)
    values, weight = rng.random((points, bands), np.float32), rng.random(points).astype(np.float32)
    weight[rng.random(points) < 0.3] = 0
    values[weight == 0] = np.nan
    return MosaicPart(values, weight, np.where(weight > 0, rng.uniform(0, 300, points), np.nan))


def test_a_mosaic_of_one_sweep_equals_the_sweep() -> None:
    """The values are equal bit for bit, and points with a weight count 1."""
    alone = part(1)
    values, coverage = mosaic([alone])
    np.testing.assert_array_equal(values, alone.values)
    assert (coverage == (alone.weight > 0)).all()


@given(st.lists(st.integers(0, 10_000), min_size=1, max_size=4))
@settings(max_examples=20, deadline=None)
def test_blended_spectra_lie_between_their_sources(seeds: list[int]) -> None:
    """Every value lies between the values of the sweeps. Exactly the points that no sweep reaches are NaN."""
    parts = [part(seed) for seed in seeds]
    values, coverage = mosaic(parts)
    assert (np.isnan(values).any(axis=1) == (coverage == 0)).all()
    seen = np.stack([p.values for p in parts])[:, coverage > 0]
    assert (values[coverage > 0] <= np.nanmax(seen, axis=0) + 1e-6).all()
    assert (values[coverage > 0] >= np.nanmin(seen, axis=0) - 1e-6).all()


@pytest.mark.parametrize(
    ("weight", "edge_px", "fraction"), [((1, 1), (30.0, 10.0), 0.75), ((0.8, 1), (20.0, 20.0), 0.8 / 1.8)]
)
def test_weights_combine_resampling_and_edge_distance(weight: tuple, edge_px: tuple, fraction: float) -> None:
    """A point counts by its distance to the sweep's edge and by the valid fraction of its kernel."""
    ones, zeros = np.ones((1, 2), np.float32), np.zeros((1, 2), np.float32)
    parts = [
        MosaicPart(values, np.array([of], np.float32), np.array([edge]))
        for values, of, edge in zip((ones, zeros), weight, edge_px, strict=True)
    ]
    values, coverage = mosaic(parts)
    np.testing.assert_allclose(values, fraction, rtol=1e-6)
    assert coverage.tolist() == [2]


def test_a_band_missing_in_one_sweep_is_taken_from_the_other() -> None:
    """If one sweep lacks a band (a dead pixel), the other alone counts in it. If both do, it stays NaN."""
    one, other = np.ones((1, 3), np.float32), np.full((1, 3), 3, np.float32)
    one[0, 1:], other[0, 2] = np.nan, np.nan
    full = np.ones(1, np.float32)
    edge = np.array([20.0])
    values, coverage = mosaic([MosaicPart(one, full, edge), MosaicPart(other, full, edge)])
    np.testing.assert_array_equal(values[0], [2, 3, np.nan])
    assert coverage.tolist() == [2]


def test_a_single_point_is_blended_as_among_many() -> None:
    """One point of one band in 12 sweeps, some without a value, has the same bits as in a block of 40 points."""
    rng = np.random.default_rng(5)
    full = np.ones(40, np.float32)
    parts = [
        MosaicPart(
            np.where(rng.random((40, 1)) < 0.3, np.nan, rng.random((40, 1))).astype(np.float32),
            full,
            rng.uniform(0, 300, 40),
        )
        for _ in range(12)
    ]
    alone = [
        mosaic([MosaicPart(one.values[[at]], one.weight[[at]], one.edge_px[[at]]) for one in parts])[0]
        for at in range(40)
    ]
    np.testing.assert_array_equal(np.concatenate(alone), mosaic(parts)[0])


def test_closer_lines_count_only_where_they_reach() -> None:
    """Lines of 1 px replace those of 4 px at the first point; at the second the former have no value."""
    edge = np.full(2, 20.0)
    far = MosaicPart(np.full((2, 1), 4, np.float32), np.ones(2, np.float32), edge, step=4)
    near = MosaicPart(np.array([[1], [np.nan]], np.float32), np.array([1, 0], np.float32), edge, step=1)
    for parts in ([far, near], [near, far]):
        values, coverage = mosaic(parts)
        assert values.tolist() == [[1], [4]]
        assert coverage.tolist() == [1, 1]


def test_a_point_on_the_edge_counts_if_it_is_alone() -> None:
    """A point exactly on a sweep's edge keeps its value. On the edges of two sweeps it has their mean."""
    values, coverage = mosaic([MosaicPart(np.full((1, 1), 7, np.float32), np.ones(1, np.float32), np.zeros(1))])
    assert values[0, 0] == 7
    assert coverage[0] == 1
    parts = [MosaicPart(np.full((1, 1), level, np.float32), np.ones(1, np.float32), np.zeros(1)) for level in (2, 4)]
    assert mosaic(parts)[0].tolist() == [[3]]


def test_edge_distance_is_that_to_the_nearest_border() -> None:
    """Distances count to the outer edge of the outermost pixels. NaN stays NaN."""
    at = np.array([[0.0, 100], [50, 0], [99, 100], [50, 639.5], [50, 300], [np.nan, np.nan]])
    np.testing.assert_allclose(edge_distance(at, 100, 640), [0.5, 0.5, 0.5, 0, 49.5, np.nan])


CAMERA = LineCamera()


class Numbered:
    """Lines of consecutive numbers that record their reads, with an optional delay."""

    valid_line = np.ones(LINES, np.bool_)
    references = SimpleNamespace(dark=np.zeros((SAMPLES, BANDS), np.float32))
    raw = np.arange(LINES * SAMPLES * BANDS, dtype=np.uint32).astype(np.uint16).reshape(LINES, SAMPLES, BANDS)

    def __init__(self, delay_s: float = 0.0) -> None:
        self.delay_s = delay_s
        self.asked: list[tuple[int, int]] = []

    def read(self, start: int, stop: int, samples: slice) -> np.ndarray:
        """Return samples of some lines."""
        time.sleep(self.delay_s)
        self.asked.append((start, stop))
        return self.raw[start:stop, samples]


@given(st.integers(0, LINES - 1), st.integers(1, LINES), st.integers(0, SAMPLES - 1), st.integers(1, SAMPLES))
@settings(max_examples=20, deadline=None)
def test_a_window_is_its_part_of_the_lines(first: int, count: int, left: int, width: int) -> None:
    """Any range of lines and samples is returned unchanged, over any number of blocks."""
    lines = Numbered()
    wanted, samples = slice(first, min(first + count, LINES)), slice(left, min(left + width, SAMPLES))
    window = LineCache(0).window(lines, wanted, samples)  # type: ignore[arg-type]
    np.testing.assert_array_equal(window, lines.raw[wanted, samples])


def test_a_block_that_is_being_read_stays_in_the_cache() -> None:
    """While one thread reads a block, another one fills the full cache: both get their lines."""
    started, go = threading.Event(), threading.Event()

    class Held(Numbered):
        def read(self, start: int, stop: int, samples: slice) -> np.ndarray:
            if start == 0:
                started.set()
                go.wait(10)
            return super().read(start, stop, samples)

    lines = Held()
    cache = LineCache(0)
    got: list[np.ndarray] = []
    slow = threading.Thread(target=lambda: got.append(cache.window(lines, slice(0, 4), slice(0, 4))))  # type: ignore[arg-type]
    slow.start()
    assert started.wait(10)
    try:
        other = cache.window(lines, slice(70, 74), slice(0, 4))  # type: ignore[arg-type]
    finally:
        go.set()
        slow.join()
    np.testing.assert_array_equal(other, lines.raw[70:74, :4])
    np.testing.assert_array_equal(got[0], lines.raw[:4, :4])


def test_threads_share_one_read() -> None:
    """Eight threads that request the same block at once cause one read, and all get the lines."""
    lines = Numbered(delay_s=0.05)
    cache = LineCache(2**20)
    got: list[np.ndarray] = []
    threads = [
        threading.Thread(target=lambda: got.append(cache.window(lines, slice(70, 80), slice(0, 9))))  # type: ignore[arg-type]
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lines.asked == [(64, 128)]
    assert all((window == lines.raw[70:80, :9]).all() for window in got)
    assert len(got) == 8


def test_a_failed_read_is_retried() -> None:
    """The error reaches the caller and is not cached, so the next request reads again."""
    lines = Numbered()
    cache = LineCache(2**20)
    whole = lines.raw
    lines.raw = None  # type: ignore[assignment]
    try:
        cache.window(lines, slice(0, 4), slice(0, 4))  # type: ignore[arg-type]
    except TypeError:
        lines.raw = whole
    np.testing.assert_array_equal(cache.window(lines, slice(0, 4), slice(0, 4)), whole[:4, :4])  # type: ignore[arg-type]
