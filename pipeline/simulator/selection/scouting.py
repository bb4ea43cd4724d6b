"""Where a scene is steepest, most curved, brightest and darkest, in a few telling bands: the places worth a close look.

Works on the scene's own pixels, strip by strip, with the slit's box along the scan; it is fast and right to a pixel,
and leaves the exact numbers to whoever looks closer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera, footprint_kernel
from pipeline.geometry.scan import Sweep, scene_to_sweep
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, Scene, to_bands

Light = NDArray[np.float32]
TELLING_BANDS = 4
_TILES = 8192  # at most about so many, each of which offers its best place
_CELLS = 40_000  # at which it is asked whether a sweep looks there
_LEAST_WEIGHT = 1e-3  # of a kernel's tap: enough to find places


@dataclass(frozen=True)
class _Optics:
    """Kernels of slit and pixel over a scene's pixels, and the part of the noise that light does not change [e-^2]."""

    slit: NDArray[np.float32]
    pixel: NDArray[np.float32]
    fixed_noise: float
    binning: int

    @property
    def halo(self) -> int:
        """How far kernels, differences and sums reach. [px]"""
        return len(self.slit) // 2 + len(self.pixel) // 2 + 1 + self.binning // 2

    @staticmethod
    def of(camera: LineCamera, binning: int) -> _Optics:
        """Those of a camera whose stored numbers sum so many samples."""
        return _Optics(
            _short_kernel(camera.slit_px),
            _short_kernel(1.0),
            camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12,
            binning,
        )

    def summed(self, values: Light, axis: int) -> Light:
        """Mean over the samples of a stored number about each pixel, along an axis."""
        if self.binning == 1:
            return values
        steps = np.arange(self.binning) - self.binning // 2
        total: Light = sum((np.roll(values, -step, axis) for step in steps.tolist()), np.zeros_like(values))
        total /= np.float32(self.binning)
        return total


def telling_places(scene: Scene, camera: LineCamera, sweeps: Sequence[Sweep], most: int = 200) -> NDArray[np.float64]:
    """Find the places where light changes most over its noise, and where there is most and least of it.

    Parameters
    ----------
    sweeps
        What will be looked at: other parts of the scene do not count. All sum as many samples to a stored number.
    most
        How many places, each in a tile of its own for one measure and band; the worst of every measure first.

    Returns
    -------
    (place, 2) rows and columns, integers as floats. [px]

    Raises
    ------
    SceneError : the scene holds a number that is not finite; the message says where.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    bands, optics = telling_bands(spectra), _Optics.of(camera, sweeps[0].binning)
    turned = tuple(sorted({sweep.along == "y" for sweep in sweeps}))
    reached, cell = _reached(scene.shape, camera, sweeps)
    tile = max(8, math.ceil(math.sqrt(scene.shape[0] * scene.shape[1] / _TILES)))
    best: dict[tuple[int, int], list[tuple[float, int, int]]] = {}
    for first, planes in _strips(scene, tile, optics.halo):
        _check_finite(scene, planes, first - optics.halo)
        rows = np.arange(first, min(first + tile, scene.shape[0])) // cell
        taken = np.repeat(reached[rows], cell, axis=1)[:, : scene.shape[1]]
        if not taken.any():
            continue
        light = _some_bands(planes, spectra, bands)
        for sort, worth in enumerate(_worths(light, optics, turned)):
            for band in range(worth.shape[2]):
                shown = np.where(taken, worth[..., band], -np.inf)
                best.setdefault((sort, band), []).extend(_tile_maxima(shown, first, tile))
    ranked = [[one[1:] for one in sorted(places, reverse=True) if one[0] > -np.inf] for places in best.values()]
    found = dict.fromkeys(place for rank in zip_longest(*ranked) for place in rank if place is not None)
    return np.array(list(found)[:most], np.float64).reshape(-1, 2)


def _reached(shape: tuple[int, int], camera: LineCamera, sweeps: Sequence[Sweep]) -> tuple[NDArray[np.bool_], int]:
    """Give which square cells of the scene any sweep sees, and their size [px]."""
    cell = max(2, math.ceil(math.sqrt(shape[0] * shape[1] / _CELLS)))
    y, x = (np.arange(0, size, cell) + (cell - size) / 2 for size in shape)
    reached = np.zeros((len(y), len(x)), np.bool_)
    for sweep in sweeps:
        along, scan = (y[:, None], x[None]) if sweep.along == "y" else (x[None], y[:, None])
        held = replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)
        line, sample = np.moveaxis(scene_to_sweep(held, camera, along, scan), -1, 0)
        slack = 1 + cell / 2
        reached |= (np.abs(line - (held.lines - 1) / 2) <= held.lines / 2 + slack) & (
            np.abs(sample - (camera.samples - 1) / 2) <= camera.samples / 2 + slack
        )
    return reached, cell


def telling_bands(spectra: Light) -> NDArray[np.intp]:
    """Choose the brightest band and those least like the ones chosen, at most ``TELLING_BANDS``."""
    columns = np.atleast_2d(spectra) if spectra.ndim == 2 else spectra[None]
    if spectra.ndim == 1:  # every band has a plane of its own, which says nothing of its kin: spread them
        return np.unique(np.linspace(0, len(spectra) - 1, TELLING_BANDS).round().astype(np.intp))
    chosen = [int(columns.max(axis=0).argmax())]
    for _ in range(min(TELLING_BANDS, columns.shape[1]) - 1):
        gap = np.min([np.abs(columns - columns[:, [one]]).max(axis=0) for one in chosen], axis=0)
        chosen.append(int(gap.argmax()))
    return np.unique(chosen)


def _strips(scene: Scene, tile: int, halo: int) -> Iterator[tuple[int, Light]]:
    """Give the first row and the components of strips of ``tile`` rows, with a halo of repeated edges all around."""
    rows, columns = scene.shape
    across = np.arange(-halo, columns + halo).clip(0, columns - 1)
    for first in range(0, rows, tile):
        down = np.arange(first - halo, min(first + tile, rows) + halo).clip(0, rows - 1)
        if isinstance(scene, RasterScene):
            inner = scene.planes[down[0] : down[-1] + 1][down - down[0]]
            yield first, np.pad(inner, ((0, 0), (halo, halo), (0, 0)), mode="edge")
        else:
            y, x = (axis.ravel().astype(np.float64) for axis in np.meshgrid(down, across, indexing="ij"))
            yield first, scene.sample(y, x).reshape(len(down), len(across), -1)


def _some_bands(planes: Light, spectra: Light, bands: NDArray[np.intp]) -> Light:
    if spectra.ndim == 1:
        return to_bands(planes[..., bands], spectra[bands])
    return to_bands(planes, np.ascontiguousarray(spectra[:, bands]))


def _check_finite(scene: Scene, planes: Light, first: int) -> None:
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


def _worths(light: Light, rig: _Optics, turned: tuple[bool, ...]) -> Iterator[Light]:
    """Measures of the strip without its halo, (row, column, band) each: the higher, the more worth a look.

    Where samples are summed, sizes are averaged along the line, as the probe does.
    """
    inner = (slice(rig.halo, -rig.halo), slice(rig.halo, -rig.halo))
    for along_y in turned:
        line = 0 if along_y else 1
        seen = _blurred(_blurred(light, rig.slit, 1 - line), rig.pixel, line)
        level = rig.summed(seen, line)[inner]
        noise: Light = np.sqrt(np.maximum(level, 0) + np.float32(rig.fixed_noise))
        yield level
        yield -level
        yield rig.summed(np.abs(light - seen), line)[inner] / noise
        for axis in (0, 1):
            ahead, behind = np.roll(seen, -1, axis), np.roll(seen, 1, axis)
            yield rig.summed(np.abs(ahead - behind), line)[inner] / noise
            yield rig.summed(np.abs(ahead + behind - 2 * seen), line)[inner] / noise
        yield np.divide(rig.summed(_mixed(seen), line)[inner], noise)  # what a box that does not lie turned misses


def _mixed(seen: Light) -> Light:
    """Mixed second difference along both axes, by size."""
    rise: Light = np.roll(seen, -1, 0) - np.roll(seen, 1, 0)
    mixed: Light = np.abs(np.roll(rise, -1, 1) - np.roll(rise, 1, 1))
    return mixed


def _short_kernel(width_px: float) -> NDArray[np.float32]:
    kernel = footprint_kernel(width_px) if width_px > 0 else np.ones(1)
    half = len(kernel) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(kernel) > _LEAST_WEIGHT) - half).max())
    return kernel[half - reach : half + reach + 1].astype(np.float32)


def _blurred(light: Light, kernel: NDArray[np.float32], axis: int) -> Light:
    half = len(kernel) // 2
    total: Light = kernel[half] * light
    for offset in range(1, half + 1):  # kernels are symmetric
        total += kernel[half + offset] * (np.roll(light, offset, axis) + np.roll(light, -offset, axis))
    return total


def _tile_maxima(worth: Light, first: int, tile: int) -> list[tuple[float, int, int]]:
    """Greatest value of every tile and its place."""
    columns = worth.shape[1]
    best_row = worth.argmax(axis=0)
    ridge = worth[best_row, np.arange(columns)]
    found = []
    for start in range(0, columns, tile):
        column = start + int(ridge[start : start + tile].argmax())
        found.append((float(ridge[column]), first + int(best_row[column]), column))
    return found
