"""Extrema of a scene: the pixels where it is steepest, most curved, brightest and darkest.

The search works on the scene's own pixels, strip by strip, with the slit's box along the scan. It is right to a pixel;
a closer look at these places gives the exact numbers. A few bands stand for all where planes are components. Bands
with planes of their own come in groups. The brightest, darkest and steepest of each stand for it: see `telling_bands`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise, zip_longest

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera, footprint_kernel
from spectralzoom.pipeline.geometry.scan import Floats, Sweep
from spectralzoom.pipeline.simulator.effects.probe import Radiance, fixed_variance, steepest_difference
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands

BAND_GROUPS = 8
CHOSEN_BANDS = 4
_LEAST_WEIGHT = 1e-3  # of a kernel's tap: enough to find places
_MEAN_PX = 4  # side of the squares whose means are compared: a slit is wider than a pixel
_SPECTRAL = 100  # number of the measure over wavelength
_TILES = 8192  # about the most; each offers its best place
_TILES_HIGH = 3  # strips, at most: what is made of one stays in the processor's cache
_STRIP_PX = 2**21  # of which a strip of more tiles has less


def find_extrema(scene: RasterScene, camera: LineCamera, sweeps: Sequence[Sweep], most: int) -> Floats:
    """Return the pixels where light changes most over its noise, and where it is greatest and least.

    Returns (place, 2) rows and columns [px], at most ``most``, the worst of every measure first, each in a tile of its
    own for one measure and band. Raises SceneError: the scene holds a number that is not finite.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    optics = PixelOptics(camera, sorted({sweep.along == "y" for sweep in sweeps}))
    tile = max(8, math.ceil(math.sqrt(scene.shape[0] * scene.shape[1] / _TILES)))
    ranking = Ranking()
    own_planes = spectra.ndim == 1
    if own_planes and len(spectra) > CHOSEN_BANDS:
        bands = telling_bands(scene, spectra, optics, tile, ranking)
        kinds = np.searchsorted([one.stop for one in band_groups(len(spectra))], bands, side="right").tolist()
    else:
        bands = np.arange(len(spectra)) if own_planes else chosen_bands(spectra)
        kinds = list(range(len(bands)))
    some = spectra[bands] if own_planes else np.ascontiguousarray(spectra[:, bands])
    high = min(_TILES_HIGH, max(1, _STRIP_PX // (tile * scene.shape[1]))) * tile
    for first, planes in _row_blocks(scene, high, optics.halo):
        light = to_bands(planes[..., bands] if own_planes else planes, some)
        for measure, values in enumerate(optics.measures(light)):
            ranking.offer(measure, values, first, tile, kinds)
    return ranking.best(most)


def chosen_bands(spectra: Radiance) -> NDArray[np.intp]:
    """Return the brightest band and those least like the ones chosen, at most ``CHOSEN_BANDS``."""
    chosen = [int(spectra.max(axis=0).argmax())]
    for _ in range(min(CHOSEN_BANDS, spectra.shape[1]) - 1):
        gap = np.min([np.abs(spectra - spectra[:, [one]]).max(axis=0) for one in chosen], axis=0)
        chosen.append(int(gap.argmax()))
    return np.unique(chosen)


def telling_bands(
    scene: RasterScene, spectra: Radiance, optics: PixelOptics, tile: int, ranking: Ranking
) -> NDArray[np.intp]:
    """Return the brightest, darkest and steepest of each group of bands, of a scene with a plane for each.

    Steepest is from pixel to pixel and from mean to mean of some pixels. Places where light differs most from band to
    band are offered as they are found.
    """
    groups = band_groups(len(spectra))
    starts = [one.start for one in groups]
    worst = np.full((6, len(spectra)), -np.inf)
    for first, planes in _row_blocks(scene, tile, 1):
        light = planes * spectra
        inner = light[1:-1, 1:-1]
        noise = optics.noise(inner)
        steps = [np.abs(beside - inner) / noise for beside in (light[2:, 1:-1], light[1:-1, 2:])]
        rows, columns = (size // _MEAN_PX for size in inner.shape[:2])
        some = inner[: rows * _MEAN_PX, : columns * _MEAN_PX]
        means = some.reshape(rows, _MEAN_PX, columns, _MEAN_PX, len(spectra)).mean(axis=(1, 3))
        steps += [np.abs(means[1:] - means[:-1]) / optics.noise(means[1:])]
        steps += [np.abs(means[:, 1:] - means[:, :-1]) / optics.noise(means[:, 1:])]
        for number, values in enumerate((inner, -inner, *steps)):
            worst[number] = np.maximum(worst[number], values.max(axis=(0, 1), initial=-np.inf))
        in_groups = np.maximum.reduceat(steepest_difference(inner, scene.wavelength_nm) / noise, starts, axis=2)
        ranking.offer(_SPECTRAL, in_groups, first, tile, range(len(groups)))
    return np.unique([one.start + values[one].argmax() for one in groups for values in worst])


def _row_blocks(scene: RasterScene, high: int, halo: int) -> Iterator[tuple[int, Radiance]]:
    """Yield the first row of each strip, and its planes with a halo in which the scene's edge is repeated."""
    rows, columns = scene.shape
    across = np.arange(-halo, columns + halo).clip(0, columns - 1)
    for first in range(0, rows, high):
        down = np.arange(first - halo, min(first + high, rows) + halo).clip(0, rows - 1)
        planes = scene.planes[down[:, None], across]
        with np.errstate(invalid="ignore", over="ignore"):  # infinity less infinity: found below
            total = planes.sum(dtype=np.float64)
        if not np.isfinite(total):
            row, column, component = np.argwhere(~np.isfinite(planes))[0].tolist()
            raise SceneError(
                f"scene {scene.name} is not finite at row {down[row]}, column {across[column]}, component {component};"
                " fill such pixels before it is simulated"
            )
        yield first, planes


class Ranking:
    """The best places of every kind."""

    def __init__(self) -> None:
        self._offers: dict[tuple[int, int], list[Floats]] = {}  # by measure, and band or group of bands

    def offer(self, measure: int, values: Radiance, first: int, tile: int, kinds: Sequence[int]) -> None:
        """Offer the greatest of every tile and band of a strip, (row, column, band), that begins at the row ``first``.

        ``kinds`` (band,) say with which other bands each is ranked.
        """
        rows, columns, bands = values.shape
        padded = np.pad(values, [(0, -rows % tile), (0, -columns % tile), (0, 0)], constant_values=-np.inf)
        tall = padded.reshape(-1, tile, padded.shape[1], bands)  # (row of tiles, row, column, band)
        ridge = tall.max(axis=1).reshape(len(tall), -1, tile, bands)
        within = ridge.argmax(axis=2)  # (row of tiles, tile, band)
        greatest = np.take_along_axis(ridge, within[:, :, None], axis=2)[:, :, 0]
        column = within + np.arange(ridge.shape[1])[:, None] * tile
        high = np.arange(len(tall))[:, None, None]
        row = first + high * tile + tall[high, :, column, np.arange(bands)].argmax(axis=-1)
        for band, kind in enumerate(kinds):
            places = np.stack([one[..., band].ravel() for one in (greatest, row, column)])
            self._offers.setdefault((measure, kind), []).append(places.astype(np.float64))

    def best(self, most: int) -> Floats:
        """Return the best of each kind in turns, none twice, (place, 2) rows and columns."""
        ranked = []
        for some in self._offers.values():
            places = np.concatenate(some, axis=1)  # (row, place): measure, and where they lie
            if places.shape[1] > most:
                places = places[:, places[0] >= np.partition(places[0], -most)[-most]]
            first = places[1:, np.lexsort(places[::-1])[::-1][:most]].astype(int)
            ranked.append(list(zip(*first.tolist(), strict=True)))
        found = dict.fromkeys(place for rank in zip_longest(*ranked) for place in rank if place is not None)
        return np.array(list(found)[:most], np.float64).reshape(-1, 2)


class PixelOptics:
    """Kernels of slit and pixel over a scene's pixels, for lines that lie along y or not."""

    def __init__(self, camera: LineCamera, along_y: Sequence[bool]) -> None:
        self.slit, self.pixel = _short_kernel(camera.slit_px), _short_kernel(1.0)
        self.halo = len(self.slit) // 2 + len(self.pixel) // 2 + 1  # reach of kernels and differences [px]
        self.along_y = along_y
        self._fixed = np.float32(fixed_variance(camera))

    def noise(self, light: Radiance) -> Radiance:
        """Return one standard deviation at each light [e-]."""
        return np.sqrt(np.maximum(light, 0) + self._fixed)

    def measures(self, light: Radiance) -> Iterator[Radiance]:
        """Yield measures of light without its halo, (row, column, band) each: higher ones are probed first."""
        inner = (slice(self.halo, -self.halo), slice(self.halo, -self.halo))
        for along_y in self.along_y:
            line = 0 if along_y else 1
            seen = _blurred(_blurred(light, self.slit, 1 - line), self.pixel, line)
            level = seen[inner]
            noise = self.noise(level)
            yield level
            yield -level
            yield np.abs(light - seen)[inner] / noise
            for axis in (0, 1):
                ahead, behind = np.roll(seen, -1, axis), np.roll(seen, 1, axis)
                yield np.abs(ahead - behind)[inner] / noise
                yield np.abs(ahead + behind - 2 * seen)[inner] / noise
            rise: Radiance = np.roll(seen, -1, 0) - np.roll(seen, 1, 0)
            mixed = np.abs(np.roll(rise, -1, 1) - np.roll(rise, 1, 1))  # what a box that does not lie turned misses
            yield np.divide(mixed[inner], noise)


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


def band_groups(bands: int) -> list[slice]:
    """Return the groups of neighbouring bands whose worst stands for each of them."""
    edges = np.linspace(0, bands, min(bands, BAND_GROUPS) + 1).round().astype(int).tolist()
    return [slice(first, last) for first, last in pairwise(edges)]
