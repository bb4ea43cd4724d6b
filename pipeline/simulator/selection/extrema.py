"""Extrema of a scene: where it is steepest, most curved, brightest and darkest, in and beside the sweeps.

It works on the scene's own pixels, strip by strip, with the slit's box along the scan. It is fast and right to a pixel,
and leaves the exact numbers to closer looks. A few bands stand for all where planes are components; where bands have
planes of their own, each is searched, tile by tile: see `BandTiles`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera, footprint_kernel
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.probe import second_difference, steepest_difference
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands
from pipeline.simulator.selection.adjacency import ReachedCells

Radiance = NDArray[np.float32]
_LEAST_WEIGHT = 1e-3  # of a kernel's tap: enough to find places


@dataclass(frozen=True)
class PixelOptics:
    """Kernels of slit and pixel over a scene's pixels, and the part of the noise that light does not change [e-^2].

    ``turned`` are the orientations of the lines: whether they lie along y.
    """

    slit: NDArray[np.float32]
    pixel: NDArray[np.float32]
    fixed_noise: float
    binning: int
    turned: tuple[bool, ...]

    @staticmethod
    def of(camera: LineCamera, binning: int, turned: tuple[bool, ...]) -> PixelOptics:
        fixed = camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12
        return PixelOptics(_short_kernel(camera.slit_px), _short_kernel(1.0), fixed, binning, turned)

    @property
    def halo(self) -> int:
        """Return the reach of kernels, differences and sums [px]."""
        return len(self.slit) // 2 + len(self.pixel) // 2 + 1 + self.binning // 2

    def noise(self, light: Radiance) -> Radiance:
        """Return one standard deviation at each light [e-]."""
        noise: Radiance = np.sqrt(np.maximum(light, 0) + np.float32(self.fixed_noise))
        return noise

    def worths(self, light: Radiance) -> Iterator[Radiance]:
        """Yield measures of light without its halo, (row, column, band) each: higher ones are probed first.

        Summed samples count by the average of sizes along the line, as in the probe.
        """
        inner = (slice(self.halo, -self.halo), slice(self.halo, -self.halo))
        for along_y in self.turned:
            line = 0 if along_y else 1
            seen = _blurred(_blurred(light, self.slit, 1 - line), self.pixel, line)
            level = self._summed(seen, line)[inner]
            noise = self.noise(level)
            yield level
            yield -level
            yield self._summed(np.abs(light - seen), line)[inner] / noise
            for axis in (0, 1):
                ahead, behind = np.roll(seen, -1, axis), np.roll(seen, 1, axis)
                yield self._summed(np.abs(ahead - behind), line)[inner] / noise
                yield self._summed(np.abs(ahead + behind - 2 * seen), line)[inner] / noise
            rise: Radiance = np.roll(seen, -1, 0) - np.roll(seen, 1, 0)
            mixed = np.abs(np.roll(rise, -1, 1) - np.roll(rise, 1, 1))  # what a box that does not lie turned misses
            yield np.divide(self._summed(mixed, line)[inner], noise)

    def _summed(self, values: Radiance, axis: int) -> Radiance:
        """Return the mean over the samples of a stored number about each pixel, along an axis."""
        if self.binning == 1:
            return values
        steps = np.arange(self.binning) - self.binning // 2
        total: Radiance = sum((np.roll(values, -step, axis) for step in steps.tolist()), np.zeros_like(values))
        total /= np.float32(self.binning)
        return total


def _short_kernel(width_px: float) -> NDArray[np.float32]:
    kernel = footprint_kernel(width_px) if width_px > 0 else np.ones(1)
    half = len(kernel) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(kernel) > _LEAST_WEIGHT) - half).max())
    return kernel[half - reach : half + reach + 1].astype(np.float32)


def _blurred(light: Radiance, kernel: NDArray[np.float32], axis: int) -> Radiance:
    half = len(kernel) // 2
    total: Radiance = kernel[half] * light
    for offset in range(1, half + 1):  # kernels are symmetric
        total += kernel[half + offset] * (np.roll(light, offset, axis) + np.roll(light, -offset, axis))
    return total


Floats = NDArray[np.float64]
Kind = tuple[int, int, int]  # tier, measure and band or group of bands
BAND_GROUPS = 8
_WINDOWS = 5  # tiles of each measure and group that are measured closely


class Ranking:
    """The best places of every kind."""

    def __init__(self) -> None:
        self._offers: dict[Kind, list[Floats]] = {}

    def offer(
        self, kind: Kind, expected_gain: NDArray[np.floating], row: NDArray[np.intp], column: NDArray[np.intp]
    ) -> None:
        """Add places of one kind, (place,) each; those of worth minus infinity are none."""
        offers = np.stack([expected_gain, row, column]).astype(np.float64)
        self._offers.setdefault(kind, []).append(offers[:, offers[0] > -np.inf])

    def best(self, tier: int, most: int) -> Floats:
        """Return the best of each kind in turns, none twice, (place, 2) rows and columns."""
        offers = [np.concatenate(some, axis=1) for kind, some in self._offers.items() if kind[0] == tier]
        best = [_worst_first(places, most) for places in offers]
        ranked = [list(zip(*places[1:].astype(int).tolist(), strict=True)) for places in best]
        found = dict.fromkeys(place for rank in zip_longest(*ranked) for place in rank if place is not None)
        return np.array(list(found)[:most], np.float64).reshape(-1, 2)


def _worst_first(places: Floats, most: int) -> Floats:
    """Return the first places by measure and then by location, (row, place): measure, and where they lie."""
    if places.shape[1] > most:
        places = places[:, places[0] >= np.partition(places[0], -most)[-most]]
    return places[:, np.lexsort(places[::-1])[::-1][:most]]


def band_groups(bands: int) -> list[slice]:
    """Return the groups of neighbouring bands whose worst stands for each of them."""
    edges = np.linspace(0, bands, min(bands, BAND_GROUPS) + 1).round().astype(int).tolist()
    return [slice(first, last) for first, last in pairwise(edges)]


class BandTiles:
    """Extremes of every band in the tiles of a scene whose bands have planes of their own."""

    def __init__(self, scene: RasterScene, spectra: Radiance, optics: PixelOptics, tile: int) -> None:
        self._scene, self._spectra, self._optics, self._tile = scene, spectra, optics, tile
        self._groups = band_groups(len(spectra))
        self._wavelength_nm = np.asarray(scene.wavelength_nm, np.float64)
        # by tiers and measures: worth, row, column and band of tiles, (4, group, tile) of each strip.
        self._found: dict[tuple[int, int], list[Floats]] = {}

    def add(self, first: int, planes: Radiance, tiers: Mapping[int, NDArray[np.bool_]]) -> None:
        """Take the extremes of a strip of tiles: planes (row, column, band) with the optics' halo about them."""
        halo = self._optics.halo
        light = planes[halo - 1 : 1 - halo, halo - 1 : 1 - halo] * self._spectra
        measures = []  # of each the greatest worth of every tile in a group of bands, and its band, (group, tile)
        for one in self._measures(light):
            bands = np.stack([one[:, some].argmax(axis=1) + some.start for some in self._groups])
            measures.append((np.take_along_axis(one.T, bands, axis=0), bands))
        for tier, taken in tiers.items():
            held = np.flatnonzero(np.maximum.reduceat(taken.any(axis=0), self._starts(taken.shape[1])))
            for sort, (worst, bands) in enumerate(measures[:2] if tier < 0 else measures):
                columns = held[np.argsort(worst[:, held], axis=1, kind="stable")[:, -_WINDOWS:]]
                some = (np.take_along_axis(one, columns, axis=1) for one in (worst, bands))
                rows = np.full(columns.shape, first), columns * self._tile
                self._found.setdefault((tier, sort), []).append(np.stack([next(some), *rows, next(some)]))

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
        self,
        ranking: Ranking,
        tier: int,
        windows: list[tuple[int, int, int]],
        light: Radiance,
        taken: NDArray[np.bool_],
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
        for sort, expected_gain in enumerate(measures):
            shown = np.where(taken, expected_gain, -np.inf).reshape(-1, len(windows))
            best = shown.argmax(axis=0)
            down, right = np.divmod(best, self._tile)
            offered = shown[best, np.arange(len(windows))], rows + down, columns + right
            for number in np.unique(group).tolist():
                ranking.offer((tier, sort, number), *(one[group == number] for one in offered))

    def _window(self, row: int, column: int, band: int) -> Radiance:
        """Return the light about a tile in a band and its neighbours, (row, column, 3).

        The scene's edge is repeated.
        """
        halo, (rows, columns) = self._optics.halo, self._scene.shape
        down = np.arange(row - halo, row + self._tile + halo).clip(0, rows - 1)
        right = np.arange(column - halo, column + self._tile + halo).clip(0, columns - 1)
        bands = np.arange(band - 1, band + 2).clip(0, len(self._spectra) - 1)
        found: Radiance = self._scene.planes[down[:, None, None], right[:, None], bands] * self._spectra[bands]
        return found

    def _taken(self, rows: NDArray[np.bool_], column: int) -> NDArray[np.bool_]:
        """Return which pixels of a tile count, (row, column); none beyond the scene."""
        some = rows[:, column : column + self._tile]
        return np.pad(some, [(0, self._tile - size) for size in some.shape])

    def _starts(self, columns: int) -> NDArray[np.intp]:
        return np.arange(0, columns, self._tile)

    def _measures(self, light: Radiance) -> list[Radiance]:
        """Return every measure of every tile of a strip, (tile, band) each; the strip has one pixel of margin."""
        inner = light[1:-1, 1:-1]
        starts = self._starts(inner.shape[1])

        def greatest(values: Radiance) -> Radiance:
            ridge = values.max(axis=0)
            if short := -len(ridge) % self._tile:
                ridge = np.pad(ridge, [(0, short), (0, 0)], mode="edge")
            most: Radiance = ridge.reshape(-1, self._tile, ridge.shape[1]).max(axis=1)
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
        if inner.shape[2] > 1:
            nm = self._wavelength_nm
            steps = (steepest_difference(inner, nm), np.abs(second_difference(inner, nm)))
            found += [greatest(one) / noise for one in steps]
        return found

    def _wide_steps(
        self, light: Radiance, starts: NDArray[np.intp], greatest: Callable[[Radiance], Radiance], noise: Radiance
    ) -> list[Radiance]:
        """Return the steps between means of half tiles, and between any two pixels, for slits wider than a pixel."""
        high, low = light.max(axis=0)[1:-1], light.min(axis=0)[1:-1]
        span: Radiance = greatest(high[None]) + greatest(-low[None])
        rows, columns = (_halves(size, self._tile) for size in light.shape[:2])
        high = [light[first:last].sum(axis=0) for first, last in pairwise([*rows.tolist(), len(light)])]
        sums = np.add.reduceat(np.stack(high), columns, axis=1)
        counts = np.diff(rows, append=light.shape[0])[:, None] * np.diff(columns, append=light.shape[1])
        means = sums / counts[..., None].astype(np.float32)
        ahead = np.abs(np.diff(means, axis=0, append=means[-1:])).max(axis=0)
        aside = np.abs(np.diff(means, axis=1, append=means[:, -1:])).max(axis=0)
        firsts = np.searchsorted(columns, starts + 1, side="right") - 1
        return [span / noise, *(np.maximum.reduceat(step, firsts, axis=0) / noise for step in (ahead, aside))]


def _halves(size: int, tile: int) -> NDArray[np.intp]:
    """Return the first pixels of half tiles, for a row with a pixel of margin on either side."""
    firsts = np.arange(1, size - 1, tile)
    both = np.unique(np.concatenate([firsts, firsts + tile // 2]))
    found: NDArray[np.intp] = both[both < size - 1]
    found[0] = 0
    return found


CHOSEN_BANDS = 4
_TILES = 8192  # at most about so many, each of which offers its best place
_TILES_HIGH = 3  # strips: what is made of one stays in the processor's cache
_FAR = -1  # number of what lies beyond all reaches: of it only the brightest and the darkest count


@dataclass(frozen=True)
class Extrema:
    """Places as rows and columns, integers as floats, (place, 2) each, the worst of every measure first. [px]

    ``beside`` are those within the first, the second, ... reach of the sweeps and not within the one before; ``far``
    the brightest and the darkest of what lies beyond.
    """

    seen: Floats
    beside: tuple[Floats, ...]
    far: Floats


@dataclass(frozen=True)
class _Swath:
    """Rows from ``first`` on with a halo about them, and which of its pixels each tier holds, by its number."""

    first: int
    planes: Radiance
    tiers: dict[int, NDArray[np.bool_]]


def find_extrema(
    scene: RasterScene,
    camera: LineCamera,
    sweeps: Sequence[Sweep],
    cells: ReachedCells,
    reaches: Sequence[float],
    most: Sequence[int],
) -> Extrema:
    """Find the places where light changes most over its noise, and where there is most and least of it.

    ``sweeps`` are of one binning, ``cells`` say how far they see, ``reaches`` how far beside them to look as well [px];
    At most ``most`` places are found where sweeps see, within each reach, and beyond. Each is in a tile of its own for
    one measure and band. Raises SceneError: the scene holds a number that is not finite.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    optics = PixelOptics.of(camera, sweeps[0].binning, tuple(sorted({sweep.along == "y" for sweep in sweeps})))
    tile = max(8, math.ceil(math.sqrt(scene.shape[0] * scene.shape[1] / _TILES)))
    ranking = Ranking()
    own_planes = spectra.ndim == 1
    tiles = BandTiles(scene, spectra, optics, tile) if own_planes and len(spectra) > CHOSEN_BANDS else None
    bands = chosen_bands(spectra)
    high = tile if tiles is not None else _TILES_HIGH * tile
    for swath in _swaths(scene, high, optics.halo, cells, reaches):
        _check_finite(scene, swath.planes, swath.first - optics.halo)
        if not any(taken.any() for taken in swath.tiers.values()):
            continue
        if tiles is not None:
            tiles.add(swath.first, swath.planes, swath.tiers)
            continue
        some = spectra[bands] if own_planes else np.ascontiguousarray(spectra[:, bands])
        light = to_bands(swath.planes[..., bands] if own_planes else swath.planes, some)
        _rank(ranking, swath, light, optics, tile)
    if tiles is not None:
        tiles.rank(ranking, cells, (0.0, *reaches))
    found = [ranking.best(tier, count) for tier, count in zip((*range(len(reaches) + 1), _FAR), most, strict=True)]
    return Extrema(found[0], tuple(found[1:-1]), found[-1])


def _rank(ranking: Ranking, swath: _Swath, light: Radiance, optics: PixelOptics, tile: int) -> None:
    near = {tier: taken for tier, taken in swath.tiers.items() if tier != _FAR and taken.any()}
    for sort, expected_gain in enumerate(optics.worths(light) if near else ()):
        for tier, taken in near.items():
            _offer(ranking, (tier, sort), expected_gain, taken, swath.first, tile)
    far, halo = swath.tiers.get(_FAR), optics.halo
    if far is not None and far.any():
        inner = light[halo:-halo, halo:-halo]
        for sort, expected_gain in enumerate((inner, -inner)):
            _offer(ranking, (_FAR, sort), expected_gain, far, swath.first, tile)


def _offer(
    ranking: Ranking, kind: tuple[int, int], expected_gain: Radiance, taken: NDArray[np.bool_], first: int, tile: int
) -> None:
    """Offer the greatest of every tile and band; worth (row, column, band) of the strip that begins at a row."""
    shown = expected_gain if taken.all() else np.where(taken[..., None], expected_gain, np.float32(-np.inf))
    (rows, columns, bands), none = expected_gain.shape, -np.inf
    shown = np.pad(shown, [(0, -rows % tile), (0, -columns % tile), (0, 0)], constant_values=none)
    tall = shown.reshape(-1, tile, shown.shape[1], bands)  # (row of tiles, row, column, band)
    ridge = tall.max(axis=1).reshape(len(tall), -1, tile, bands)
    within = ridge.argmax(axis=2)  # (row of tiles, tile, band)
    greatest = np.take_along_axis(ridge, within[:, :, None], axis=2)[:, :, 0]
    column = within + np.arange(ridge.shape[1])[:, None] * tile
    high = np.arange(len(tall))[:, None, None]
    row = first + high * tile + tall[high, :, column, np.arange(bands)].argmax(axis=-1)
    for band in range(bands):
        ranking.offer((*kind, band), *(one[..., band].ravel() for one in (greatest, row, column)))


def chosen_bands(spectra: Radiance) -> NDArray[np.intp]:
    """Choose the brightest band and those least like the ones chosen, at most ``CHOSEN_BANDS``.

    Bands with planes of their own are chosen evenly, and as many: they do not predict each other.
    """
    if spectra.ndim == 1:
        return np.unique(np.linspace(0, len(spectra) - 1, CHOSEN_BANDS).round().astype(np.intp))
    chosen = [int(spectra.max(axis=0).argmax())]
    for _ in range(min(CHOSEN_BANDS, spectra.shape[1]) - 1):
        gap = np.min([np.abs(spectra - spectra[:, [one]]).max(axis=0) for one in chosen], axis=0)
        chosen.append(int(gap.argmax()))
    return np.unique(chosen)


def _swaths(
    scene: RasterScene, high: int, halo: int, cells: ReachedCells, reaches: Sequence[float]
) -> Iterator[_Swath]:
    rows, ends = scene.shape[0], [-1.0, 0.0, *reaches]
    for first in range(0, rows, high):
        down = np.arange(first - halo, min(first + high, rows) + halo).clip(0, rows - 1)
        inner = scene.planes[down[0] : down[-1] + 1][down - down[0]]
        tiers = {0: cells.rows_within(first, first + high, -1.0, 0.0)}
        if not cells.covers:
            numbers = range(1, len(reaches) + 1)
            tiers |= {one: cells.rows_within(first, first + high, ends[one], ends[one + 1]) for one in numbers}
            tiers[_FAR] = cells.rows_within(first, first + high, ends[-1], np.inf)
        yield _Swath(first, np.pad(inner, ((0, 0), (halo, halo), (0, 0)), mode="edge"), tiers)


def _check_finite(scene: RasterScene, planes: Radiance, first: int) -> None:
    with np.errstate(invalid="ignore", over="ignore"):  # infinity less infinity: found out below
        if np.isfinite(planes.sum(dtype=np.float64)):
            return
    row, column, component = np.argwhere(~np.isfinite(planes))[0].tolist()
    row = min(max(first + row, 0), scene.shape[0] - 1)
    column = min(max(column - (planes.shape[1] - scene.shape[1]) // 2, 0), scene.shape[1] - 1)
    raise SceneError(
        f"scene {scene.name} is not finite at row {row}, column {column}, component {component};"
        " fill such pixels before it is simulated"
    )
