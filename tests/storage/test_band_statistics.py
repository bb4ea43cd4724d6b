"""Statistics of bands: any splitting gives the same, nothing cancels, percentiles within a bin, every crew alike."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from pipeline.errors import IncompleteStoreError, ShapeError
from storage.arrays.mosaics import MosaicWriter
from storage.band_statistics import (
    PERCENTILES,
    BandPart,
    Strip,
    _InOrder,
    cube_stores,
    plan_strips,
    product_statistics,
    tabulate,
)
from storage.cube_sources import CubeSource, LineFacts
from storage.ingested_cubes import write_ingested_cube
from storage.parallel.crew import Crew
from storage.value_bins import RELATIVE_WIDTH, bins_of, edges_of

SHAPE = (150, 700, 4)
NM = np.array([500.0, 600.0, 700.0, 800.0])


def in_pieces(values: np.ndarray, cuts: list[int]) -> BandPart:
    """The statistics of rows cut apart and merged again."""
    edges = [0, *sorted(cut % (len(values) + 1) for cut in cuts), len(values)]
    total = BandPart.of(values[:0])
    for first, stop in pairwise(edges):
        total = total.merged(BandPart.of(values[first:stop]))
    return total


@settings(max_examples=150, deadline=None)
@given(
    values=arrays(
        np.float32, array_shapes(min_dims=2, max_dims=2, max_side=40),
        elements=st.floats(-(2.0**20), 2.0**20, width=32) | st.sampled_from([np.nan, np.inf, 0.0, -0.0]),
    ),
    offset=st.sampled_from([0.0, 1e-3, 1e6]), cuts=st.lists(st.integers(0, 1000), max_size=6),
)  # fmt: skip
def test_any_splitting_gives_the_same(values: np.ndarray, offset: float, cuts: list[int]) -> None:
    """However pixels are cut into parts, every figure is that of the whole, within 1e-12; counts are exact."""
    values = values * np.float32(1e-3) + np.float32(offset)
    whole, merged = (tabulate(part, NM) for part in (BandPart.of(values), in_pieces(values, cuts)))
    np.testing.assert_array_equal(whole.finite, merged.finite)
    assert whole.pixels == merged.pixels == len(values)
    for name in ("low", "high"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(merged, name))
    for percent in PERCENTILES:
        np.testing.assert_array_equal(whole.percentiles[percent], merged.percentiles[percent])
    np.testing.assert_allclose(merged.std, whole.std, rtol=1e-12, atol=0)
    largest = np.nan_to_num(np.maximum(np.abs(whole.low), np.abs(whole.high)))
    assert (np.abs(np.nan_to_num(merged.mean - whole.mean)) <= 1e-12 * largest).all()


def test_figures_are_those_of_numpy() -> None:
    """Count, extremes, mean and spread of noise with gaps are what NumPy gives of the finite values."""
    rng = np.random.default_rng(2)
    values = rng.lognormal(0, 1, (60, 50, 3)).astype(np.float32)
    values[rng.random(values.shape) < 0.1] = np.nan
    values[..., 2] = np.nan
    found = tabulate(BandPart.of(values), NM)
    kept = values[..., :2].astype(np.float64)
    np.testing.assert_array_equal(found.finite, np.isfinite(values).sum(axis=(0, 1)))
    for name, function in (("low", np.nanmin), ("high", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        np.testing.assert_allclose(getattr(found, name)[:2], function(kept, axis=(0, 1)), rtol=1e-13)
        assert np.isnan(getattr(found, name)[2])
    assert all(np.isnan(one[2]) for one in found.percentiles.values())


def test_nothing_cancels_far_from_zero() -> None:
    """A spread of one unit in the last place beside a mean of ten million is found to 12 digits."""
    values = np.where(np.arange(10_000) % 2, 2.0**24, 2.0**24 + 2).astype(np.float32)[:, None]
    assert tabulate(in_pieces(values, [17, 5000, 5001]), NM).std[0] == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("spread", [1e-6, 0.3, 3.0])
def test_percentiles_are_within_a_bin(spread: float) -> None:
    """Over any range, a percentile is within 1/512 of the values on either side of its rank."""
    values = (np.random.default_rng(4).standard_normal(5001) * np.exp(spread)).astype(np.float32)[:, None]
    found = tabulate(in_pieces(values, [100, 3000]), NM)
    for percent in PERCENTILES:
        below, above = (np.percentile(values, percent, method=method) for method in ("lower", "higher"))
        width = RELATIVE_WIDTH * max(abs(below), abs(above))
        assert below - width <= found.percentiles[percent][0] <= above + width


def test_bins_keep_the_order_of_values() -> None:
    """Bins rise with values through zero, each value lies in its own, and none is wider than 1/512 of it."""
    values = np.sort(np.random.default_rng(5).standard_normal(1000).astype(np.float32) ** 5)
    bins = bins_of(values)
    assert (np.diff(bins) >= 0).all()
    low, high = edges_of(bins), edges_of(bins + 1)
    assert ((low <= values) & (values <= high)).all()
    assert (high - low <= RELATIVE_WIDTH * np.maximum(np.abs(low), np.abs(high))).all()


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stored mosaic of 3 x 2 shards with a corner that no line reached."""
    path = tmp_path_factory.mktemp("mosaic") / "mosaic.zarr"
    values = np.random.default_rng(6).normal(0.3, 0.1, SHAPE).astype(np.float32)
    values[:70, :100] = np.nan
    MosaicWriter(path, SHAPE[:2], NM).write_rows(0, values, np.ones(SHAPE[:2], np.float32))
    return path


@pytest.fixture(scope="module")
def processes() -> Iterator[Crew]:
    """Two worker processes for all tests here."""
    with Crew("processes", 2).open() as crew:
        yield crew


def test_every_crew_finds_the_same(mosaic: Path, processes: Crew) -> None:
    """One thread, three, or two processes: the same figures to the last bit, a task for each row of shards."""
    shares: list[float] = []
    found = [
        product_statistics([mosaic], crew, report=shares.append)
        for crew in (Crew(workers=1), Crew(workers=3), processes)
    ]
    for other in found[1:]:
        for name in ("finite", "low", "high", "mean", "std"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))
    assert len(shares) == 3 * len(plan_strips(mosaic)) == 9
    assert found[0].finite.tolist() == [150 * 700 - 70 * 100] * 4


def test_the_last_digit_does_not_depend_on_who_was_faster() -> None:
    """Strips are merged in their order, in whatever order they end."""
    rng = np.random.default_rng(7)
    parts = [BandPart.of(rng.normal(10**number, 1, (17, 4))) for number in range(9)]
    found = set()
    for order in (range(9), reversed(range(9)), rng.permutation(9)):
        merged = _InOrder(4)
        for number in order:
            merged.take(Strip(Path(), "values", 0, 0, int(number)), parts[number])
        table = tabulate(merged.total, NM)
        found.add(table.mean.tobytes() + table.std.tobytes())
    assert len(found) == 1


def test_several_stores_count_together(mosaic: Path) -> None:
    """The sweeps of a capture are one product: pixels add up, and bands must be the same."""
    assert product_statistics([mosaic, mosaic]).pixels == 2 * SHAPE[0] * SHAPE[1]
    other = mosaic.with_name("other.zarr")
    MosaicWriter(other, (8, 8), NM + 1)
    with pytest.raises(ShapeError, match=r"other.zarr has other bands than .*mosaic.zarr; ask for them one by one"):
        product_statistics([mosaic, other])


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_lines_that_a_file_did_not_hold_do_not_count(tmp_path: Path, kind: type[np.generic]) -> None:
    """An ingested cube marks them, and has zeros there where there is no NaN; its wavelengths may not be known."""
    values = np.full((70, 50, 3), 1000, kind)
    valid = np.arange(70) < 60
    source = CubeSource("a.npy", values.shape, values.dtype, lambda a, b: values[a:b], (), LineFacts(valid))
    write_ingested_cube(tmp_path, source, [], name="a")
    found = product_statistics(cube_stores(tmp_path))
    assert (found.low.tolist(), found.mean.tolist()) == ([1000.0] * 3, [1000.0] * 3)
    assert (found.finite.tolist(), found.pixels) == ([60 * 50] * 3, 70 * 50)
    assert np.isnan(found.wavelength_nm).all()
    assert product_statistics(2 * cube_stores(tmp_path)).pixels == 2 * found.pixels


def test_what_is_no_cube_is_refused(mosaic: Path, tmp_path: Path) -> None:
    """A name that is none, an array without bands and a folder without a store say what is there."""
    with pytest.raises(ShapeError, match=r"has no array 'coverage' of three axes.* there are: values"):
        product_statistics([mosaic], array="coverage")
    with pytest.raises(ShapeError, match="at least one store"):
        product_statistics([])
    with pytest.raises(IncompleteStoreError, match="no readable Zarr store"):
        product_statistics([tmp_path])
