"""Open rasters whose pixels are taken as they are: one file, or tiles of a folder or a glob side by side.

Their pixels are read a block of rows at a time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED, SceneGrid
from pipeline.ground.georeference import OFF_GRID_PX, shift_px
from pipeline.lazy import deferred
from storage.parallel.pool import RESERVED_BYTES, memory_refusal
from storage.readers.envi_files import is_headwall_folder
from storage.readers.label_files import (
    folders_within,
    image_folder,
    is_label_name,
    listed_names,
    match_folder,
    read_labels,
    scene_entries,
)
from storage.readers.labels import Labels
from storage.readers.open_cubes import reader_of, split_variable
from storage.readers.scene_files import SceneFile, open_scene_file
from storage.readers.scene_toml import find_scene_settings

if TYPE_CHECKING:
    import odc.geo.geobox as odc_geobox
    from odc.geo.geobox import GeoBox
else:
    odc_geobox = deferred("odc.geo.geobox")

WILD = "*?["
APART_NM = 0.1  # wavelengths of one band
COPIES = 6  # of a block in memory while it is read and processed
FRACTION = 4  # of the free memory for a block: larger ones are no faster
Report = Callable[[float], None]


def open_raster(
    address: str | Path,
    *,
    labels: str | Path | None = None,
    bands: Sequence[int] | None = None,
    wavelengths: Sequence[float] | None = None,
) -> SceneFile:
    """Open a file, or the tiles of a folder or a glob as one field, to be read some rows at a time.

    The first tile by name with a value wins in overlaps; pixels without a tile are missing. ``labels`` are on the
    pixels of the whole field. Raises SceneError, WavelengthError: as `open_scene_file`, or the tiles have different
    grids or bands, or no place.
    """
    files = tiles_of(address)
    if len(files) == 1:
        return open_scene_file(files[0], labels=labels, bands=bands, wavelengths=wavelengths)
    opened = [open_scene_file(file, bands=bands, wavelengths=wavelengths) for file in files]
    return _side_by_side(Path(address), opened, labels)


def is_glob(address: str | Path) -> bool:
    """Return whether an address is a pattern and no existing file."""
    return any(sign in str(address) for sign in WILD) and not split_variable(address)[0].exists()


def tiles_of(address: str | Path) -> tuple[str, ...]:
    """Return the files of an address, sorted: the file itself, or the images of a folder or a glob without labels.

    A folder that is itself a cube (Zarr, a Headwall camera) counts as a file. Raises SceneError: there is no image.
    """
    path, _ = split_variable(address)
    if is_glob(address):
        parts = Path(address).parts
        fixed = next(number for number, part in enumerate(parts) if any(sign in part for sign in WILD))
        named = sorted(Path(*parts[:fixed]).glob("/".join(parts[fixed:])))
        beside = {entry for folder in {one.parent for one in named} for entry in scene_entries(folder)}
        found = [one for one in named if one in beside and not is_label_name(one)]
        if not found:
            raise SceneError(f"--scene {address} names no image; check the pattern (seen from {Path.cwd()})")
        return tuple(map(str, found))
    if not path.is_dir() or reader_of(address) != "headwall" or is_headwall_folder(path):
        return (str(address),)
    images = match_folder(image_folder(path)).images
    if not images:
        raise SceneError(
            f"{path} holds no image that is read; give a file, a folder or a glob of tiles{folders_within(path)}"
        )
    return tuple(map(str, images))


@dataclass(frozen=True)
class _Tile:
    """A tile with its first row and column in the field."""

    scene: SceneFile
    row: int
    column: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Return its rows and columns in the field."""
        height, width = self.scene.shape
        return slice(self.row, self.row + height), slice(self.column, self.column + width)


def _side_by_side(address: Path, opened: Sequence[SceneFile], labels: str | Path | None) -> SceneFile:
    """Place tiles on the grid of the first, as one field."""
    first = opened[0]
    for other in opened[1:]:
        _check_bands(first, other)
    tiles, geobox = _placed(opened)
    shape = (int(geobox.shape[0]), int(geobox.shape[1]))
    missing, covered, filled = np.ones(shape, np.bool_), np.zeros(shape, np.bool_), sum(one.filled_px for one in opened)
    shared = 0
    for tile in tiles:
        there = ~tile.scene.missing
        shared += int(np.count_nonzero(there & ~missing[tile.place]))
        missing[tile.place] &= ~there
        covered[tile.place] = True
    beside = int(np.count_nonzero(~covered))
    notes = [f"{len(tiles)} tiles of one grid are one field: {listed_names([one.path for one in opened])}"]
    notes += [f"of {shared} pixels that several tiles show, the first by name wins"] if shared else []
    notes += [f"{beside} pixels lie between the tiles and have no value"] if beside else []
    notes += list(dict.fromkeys(note for one in opened for note in one.provenance))
    if labels is None:
        found = _merged_labels(tiles, shape, notes)
    else:
        found = read_labels(labels, shape, geobox, find_scene_settings(first.path))
        notes += found.notes
    places = [(tile.scene.light_hash, tile.row, tile.column) for tile in tiles]
    light_hash = hashlib.sha256(json.dumps(places).encode()).hexdigest()

    def read(start: int, stop: int) -> NDArray[np.float32]:
        return _rows_of(tiles, shape[1], len(first.wavelength_nm), start, stop)

    folder = address.parent if is_glob(address) else address
    scene = SceneFile(
        name="tiles" if is_glob(folder) else folder.resolve().name or "tiles",
        path=address,
        wavelength_nm=first.wavelength_nm,
        fwhm_nm=first.fwhm_nm,
        light_hash=light_hash,
        content=tuple(part for one in opened for part in one.content),
        provenance=tuple(notes),
        geobox=geobox,
        shape=shape,
        read=read,
        missing=missing,
        filled_px=filled + beside,
    )
    return scene.labelled(found, by_name=labels is None)


def _rows_of(tiles: Sequence[_Tile], width: int, bands: int, start: int, stop: int) -> NDArray[np.float32]:
    """Read rows of the field, (y, x, band); the first tile with a value wins."""
    out = np.full((stop - start, width, bands), np.nan, np.float32)
    free = np.ones((stop - start, width), np.bool_)
    for tile in tiles:
        rows, columns = tile.place
        above, below = max(start, rows.start), min(stop, rows.stop)
        if above >= below:
            continue
        part = np.s_[above - start : below - start, columns]
        there = ~tile.scene.missing[above - rows.start : below - rows.start] & free[part]
        if there.any():
            out[part][there] = tile.scene.read(above - rows.start, below - rows.start)[there]
            free[part] &= ~there
    return out


def _check_bands(first: SceneFile, other: SceneFile) -> None:
    """Refuse tiles with different bands (SceneError)."""
    one, two = first.wavelength_nm, other.wavelength_nm
    if len(one) != len(two) or not np.allclose(one, two, rtol=0, atol=APART_NM):
        raise SceneError(
            f"the tiles {first.path} and {other.path} have other bands, {len(one)} from {one[0]:.1f} nm on and "
            f"{len(two)} from {two[0]:.1f} nm on: tiles of one field have the same; survey them one by one, or choose "
            "alike bands with --bands"
        )


def _placed(opened: Sequence[SceneFile]) -> tuple[list[_Tile], GeoBox]:
    """Return the tiles with their places, and the grid of the field (SceneError: they do not lie on one grid)."""
    first, origins = opened[0].geobox, [_origin(opened[0], one) for one in opened]
    assert first is not None
    top, left = (min(origin[axis] for origin in origins) for axis in (0, 1))
    tiles = [_Tile(one, row - top, column - left) for one, (row, column) in zip(opened, origins, strict=True)]
    shape = max(tile.place[0].stop for tile in tiles), max(tile.place[1].stop for tile in tiles)
    return tiles, odc_geobox.GeoBox(shape, first.affine * Affine.translation(left, top), first.crs)


def _origin(first: SceneFile, other: SceneFile) -> tuple[int, int]:
    """Return the row and column of a tile on the grid of the first (SceneError: it does not lie on it)."""
    for one in (first, other):
        if one.geobox is None or one.geobox.crs is None:
            raise SceneError(
                f"tiles are one field if all have a place on the earth, and {one.path} has none: survey them one by"
                " one, or give them one (gdal_translate -a_srs -a_ullr)"
            )
    grid, own = first.geobox, other.geobox
    assert grid is not None
    assert own is not None
    shift = shift_px(grid, own) if own.crs == grid.crs else None
    if shift is not None and max(abs(at - round(at)) for at in shift) <= OFF_GRID_PX:
        return round(shift[1]), round(shift[0])
    if own.crs != grid.crs:
        problem = f"lie in {grid.crs} and {own.crs}: tiles of one field have one CRS"
    elif shift is None:
        sizes = " and ".join(f"{abs(one.affine.a):g} x {abs(one.affine.e):g}" for one in (grid, own))
        problem = f"have pixels of {sizes}, or turned ones: tiles of one field have the same"
    else:
        off = " and ".join(f"{at - round(at):.2f}" for at in shift)
        problem = f"have pixels that lie {off} px (x, y) apart: tiles of one field lie on one grid"
    raise SceneError(
        f"the tiles {first.path} and {other.path} {problem}; warp them onto one grid (gdalwarp -t_srs -tr -tap), or "
        "survey them one by one"
    )


def _merged_labels(tiles: Sequence[_Tile], shape: tuple[int, int], notes: list[str]) -> Labels | None:
    """Return the tiles' own labels side by side; None without any, or with a note if their classes differ."""
    labelled = [tile.scene for tile in tiles if tile.scene.labels is not None]
    if not labelled:
        return None
    like = labelled[0]
    if any((one.class_names, one.class_values) != (like.class_names, like.class_values) for one in labelled):
        notes.append(
            "the labels beside the tiles are left out: they have other classes from tile to tile; name all of them in a"
            " table [classes] of the scene.toml beside the tiles"
        )
        return None
    index, free = np.full(shape, UNLABELLED, np.uint8), np.ones(shape, np.bool_)
    for tile in tiles:
        there = free[tile.place] & ~tile.scene.missing
        if tile.scene.labels is not None:
            index[tile.place][there] = tile.scene.labels[there]
        free[tile.place] &= ~there
    return Labels(index, like.class_names, like.class_values, like.class_colours)


# --- pixels as a survey's images --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RasterPixels:
    """The pixels of a raster: ``read`` returns rows (y, x, band) in float32, NaN without a value."""

    read: Callable[[int, int], NDArray[np.float32]]
    missing: NDArray[np.bool_]  # (y, x) without a value
    bands: int
    grid: SceneGrid

    def rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """Read rows of the raster, NaN in every band of the missing pixels."""
        values = self.read(start, stop)
        values[self.missing[start:stop]] = np.nan
        return values

    def rows_at_once(self, memory: int) -> int:
        """Return the rows to read at a time: whole rows of patches (SettingsError: one does not fit the memory)."""
        grid = self.grid
        deep, row = grid.patch * grid.factor, COPIES * grid.width * self.bands * 4
        least = RESERVED_BYTES + deep * row
        if least > memory:
            why = f"{deep} rows of a raster of {grid.width} px and {self.bands} bands are read at a time"
            raise memory_refusal(least, memory, why)
        return deep * max(1, (memory - RESERVED_BYTES) // FRACTION // (deep * row))


def patches_of(
    raster: RasterPixels, patch_index: NDArray[np.integer], *, memory: int
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.bool_]]]:
    """Yield the patches of ascending ``patch_index`` by rows: values (patch, y, x, band), validity (patch, y, x).

    Raises SettingsError: one row of patches does not fit the memory.
    """
    grid = raster.grid
    p, (_, across) = grid.patch, grid.patch_shape
    deep = raster.rows_at_once(memory) // p
    row, column = np.divmod(patch_index, across)
    for first in sorted({int(one) // deep * deep for one in np.unique(row)}):
        here = (row >= first) & (row < first + deep)
        top, below = first * p, min((int(row[here].max()) + 1) * p, grid.height)
        pixels = raster.rows(top, below)
        beyond = [(0, -len(pixels) % p), (0, across * p - grid.width)]
        valid = np.pad(~raster.missing[top:below], beyond)
        pixels = np.pad(pixels, [*beyond, (0, 0)], mode="edge")
        cut = pixels.reshape(-1, p, across, p, raster.bands).swapaxes(1, 2)
        place = row[here] - first, column[here]
        yield cut[place], valid.reshape(-1, p, across, p).swapaxes(1, 2)[place]
