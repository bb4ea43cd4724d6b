"""Tiles: pixels do not depend on the division of a grid into tiles, and lines are read once."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep, line_positions
from spectralzoom.pipeline.rectify.kernels import kernel_taps
from spectralzoom.pipeline.rectify.mosaic import cut_runs
from spectralzoom.pipeline.rectify.placed import PixelGrid, PlacedSweep, ScanPathReach, place
from spectralzoom.pipeline.rectify.region import cache_bytes, mosaic_tile, plan_tiles
from spectralzoom.pipeline.signal.lines import LineCache
from spectralzoom.pipeline.source import References

CAMERA = LineCamera(samples=160)
TURNED = Sweep("turned", "fine", "x", -4700.0, 2990.0, 200)  # lines lie at about 30 degrees to the grid's rows
CORNER = (3040.0, -4760.0)


@dataclass(frozen=True)
class Taken:
    """A sweep of random numbers in memory that records its reads."""

    sweep: Sweep
    raw: NDArray[np.uint16]
    references: References
    valid_line: NDArray[np.bool_]
    position: NDArray[np.float64]
    asked: list[tuple[int, ...]] = field(default_factory=list)

    @property
    def exposure_ms(self) -> NDArray[np.float64]:
        """Return the exposures of the camera."""
        return np.full(len(self.raw), CAMERA.exposure_ms)

    def read(self, start: int, stop: int, samples: slice = slice(None)) -> NDArray[np.uint16]:
        """Return samples of some lines."""
        self.asked.append((start, stop, samples.start, samples.stop))
        return self.raw[start:stop, samples]


def taken(sweep: Sweep, *, bands: int = 3, seed: int = 0, faults: bool = False) -> Taken:
    """Return a sweep of noise; with ``faults`` also with dead lines and saturated and bad elements."""
    rng = np.random.default_rng(seed)
    raw = rng.integers(100, 3000, (sweep.lines, CAMERA.samples, bands)).astype(np.uint16)
    frame = (CAMERA.samples, bands)
    references = References(np.zeros(frame, np.float32), np.ones(frame, np.float32), np.ones(bands, np.float32))
    valid = np.ones(sweep.lines, np.bool_)
    if faults:
        raw[rng.random(raw.shape) < 0.002] = CAMERA.full_scale_dn
        bad = rng.random(frame) < 0.02
        bad[:, 1] |= np.arange(CAMERA.samples) % 20 < 5
        white = rng.uniform(500, 4000, frame).astype(np.float32)
        references = replace(references, bad=bad, by_mirror=True, white=white)
        valid = rng.random(sweep.lines) > 0.02
    return Taken(sweep, raw, references, valid, line_positions(sweep, CAMERA))


def in_tiles(
    placed: list[PlacedSweep], grid: PixelGrid, shape: tuple[int, int], cache: LineCache | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid's values and coverage, computed in tiles of this shape."""
    values = np.zeros((*grid.shape, len(placed[0].lines.references.white_reference)), np.float32)
    coverage = np.zeros(grid.shape, np.intp)
    for tile in plan_tiles(placed, CAMERA, grid, shape):
        at = tile.rows, tile.columns
        values[at], coverage[at] = mosaic_tile(placed, CAMERA, grid, *at, cache=cache, reach=tile.reach)
    return values, coverage


def two_turned(grid: PixelGrid | None) -> list[PlacedSweep]:
    """Return two overlapping sweeps of turned lines with all kinds of faults, one with a partly lit slit."""
    sweep = replace(TURNED, name="other", swath_px=-4600.0, start_px=3010.0)
    other = taken(sweep, seed=1, faults=True)
    sample, band = np.mgrid[: CAMERA.samples, : other.raw.shape[2]]
    white = other.references.white.copy()  # as real ones: each band is unlit somewhere, most in one part of the slit
    white[(sample + 20 * band) % 60 < 15] = 0
    white[40:120, 1:] = 0
    gain = np.array([1.0, 0.9, 1.1], np.float32)
    return [
        place(taken(TURNED, faults=True), CAMERA, grid=grid, gain=gain),
        place(replace(other, references=replace(other.references, white=white)), CAMERA, grid=grid),
    ]


@given(st.tuples(st.integers(5, 60), st.integers(5, 110)), st.booleans(), st.booleans())
@settings(max_examples=4, deadline=None)
def test_any_tiling_gives_the_same_bits(shape: tuple[int, int], tied: bool, cached: bool) -> None:
    """Turned lines, an overlap, dead lines, bad and unlit elements: every tiling equals a single tile."""
    grid = PixelGrid(CORNER, 1, (60, 110))
    placed = two_turned(grid if tied else None)
    whole, coverage = in_tiles(placed, grid, grid.shape)
    assert set(np.unique(coverage)) == {0, 1, 2}
    parts = in_tiles(placed, grid, shape, LineCache(200_000) if cached else None)
    np.testing.assert_array_equal(parts[0], whole)
    np.testing.assert_array_equal(parts[1], coverage)


def test_cutting_a_tile_into_runs_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shortest possible windows give the same values as one window for the whole tile."""
    grid = PixelGrid(CORNER, 1, (40, 140))
    whole = in_tiles(two_turned(None), grid, grid.shape)
    monkeypatch.setattr("spectralzoom.pipeline.rectify.mosaic.RUN_ELEMENTS", 0)
    for one, other in zip(whole, in_tiles(two_turned(None), grid, grid.shape), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_block_of_lines_is_read_once_in_a_column_of_tiles() -> None:
    """In the order of the tiles, with a cache of the projected size, no block of a column is read twice."""
    grid = PixelGrid((3010.0, -4770.0), 1, (160, 120))
    lines = taken(TURNED)
    placed = [place(lines, CAMERA)]
    for tiles in (plan_tiles(placed, CAMERA, grid, (32, 120)), plan_tiles(placed, CAMERA, grid, (32, 60))[:5]):
        lines.asked.clear()
        cache = LineCache(cache_bytes(placed, tiles, 1))
        for tile in tiles:
            mosaic_tile(placed, CAMERA, grid, tile.rows, tile.columns, cache=cache, reach=tile.reach)
            assert cache.bytes_held <= cache.most_bytes
        assert len(lines.asked) == len(set(lines.asked)) > 1


def test_projected_cache_size_covers_the_raw_lines() -> None:
    """A tile holds at most the projected bytes: whole chunks of samples of whole blocks of lines."""
    grid = PixelGrid((3010.0, -4770.0), 1, (160, 120))
    placed = [place(taken(TURNED), CAMERA)]
    tiles = plan_tiles(placed, CAMERA, grid, (32, 20))
    whole = LineCache(2**30)
    for tile in tiles:
        alone = LineCache(2**30)
        for cache in (alone, whole):
            mosaic_tile(placed, CAMERA, grid, tile.rows, tile.columns, cache=cache, reach=tile.reach)
        assert alone.bytes_held <= cache_bytes(placed, [tile], 1)
    assert cache_bytes(placed, tiles, 1) < whole.bytes_held <= cache_bytes(placed, tiles, len(tiles))


@given(st.integers(-100, 300), st.integers(-250, 250), st.integers(1, 60), st.integers(1, 60))
@settings(max_examples=25, deadline=None)
def test_reach_contains_all_knots_and_samples_of_a_tile(row: int, column: int, height: int, width: int) -> None:
    """The predicted knots and samples contain those of every pixel, with a margin for taps."""
    grid = PixelGrid(CORNER, 1, (400, 400))
    placed = place(taken(TURNED, bands=1), CAMERA)
    rows, columns = slice(row, row + height), slice(column, column + width)
    scan_path = placed.scan_paths[0][0]
    at = placed.coordinates(0, CAMERA, grid, rows, columns).reshape(-1, 2)
    at = at[np.isfinite(at[:, 0])]
    near = ScanPathReach(placed, scan_path, CAMERA, grid).in_columns(columns)
    if len(at):
        knots = near.knots(rows)
        assert max(knots.start, 0) <= max(at[:, 0].min() - 2, 0)
        assert knots.stop >= min(at[:, 0].max() + 3, len(scan_path))
        assert near.samples.start <= max(at[:, 1].min() - 2, 0)
        assert near.samples.stop >= min(at[:, 1].max() + 3, CAMERA.samples)


def test_reach_of_distant_upright_lines_has_room_for_taps() -> None:
    """Lines 4 px apart along the rows: every row has the line before its own and the two after it."""
    placed = place(taken(Sweep("upright", "coarse", "x", 0.0, -100.0, 50, 4, held=1), bands=1), CAMERA)
    grid = PixelGrid((-80.0, -70.0), 1, (160, 140))
    near = ScanPathReach(placed, placed.scan_paths[0][0], CAMERA, grid).in_columns(slice(0, 140))
    for row in range(160):
        knot = np.floor(placed.coordinates(0, CAMERA, grid, slice(row, row + 1), slice(0, 140))[..., 0])
        found = near.knots(slice(row, row + 1))
        assert found.start <= knot.min() - 1
        assert found.stop >= knot.max() + 3


def test_turned_lines_are_cut_into_short_runs() -> None:
    """Cutting a long tile of lines turned by 30 degrees halves the calibrated area. Upright lines stay one run."""
    for tilt, most_fraction, runs in ((np.tan(np.pi / 6), 0.5, range(4, 20)), (0.0, 1.0, range(1, 2))):
        y, x = np.mgrid[:64, :640]
        place_of = np.stack([y + tilt * x, x - tilt * y], axis=-1).reshape(64, 20, 32, 2).swapaxes(0, 1)
        cuts = cut_runs([place_of], 270)
        areas = [np.prod(np.ptp(place_of[cut].reshape(-1, 2), axis=0)) for cut in cuts]
        assert sum(areas) <= most_fraction * np.prod(np.ptp(place_of.reshape(-1, 2), axis=0))
        assert len(cuts) in runs
        assert np.concatenate([np.arange(20)[cut] for cut in cuts]).tolist() == list(range(20))


@pytest.mark.parametrize("beside", [True, False])
def test_pixels_without_any_line_are_nan(beside: bool) -> None:
    """Next to the swath, and where all lines are dead, pixels are NaN with a coverage of 0, and no line is read."""
    lines = taken(TURNED)
    lines.valid_line[:] = beside
    grid = PixelGrid((0.0, 0.0) if beside else CORNER, 1, (70, 50))
    values, coverage = in_tiles([place(lines, CAMERA)], grid, (64, 640))
    assert np.isnan(values).all()
    assert not coverage.any()
    assert not lines.asked


@pytest.mark.parametrize("placed_by_it", [False, True])
def test_a_dead_line_leaves_its_own_row_empty(placed_by_it: bool) -> None:
    """The values of a dead line reach no pixel, even if its position is usable. Only the nearest pixels are lost."""
    lines = taken(Sweep("straight", "fine", "x", 0.0, -30.0, 60))
    whole, _ = in_tiles([place(lines, CAMERA)], grid := PixelGrid((-20.0, -60.0), 1, (40, 120)), (64, 640))
    lines.valid_line[30] = False
    lines.raw[30] = 4000
    usable = np.ones(60, np.bool_) if placed_by_it else None
    seen, coverage = in_tiles([place(lines, CAMERA, usable=usable)], grid, (64, 640))
    assert np.flatnonzero((coverage == 0).all(axis=1)).tolist() == [20]
    assert np.nanmax(seen) < 4000
    far = np.abs(np.arange(40) - 20) > 2
    np.testing.assert_array_equal(seen[far], whole[far])


def test_missing_lines_have_no_weight() -> None:
    """A point next to a lost line is computed from the kernel's other lines; the substitute line has no weight."""
    whole = taken(Sweep("straight", "fine", "x", 0.0, -30.0, 60))
    came = np.arange(60) != 30
    rows = {name: getattr(whole, name)[came] for name in ("raw", "position", "valid_line")}
    lines = replace(whole, sweep=replace(whole.sweep, lines=59), **rows)
    seen, coverage = in_tiles([place(lines, CAMERA)], PixelGrid((-0.7, -59.5), 1, (1, 120)), (64, 640))
    assert (coverage == 1).all()
    number, weight = kernel_taps(np.array([29.3]), "catmull-rom")
    weight[number == 30] = 0
    expected = np.tensordot(weight[0] / weight.sum(), whole.raw[number[0], 20:140], 1)
    np.testing.assert_allclose(seen[0], expected, rtol=1e-3)


def test_binned_samples_saturate_at_the_sum_of_full_scales() -> None:
    """A sum of two samples above the full scale of one is valid; a sum of two saturated samples is not."""
    half = taken(Sweep("binned", "coarse", "x", 0.0, -30.0, 40, step=2, binning=2))
    raw = half.raw[:, ::2].copy()
    references = half.references
    raw[...] = 5000
    raw[20:] = 2 * CAMERA.full_scale_dn
    frames = replace(references, dark=references.dark[::2], white=references.white[::2])
    placed = [place(replace(half, raw=raw, references=frames), CAMERA)]
    seen, _ = in_tiles(placed, PixelGrid((-30.0, -60.0), 2, (40, 60)), (64, 640))
    np.testing.assert_allclose(seen[:19], 5000, rtol=1e-6)
    assert np.isnan(seen[21:]).all()


def test_a_sweep_that_turns_back_counts_as_two_sweeps() -> None:
    """Lines captured there and back are blended like two sweeps, for any tiling."""
    there = taken(Sweep("there", "fine", "x", 0.0, -30.0, 60))
    path = np.concatenate([there.position, there.position[::-1]])
    longer = taken(replace(there.sweep, start_px=0.0, lines=120))
    placed = place(replace(longer, position=path, sweep=replace(there.sweep, lines=120)), CAMERA)
    each = [replace(placed, scan_paths=(scan_path,)) for scan_path in placed.scan_paths]
    grid = PixelGrid((-20.0, -60.0), 1, (40, 120))
    expected = in_tiles(each, grid, (64, 640))
    assert (expected[1][5:-5, 5:-5] == 2).all()
    for shape in ((64, 640), (7, 33)):
        for one, other in zip(in_tiles([placed], grid, shape), expected, strict=True):
            np.testing.assert_array_equal(one, other)
