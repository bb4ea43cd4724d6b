"""Pixels of the scene grid from simulated sweeps: what is read where, and at the borders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera, footprint
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Sweep
from pipeline.planning.coverage import coarse_sweeps, full_sweeps
from pipeline.rectify.line_cache import LineCache
from pipeline.rectify.region import mosaic_rows, read_seats, seat_pixels
from pipeline.rectify.placed import place
from pipeline.simulator.effects.registry import effects_on
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep
from pipeline.source import References

CAMERA = LineCamera()


def smooth_scene(shape: tuple[int, int], bands: int = 2) -> RasterScene:
    """A few slow waves, above zero everywhere."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = [2 + np.sin(2 * np.pi * (y / (17 + 3 * k) + x / (23 - 2 * k))) for k in range(bands)]
    values = np.stack(waves, axis=-1).astype(np.float32)
    return raster_from_values(values, CAMERA, name="waves", wavelength_nm=np.linspace(500, 700, bands))


def looked_at(scene: RasterScene, sweeps: list[Sweep]) -> list[SimulatedSweep]:
    """The sweeps without noise."""
    source = SimulatedSource(scene, Rig(CAMERA), 0, effects_on("rotation", "slit", "smear"))
    return [SimulatedSweep(source, sweep) for sweep in sweeps]


@pytest.mark.parametrize("along", ["x", "y"])
def test_fine_mosaic_is_the_scene_behind_the_footprint(along: str) -> None:
    """In either orientation a full scan gives the scene convolved with slit and pixel, to a percent of its range."""
    scene = smooth_scene((70, 90))
    grid = SceneGrid(70, 90, 16, 4)
    sweeps = looked_at(scene, full_sweeps(grid, CAMERA, along))  # type: ignore[arg-type]
    seen = np.concatenate([values for _, values, _ in mosaic_rows(sweeps, CAMERA, grid, rows=32)])
    truth = footprint(scene.values(), CAMERA)
    if along == "y":  # the slit then lies along y and the scan goes along x
        truth = footprint(scene.values().swapaxes(0, 1), CAMERA).swapaxes(0, 1)
    inner = (slice(3, -3), slice(3, -3))
    assert np.abs(seen[inner] - truth[inner]).max() < 0.01 * np.ptp(truth)


def test_blocks_of_rows_do_not_change_the_mosaic() -> None:
    """Reading a mosaic in other blocks of rows gives the same numbers, bit by bit."""
    grid = SceneGrid(50, 40, 8, 2)
    sweeps = looked_at(smooth_scene((50, 40)), coarse_sweeps(grid, CAMERA, "x"))
    whole, parts = (
        np.concatenate([values for _, values, _ in mosaic_rows(sweeps, CAMERA, grid, rows=rows)]) for rows in (64, 7)
    )
    assert whole.shape == (25, 20, 2)
    np.testing.assert_array_equal(whole, parts)


def test_seats_are_windows_of_the_mosaic() -> None:
    """A seat read by itself holds the mosaic's own pixels."""
    grid = SceneGrid(64, 64, 16, 4)
    sweeps = looked_at(smooth_scene((64, 64)), full_sweeps(grid, CAMERA, "x"))
    mosaic = np.concatenate([values for _, values, _ in mosaic_rows(sweeps, CAMERA, grid, rows=64)])
    patches, valid = read_seats(sweeps, CAMERA, grid, np.array([5, 10]))
    np.testing.assert_array_equal(patches[0], mosaic[16:32, 16:32])
    np.testing.assert_array_equal(patches[1], mosaic[32:48, 32:48])
    assert valid.all()


def test_seats_from_a_cache_are_the_same() -> None:
    """Sweeps placed once and lines kept between calls change no bit, and no line is read twice."""
    grid = SceneGrid(150, 100, 10, 2)
    sweeps = looked_at(smooth_scene((150, 100)), full_sweeps(grid, CAMERA, "x"))
    seats = grid.valid_seats()
    plain, valid = read_seats(sweeps, CAMERA, grid, seats)
    placed, cache = [place(lines, CAMERA) for lines in sweeps], LineCache(2**30)
    for first in range(0, len(seats), 7):
        part = slice(first, first + 7)
        values, seen = read_seats(placed, CAMERA, grid, seats[part], cache=cache)
        np.testing.assert_array_equal(values, plain[part])
        np.testing.assert_array_equal(seen, valid[part])
    assert cache.reads == sum(-(-lines.sweep.lines // 64) for lines in sweeps)


def test_seats_beside_all_sweeps_are_empty() -> None:
    """A seat that no sweep shows is NaN and not valid."""
    grid = SceneGrid(200, 40, 10, 2)
    short = replace(full_sweeps(grid, CAMERA, "x")[0], lines=60)
    patches, valid = read_seats(looked_at(smooth_scene((200, 40)), [short]), CAMERA, grid, grid.valid_seats()[-4:])
    assert np.isnan(patches).all()
    assert not valid.any()


def test_a_partial_seat_is_filled_from_inside() -> None:
    """Pixels beyond the scene repeat pixels of the same seat and are marked as not on the scene."""
    grid = SceneGrid(12, 21, 8, 2)
    seats = grid.valid_seats()
    points, inside = seat_pixels(grid, seats)
    assert inside.sum() == 12 * 21
    origin = grid.seat_origin(seats)[:, None, None, :]
    place = points + (np.array([12, 21]) - 1) / 2
    assert (place >= origin).all()
    assert (place <= np.array([11, 20])).all()


@dataclass(frozen=True)
class OneBadLine:
    """A sweep with one line marked as not usable and full of nonsense."""

    inner: SimulatedSweep
    bad: int

    @property
    def sweep(self) -> Sweep:
        """As inside."""
        return self.inner.sweep

    @property
    def references(self) -> References:
        """As inside."""
        return self.inner.references

    @property
    def position(self) -> NDArray[np.float64]:
        """As inside."""
        return self.inner.position

    @property
    def time_s(self) -> NDArray[np.float64]:
        """As inside."""
        return self.inner.time_s

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """All but one."""
        return np.arange(self.sweep.lines) != self.bad

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """As inside, with the bad line overwritten."""
        raw = self.inner.read(start, stop)
        if start <= self.bad < stop:
            raw[self.bad - start] = 4000
        return raw


def test_an_invalid_line_counts_nothing() -> None:
    """What an invalid line holds reaches no pixel; its own row has no value left."""
    grid = SceneGrid(40, 40, 8, 2)
    clean = looked_at(smooth_scene((40, 40)), full_sweeps(grid, CAMERA, "x"))
    spoilt = [OneBadLine(clean[0], 20)]
    expected = np.concatenate([values for _, values, _ in mosaic_rows(clean, CAMERA, grid, rows=64)])
    seen = np.concatenate([values for _, values, _ in mosaic_rows(spoilt, CAMERA, grid, rows=64)])
    lost = ~np.isfinite(seen).all(axis=(1, 2))
    assert lost.sum() == 1
    np.testing.assert_allclose(seen[~lost], expected[~lost], atol=0.05 * np.ptp(expected))
