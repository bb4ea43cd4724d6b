"""What the model does with one region of a field on disk: scores it, or draws its part of the map.

A worker gets paths and numbers, opens what it needs, and keeps one region in memory: arrays never travel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.policies.policies import IMAGE_POLICIES, NETWORK_POLICIES, score_seats
from models.policies.vgg_file import VggFile
from models.reading.inference import CoarseLook, Glance, look_coarsely, read_glance, segment
from models.reading.regions import Region
from models.weights.files import Weights, content_key, load_weights
from pipeline.errors import WeightsError
from pipeline.readings import beyond_range, readings_alone
from storage.arrays.class_maps import write_class_tile
from storage.arrays.mosaics import PATCHES_A_SHARD, PatchStore, mosaic_strips, mosaic_wavelengths, open_patches
from storage.arrays.tile_work import let_tiles_go

Strange = tuple[int, int]  # coarse pixels, and fine ones, with a value that is no reading


@dataclass(frozen=True)
class WeightsFile:
    """Weights by their path, and the hash that they had when the survey began."""

    path: Path
    key: str

    def load(self) -> Weights:
        """Read them, once a process. Raises WeightsError where the file has changed since."""
        return _weights_at(self)


@lru_cache(maxsize=1)
def _weights_at(file: WeightsFile) -> Weights:
    weights = load_weights(file.path)
    if content_key(file.path) != file.key:
        raise WeightsError(f"the weights {file.path} have changed since the survey began; start it again")
    return weights


@dataclass(frozen=True)
class Scoring:
    """Scores seats by the glance at a region: what a worker needs for that."""

    weights: WeightsFile
    mosaic: Path
    policy: str
    vgg: VggFile | None = None

    def __call__(self, region: Region) -> NDArray[np.float64]:
        """Scores of the seats that are kept, (seat_y, seat_x)."""
        let_tiles_go()
        weights = self.weights.load()
        look = look_at(weights, self.mosaic, region)
        seen = unread(look) if self.policy in IMAGE_POLICIES + NETWORK_POLICIES else read_glance(weights, look)
        network = None if self.vgg is None else self.vgg.saliency(weights)
        return region.crop_seats(score_seats(self.policy, seen, network=network))


@dataclass(frozen=True)
class Drawing:
    """Draws a region of the class map into its store: what a worker needs for that."""

    weights: WeightsFile
    mosaic: Path
    patches: Path
    out: Path

    def __call__(self, region: Region) -> Strange:
        """Read what was seen of the region coarsely and finely, and store the part of the map that is kept."""
        let_tiles_go()
        weights, store = self.weights.load(), open_patches(self.patches)
        seen = look_at(weights, self.mosaic, region)
        strange = np.zeros(region.grid.seat_shape, np.int64)
        seats, columns = seat_columns(weights, store, store.wavelength_nm, seen, region, strange=strange.ravel())
        drawn = segment(weights, seen, columns, seats)
        origin = region.kept.top, region.kept.left
        write_class_tile(self.out, origin, region.crop(drawn.classes), region.crop(drawn.confidence))
        coarse = 0 if seen.strange is None else int(np.count_nonzero(region.crop_coarse(seen.strange)))
        return coarse, int(region.crop_seats(strange).sum())


def unread(look: CoarseLook) -> Glance:
    """Stand in for the glance where nothing but the coarse image is asked for."""
    return Glance(look.grid, look.columns, np.empty((0, 0, 0), np.float32), origin=look.origin)


def look_at(weights: Weights, mosaic: Path, region: Region) -> CoarseLook:
    """Read the part of a stored coarse mosaic that a region needs, some rows at a time."""
    strips = mosaic_strips(mosaic, region.coarse.rows, region.coarse.columns)
    return look_coarsely(weights, strips, mosaic_wavelengths(mosaic), region.grid, origin=region.origin)


def seat_columns(
    weights: Weights,
    store: PatchStore,
    wavelength_nm: NDArray[np.float64],
    seen: CoarseLook,
    region: Region,
    *,
    strange: NDArray[np.int64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Numbers and normalised spectral columns (seat, p, p, column) of a region's patches, some read at a time.

    A mirror that looks beside the plan leaves pixels of a seat unseen: they take the columns of the coarse pixel over
    them, and so do those with a number that is no reading in every band. A seat of which nothing was seen is left out.
    Pixels with such a number are counted in ``strange``, (seat,) of the region's scene.
    """
    numbers = region.numbers_here(store.seats)
    here = np.flatnonzero(numbers >= 0)
    p, count, kept = region.field.patch, len(here), 0
    seats, columns = np.empty(count, np.int64), np.empty((count, p, p, weights.basis.columns), np.float32)
    for first in range(0, count, PATCHES_A_SHARD):
        entries = here[first : first + PATCHES_A_SHARD]
        values, most = store.pick(entries), weights.normalisation.most_value
        if (wild := beyond_range(values, most)) is not None and strange is not None:
            strange[numbers[entries]] = wild.any(axis=-1).sum(axis=(1, 2))
        values = readings_alone(values, most)
        reached = np.asarray(np.isfinite(values).any(axis=-1), np.bool_)
        some = np.asarray(reached.any(axis=(1, 2)), np.bool_)
        part = slice(kept, kept := kept + int(some.sum()))
        seats[part] = numbers[entries][some]
        columns[part] = weights.columns(values[some], wavelength_nm)
        _fill_unseen(columns[part], seats[part], reached[some], seen)
    return seats[:kept], columns[:kept]


def _fill_unseen(
    columns: NDArray[np.float32], seats: NDArray[np.int64], reached: NDArray[np.bool_], seen: CoarseLook
) -> None:
    """Put the columns of the coarse look, in place, where no line reached a pixel of a seat."""
    pixel = np.arange(seen.grid.patch)
    for patch, seat, there in zip(columns, seats, reached, strict=True):
        if not there.all():
            y, x = seen.grid.seat_origin(seat)[..., None] + pixel
            coarse = seen.columns[np.ix_(y // seen.grid.factor, x // seen.grid.factor)]
            patch[~there] = coarse[~there]
