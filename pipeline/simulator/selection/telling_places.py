"""Where a scene is steepest, most curved, brightest and darkest, in and beside what sweeps see: worth a close look.

Works on the scene's own pixels, strip by strip, with the slit's box along the scan; it is fast and right to a pixel,
and leaves the exact numbers to whoever looks closer. Of components a few telling bands stand for all; where bands have
planes of their own, each is looked at: see `band_tiles`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands
from pipeline.simulator.selection.band_tiles import BandTiles, Ranking
from pipeline.simulator.selection.footprint_worth import PixelOptics
from pipeline.simulator.selection.reached_cells import ReachedCells

Light = NDArray[np.float32]
Floats = NDArray[np.float64]
TELLING_BANDS = 4
_TILES = 8192  # at most about so many, each of which offers its best place
_TILES_HIGH = 3  # strips: what is made of one stays in the processor's cache
_FAR = -1  # number of what lies beyond all reaches: of it only the brightest and the darkest count


@dataclass(frozen=True)
class TellingPlaces:
    """Places as rows and columns, integers as floats, (place, 2) each, the worst of every measure first. [px]

    ``beside`` are those within the first, the second, ... reach of the sweeps and not within the one before; ``far``
    the brightest and the darkest of what lies beyond.
    """

    seen: Floats
    beside: tuple[Floats, ...]
    far: Floats


@dataclass(frozen=True)
class _Strip:
    """Rows from ``first`` on with a halo about them, and which of its pixels each tier holds, by its number."""

    first: int
    planes: Light
    tiers: dict[int, NDArray[np.bool_]]


def telling_places(
    scene: RasterScene,
    camera: LineCamera,
    sweeps: Sequence[Sweep],
    cells: ReachedCells,
    reaches: Sequence[float],
    most: Sequence[int],
) -> TellingPlaces:
    """Find the places where light changes most over its noise, and where there is most and least of it.

    ``sweeps`` are of one binning, ``cells`` say how far they see, ``reaches`` how far beside them to look as well [px];
    ``most`` places at most are found where they see, within each reach, and beyond, each in a tile of its own for one
    measure and band. Raises SceneError: the scene holds a number that is not finite.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    optics = PixelOptics.of(camera, sweeps[0].binning, tuple(sorted({sweep.along == "y" for sweep in sweeps})))
    tile = max(8, math.ceil(math.sqrt(scene.shape[0] * scene.shape[1] / _TILES)))
    ranking = Ranking()
    own_planes = spectra.ndim == 1
    tiles = BandTiles(scene, spectra, optics, tile) if own_planes and len(spectra) > TELLING_BANDS else None
    bands = telling_bands(spectra)
    high = tile if tiles is not None else _TILES_HIGH * tile
    for strip in _strips(scene, high, optics.halo, cells, reaches):
        _check_finite(scene, strip.planes, strip.first - optics.halo)
        if not any(taken.any() for taken in strip.tiers.values()):
            continue
        if tiles is not None:
            tiles.add(strip.first, strip.planes, strip.tiers)
            continue
        some = spectra[bands] if own_planes else np.ascontiguousarray(spectra[:, bands])
        light = to_bands(strip.planes[..., bands] if own_planes else strip.planes, some)
        _rank(ranking, strip, light, optics, tile)
    if tiles is not None:
        tiles.rank(ranking, cells, (0.0, *reaches))
    found = [ranking.best(tier, count) for tier, count in zip((*range(len(reaches) + 1), _FAR), most, strict=True)]
    return TellingPlaces(found[0], tuple(found[1:-1]), found[-1])


def _rank(ranking: Ranking, strip: _Strip, light: Light, optics: PixelOptics, tile: int) -> None:
    near = {tier: taken for tier, taken in strip.tiers.items() if tier != _FAR and taken.any()}
    for sort, worth in enumerate(optics.worths(light) if near else ()):
        for tier, taken in near.items():
            _offer(ranking, (tier, sort), worth, taken, strip.first, tile)
    far, halo = strip.tiers.get(_FAR), optics.halo
    if far is not None and far.any():
        inner = light[halo:-halo, halo:-halo]
        for sort, worth in enumerate((inner, -inner)):
            _offer(ranking, (_FAR, sort), worth, far, strip.first, tile)


def _offer(
    ranking: Ranking, kind: tuple[int, int], worth: Light, taken: NDArray[np.bool_], first: int, tile: int
) -> None:
    """Offer the greatest of every tile and band; worth (row, column, band) of the strip that begins at a row."""
    shown = worth if taken.all() else np.where(taken[..., None], worth, np.float32(-np.inf))
    (rows, columns, bands), none = worth.shape, -np.inf
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


def telling_bands(spectra: Light) -> NDArray[np.intp]:
    """Choose the brightest band and those least like the ones chosen, at most ``TELLING_BANDS``.

    Of bands with planes of their own, which do not tell of each other: as many, evenly.
    """
    if spectra.ndim == 1:
        return np.unique(np.linspace(0, len(spectra) - 1, TELLING_BANDS).round().astype(np.intp))
    chosen = [int(spectra.max(axis=0).argmax())]
    for _ in range(min(TELLING_BANDS, spectra.shape[1]) - 1):
        gap = np.min([np.abs(spectra - spectra[:, [one]]).max(axis=0) for one in chosen], axis=0)
        chosen.append(int(gap.argmax()))
    return np.unique(chosen)


def _strips(
    scene: RasterScene, high: int, halo: int, cells: ReachedCells, reaches: Sequence[float]
) -> Iterator[_Strip]:
    rows, ends = scene.shape[0], [-1.0, 0.0, *reaches]
    for first in range(0, rows, high):
        down = np.arange(first - halo, min(first + high, rows) + halo).clip(0, rows - 1)
        inner = scene.planes[down[0] : down[-1] + 1][down - down[0]]
        tiers = {0: cells.rows_within(first, first + high, -1.0, 0.0)}
        if not cells.covers:
            numbers = range(1, len(reaches) + 1)
            tiers |= {one: cells.rows_within(first, first + high, ends[one], ends[one + 1]) for one in numbers}
            tiers[_FAR] = cells.rows_within(first, first + high, ends[-1], np.inf)
        yield _Strip(first, np.pad(inner, ((0, 0), (halo, halo), (0, 0)), mode="edge"), tiers)


def _check_finite(scene: RasterScene, planes: Light, first: int) -> None:
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
