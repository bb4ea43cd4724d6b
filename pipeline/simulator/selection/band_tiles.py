"""The telling places of a cube each of whose bands has a plane of its own: extremes of every band, tile by tile.

No few bands stand for the others there. Of every tile and band the greatest steps between neighbours, between means of
a few pixels and between bands are taken, and the greatest and the least light; the tiles where they are worst, in
groups of neighbouring bands, are then measured as slit and pixel show them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise, zip_longest

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.effects.probe import second_difference, steepest_difference
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.footprint_worth import PixelOptics
from pipeline.simulator.selection.reached_cells import ReachedCells

Light = NDArray[np.float32]
Floats = NDArray[np.float64]
Kind = tuple[int, int, int]  # tier, measure and band or group of bands
BAND_GROUPS = 8
_WINDOWS = 5  # tiles of each measure and group that are measured closely


class Ranking:
    """The best places of every kind."""

    def __init__(self) -> None:
        self._offers: dict[Kind, list[Floats]] = {}

    def offer(self, kind: Kind, worth: NDArray[np.floating], row: NDArray[np.intp], column: NDArray[np.intp]) -> None:
        """Add places of one kind, (place,) each; those of worth minus infinity are none."""
        offers = np.stack([worth, row, column]).astype(np.float64)
        self._offers.setdefault(kind, []).append(offers[:, offers[0] > -np.inf])

    def best(self, tier: int, most: int) -> Floats:
        """Give the best of each kind in turns, none twice, (place, 2) rows and columns."""
        offers = [np.concatenate(some, axis=1) for kind, some in self._offers.items() if kind[0] == tier]
        best = [_worst_first(places, most) for places in offers]
        ranked = [list(zip(*places[1:].astype(int).tolist(), strict=True)) for places in best]
        found = dict.fromkeys(place for rank in zip_longest(*ranked) for place in rank if place is not None)
        return np.array(list(found)[:most], np.float64).reshape(-1, 2)


def _worst_first(places: Floats, most: int) -> Floats:
    """The first places, (row, place) of worth and where they lie, by worth and then by where."""
    if places.shape[1] > most:
        places = places[:, places[0] >= np.partition(places[0], -most)[-most]]
    return places[:, np.lexsort(places[::-1])[::-1][:most]]


def band_groups(bands: int) -> list[slice]:
    """Give the groups of neighbouring bands whose worst stands for each of them."""
    edges = np.linspace(0, bands, min(bands, BAND_GROUPS) + 1).round().astype(int).tolist()
    return [slice(first, last) for first, last in pairwise(edges)]


class BandTiles:
    """Extremes of every band in the tiles of a scene whose bands have planes of their own."""

    def __init__(self, scene: RasterScene, spectra: Light, optics: PixelOptics, tile: int) -> None:
        self._scene, self._spectra, self._optics, self._tile = scene, spectra, optics, tile
        self._groups = band_groups(len(spectra))
        self._wavelength_nm = np.asarray(scene.wavelength_nm, np.float64)
        # Of tiers and measures: worth, row, column and band of tiles, (4, group, tile) of each strip.
        self._found: dict[tuple[int, int], list[Floats]] = {}

    def add(self, first: int, planes: Light, tiers: Mapping[int, NDArray[np.bool_]]) -> None:
        """Take the extremes of a strip of tiles: planes (row, column, band) with the optics' halo about them."""
        halo = self._optics.halo
        light = planes[halo - 1 : 1 - halo, halo - 1 : 1 - halo] * self._spectra
        measures = [self._worst_of_groups(one) for one in self._measures(light)]
        for tier, taken in tiers.items():
            held = np.flatnonzero(np.maximum.reduceat(taken.any(axis=0), self._starts(taken.shape[1])))
            for sort, (worst, bands) in enumerate(measures[:2] if tier < 0 else measures):
                columns = held[np.argsort(worst[:, held], axis=1, kind="stable")[:, -_WINDOWS:]]
                some = (np.take_along_axis(one, columns, axis=1) for one in (worst, bands))
                rows = np.full(columns.shape, first), columns * self._tile
                self._found.setdefault((tier, sort), []).append(np.stack([next(some), *rows, next(some)]))

    def _worst_of_groups(self, worth: Light) -> tuple[Light, NDArray[np.intp]]:
        """Greatest worth of each tile, of worths (tile, band), and its band, (group, tile) both."""
        bands = np.stack([worth[:, some].argmax(axis=1) + some.start for some in self._groups])
        return np.take_along_axis(worth.T, bands, axis=0), bands

    def rank(self, ranking: Ranking, cells: ReachedCells, reaches: Sequence[float]) -> None:
        """Measure the worst tiles of every measure and group closely, and offer their best places.

        ``reaches``: tiers 0, 1, ... end so far beside what sweeps see; the tier of number -1 is all that lies beyond.
        """
        ends = (-1.0, *reaches, np.inf)
        for tier in sorted({kind[0] for kind in self._found}):
            within = (ends[tier], ends[tier + 1]) if tier >= 0 else (ends[-2], ends[-1])
            every = [np.concatenate(some, axis=2) for kind, some in self._found.items() if kind[0] == tier]
            worst = [_worst_first(one, _WINDOWS)[1:] for some in every for one in some.swapaxes(0, 1)]
            windows = sorted({(row, column, band) for row, column, band in np.hstack(worst).T.astype(int).tolist()})
            light = [self._window(*one) for one in windows]
            taken = [
                self._taken(cells.rows_within(row, row + self._tile, *within), column) for row, column, _ in windows
            ]
            if windows:
                self._offer(ranking, tier, windows, np.stack(light, axis=2), np.stack(taken, axis=2))

    def _offer(
        self, ranking: Ranking, tier: int, windows: list[tuple[int, int, int]], light: Light, taken: NDArray[np.bool_]
    ) -> None:
        """Offer the best place of each window by every measure; light (row, column, window, neighbouring band)."""
        middle = np.ascontiguousarray(light[..., 1])
        halo = self._optics.halo
        inner = light[halo:-halo, halo:-halo]
        if tier < 0:
            measures = [inner[..., 1], -inner[..., 1]]
        else:
            noise = self._optics.noise(inner[..., 1])
            step = np.abs(np.diff(inner, axis=-1)).max(axis=-1) / noise
            bend = np.abs(inner[..., 0] + inner[..., 2] - 2 * inner[..., 1]) / noise
            measures = [*self._optics.worths(middle), step, bend]
        rows, columns, bands = np.array(windows).T
        group = np.searchsorted([some.stop for some in self._groups], bands, side="right")
        for sort, worth in enumerate(measures):
            shown = np.where(taken, worth, -np.inf).reshape(-1, len(windows))
            best = shown.argmax(axis=0)
            down, right = np.divmod(best, self._tile)
            offered = shown[best, np.arange(len(windows))], rows + down, columns + right
            for number in np.unique(group).tolist():
                ranking.offer((tier, sort, number), *(one[group == number] for one in offered))

    def _window(self, row: int, column: int, band: int) -> Light:
        """Light about a tile in a band and its neighbours, (row, column, 3); the scene's edge is repeated."""
        halo, (rows, columns) = self._optics.halo, self._scene.shape
        down = np.arange(row - halo, row + self._tile + halo).clip(0, rows - 1)
        right = np.arange(column - halo, column + self._tile + halo).clip(0, columns - 1)
        bands = np.arange(band - 1, band + 2).clip(0, len(self._spectra) - 1)
        found: Light = self._scene.planes[down[:, None, None], right[:, None], bands] * self._spectra[bands]
        return found

    def _taken(self, rows: NDArray[np.bool_], column: int) -> NDArray[np.bool_]:
        """Which pixels of a tile count, (row, column); none beyond the scene."""
        some = rows[:, column : column + self._tile]
        return np.pad(some, [(0, self._tile - size) for size in some.shape])

    def _starts(self, columns: int) -> NDArray[np.intp]:
        return np.arange(0, columns, self._tile)

    def _measures(self, light: Light) -> list[Light]:
        """Worth of every tile of a strip for every measure, (tile, band) each; the strip has a pixel beside it."""
        inner = light[1:-1, 1:-1]
        starts = self._starts(inner.shape[1])

        def greatest(values: Light) -> Light:
            ridge = values.max(axis=0)
            if short := -len(ridge) % self._tile:
                ridge = np.pad(ridge, [(0, short), (0, 0)], mode="edge")
            most: Light = ridge.reshape(-1, self._tile, ridge.shape[1]).max(axis=1)
            return most

        high, low = greatest(inner), -greatest(-inner)
        noise = self._optics.noise(low)
        found = [high, -low]
        for axis in (0, 1):
            other = (slice(None), slice(1, -1)) if axis == 0 else (slice(1, -1), slice(None))
            step = np.abs(np.diff(light[other], axis=axis))
            beside = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
            found.append(greatest(step[beside]) / noise)
        found += self._wide_steps(light, starts, greatest, noise)
        found += self._spectral_steps(inner, greatest, noise)
        return found

    def _wide_steps(
        self, light: Light, starts: NDArray[np.intp], greatest: Callable[[Light], Light], noise: Light
    ) -> list[Light]:
        """Between means of half tiles, and between any two pixels: what a slit shows that is wider than a pixel."""
        high, low = light.max(axis=0)[1:-1], light.min(axis=0)[1:-1]
        span: Light = greatest(high[None]) + greatest(-low[None])
        rows, columns = (_halves(size, self._tile) for size in light.shape[:2])
        high = [light[first:last].sum(axis=0) for first, last in pairwise([*rows.tolist(), len(light)])]
        sums = np.add.reduceat(np.stack(high), columns, axis=1)
        counts = np.diff(rows, append=light.shape[0])[:, None] * np.diff(columns, append=light.shape[1])
        means = sums / counts[..., None].astype(np.float32)
        ahead = np.abs(np.diff(means, axis=0, append=means[-1:])).max(axis=0)
        aside = np.abs(np.diff(means, axis=1, append=means[:, -1:])).max(axis=0)
        firsts = np.searchsorted(columns, starts + 1, side="right") - 1
        return [span / noise, *(np.maximum.reduceat(step, firsts, axis=0) / noise for step in (ahead, aside))]

    def _spectral_steps(self, inner: Light, greatest: Callable[[Light], Light], noise: Light) -> list[Light]:
        if inner.shape[2] < 2:
            return []
        steep = steepest_difference(inner, self._wavelength_nm)
        return [greatest(one) / noise for one in (steep, np.abs(second_difference(inner, self._wavelength_nm)))]


def _halves(size: int, tile: int) -> NDArray[np.intp]:
    """Firsts of half tiles, of a row with a pixel on either side."""
    firsts = np.arange(1, size - 1, tile)
    both = np.unique(np.concatenate([firsts, firsts + tile // 2]))
    found: NDArray[np.intp] = both[both < size - 1]
    found[0] = 0
    return found
