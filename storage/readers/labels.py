"""Read labels of pixels from pictures: numbers (also those of a palette) or exact colours."""

from __future__ import annotations

import colorsys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.pipeline.ground.georeference import OFF_GRID_PX, crs_name, shift_px
from spectralzoom.storage.readers.open_cubes import open_cube_source
from spectralzoom.storage.readers.scene_toml import ClassValue, Colour

NO_VALUE = int(np.iinfo(np.int64).min)  # in codes
TURNED = "orientation tag"  # in a note of the reader of pictures
MOST_LABEL = 2**53  # floats hold larger numbers with gaps
MOST_FOUND_CLASSES = 64
MIXED = (
    "JPEG, soft edges and scaling mix values; save the labels again as PNG, with hard edges and by nearest neighbour,"
    " or is this the picture itself?"
)
_MANY_UNKNOWN = 16  # values that are no class: more are mixed colours, not forgotten classes

# Eight colours that most people with colour blindness can distinguish (Okabe and Ito, 2008), in an order for maps, and
# hues, each far from the one before.
DEFAULT_COLOURS: tuple[Colour, ...] = (
    *((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167)),
    (90, 90, 90),
    *(
        (round(255 * red), round(255 * green), round(255 * blue))
        for saturation, value in ((0.8, 0.95), (0.5, 0.95), (0.8, 0.6), (0.5, 0.6))
        for red, green, blue in (colorsys.hsv_to_rgb(turn * 7 % 24 / 24, saturation, value) for turn in range(24))
    ),
)


@dataclass(frozen=True)
class Labels:
    """Class index of every pixel, and the classes."""

    index: NDArray[np.uint8]  # (y, x), 255 = unlabelled
    names: tuple[str, ...]
    values: tuple[ClassValue, ...]  # number or colour of each class in the file
    colours: NDArray[np.uint8]  # (class, 3)
    notes: tuple[str, ...] = ()
    regridded: bool = False  # from another grid than the scene's


@dataclass(frozen=True)
class LabelCodes:
    """A label file as one whole number a pixel."""

    values: NDArray[np.int64]  # (y, x), `NO_VALUE` = no value
    of_colours: bool  # a number is r * 65536 + g * 256 + b
    notes: tuple[str, ...] = ()
    regridded: bool = False  # from another grid


def load_labels(
    address: str | Path,
    shape: tuple[int, int],
    geobox: GeoBox | None = None,
    *,
    classes: Mapping[str, ClassValue],
    unlabelled: ClassValue | None = None,
    colours: Mapping[str, Colour] | None = None,
) -> Labels:
    """Read a label file of numbers or exact colours; without ``classes`` every value is a class.

    Labels with a place on the earth are resampled to the scene's ``geobox``. Raises SceneError: the file cannot be
    read, does not fit the scene, has a value that is no class, or more than 64 values without ``classes``.
    """
    by_colour = any(isinstance(value, tuple) for value in (*classes.values(), unlabelled))
    read = load_codes(address, geobox, classes=classes.values())
    codes = read.values
    if codes.shape != shape:
        why = "; its sides are exchanged: turn the labels or the picture" * (codes.shape == shape[::-1])
        why += "".join(f"; {note}" for note in read.notes if TURNED in note)
        raise SceneError(
            f"labels {address} are {codes.shape[0]} x {codes.shape[1]} px, the scene is {shape[0]} x {shape[1]} px "
            f"(y x x){why}; give labels on the scene's own pixels"
        )
    if (classes or by_colour) and by_colour != read.of_colours:
        have, want = ("colours", "numbers") if read.of_colours else ("numbers", "colours")
        raise SceneError(
            f"labels {address} have {have}, and [classes] or unlabelled has {want}; write those of the labels there, or"
            f" give labels of {want}"
        )
    none = None if unlabelled is None else _code(unlabelled)
    stated = dict(classes) or found_codes(codes, none, read.of_colours, str(address))
    negative = (codes < 0) & (codes != NO_VALUE) & ~np.isin(codes, [none or 0, *map(_code, stated.values())])
    notes = [f"{negative.sum()} px of labels {address} have negative values: unlabelled"] if negative.any() else []
    if not (by_colour or read.of_colours or map_values(tuple(stated.values()))) and stated:
        notes.append("maps number the classes from 0, as a label is not 0 to 254")
    return Labels(
        index=_index(np.where(negative, NO_VALUE, codes), stated, none, str(address)),
        names=tuple(stated),
        values=tuple(stated.values()),
        colours=class_colours(stated, colours),
        notes=(*read.notes, *notes),
        regridded=read.regridded,
    )


def found_classes(addresses: Iterable[str | Path], unlabelled: ClassValue | None = None) -> dict[str, ClassValue]:
    """Return every value of several label files as one class each (SceneError as `load_labels`)."""
    found: dict[bool, set[int]] = {}  # by whether they are colours
    files = list(addresses)
    for address in files:
        read = load_codes(address)
        values = np.unique(read.values)
        found_codes(values, None, read.of_colours, str(address))  # raises for mixed values
        found.setdefault(read.of_colours, set()).update(values.tolist())
    if len(found) > 1:
        raise SceneError(f"some of {len(files)} label files have colours, some have numbers; save all in one form")
    none = None if unlabelled is None else _code(unlabelled)
    (of_colours, codes), *_ = found.items()
    return found_codes(np.array(list(codes)), none, of_colours, f"of {len(files)} files")


def load_codes(
    address: str | Path, geobox: GeoBox | None = None, *, classes: Collection[ClassValue] = ()
) -> LabelCodes:
    """Read a file as one whole number a pixel.

    NaN is no value. So are no-data value, transparent and masked pixels, if their number is none of ``classes``.
    A file with a place is resampled to ``geobox`` by nearest neighbour. Raises SceneError: the file cannot be read,
    holds fractions, or lies beside the geobox.
    """
    source = open_cube_source(address, labels=True)
    codes, of_colours = _whole_numbers(source.read(0, source.shape[0]), address)
    notes = [f"labels {address}: {note}" for note in source.notes if TURNED in note]
    if source.nodata is not None and source.nodata.is_integer():
        void = codes == int(source.nodata) * (0x010101 if of_colours else 1)
        if void.any() and codes[void][0] not in map(_code, classes):
            codes[void] = NO_VALUE
            notes.append(f"{void.sum()} px have the label file's no-data value {source.nodata:g}: unlabelled")
    if source.void is not None:
        clear = source.void & ~np.isin(codes, [*map(_code, classes)])
        codes[clear] = NO_VALUE
        notes += [f"{clear.sum()} px of the label file are transparent or masked: unlabelled"] if clear.any() else []
    own = source.geobox
    regridded = False
    if geobox is not None and own is not None:
        shift = shift_px(geobox, own) if own.crs == geobox.crs and own.shape == geobox.shape else None
        if shift is None or max(map(abs, shift)) > OFF_GRID_PX:
            codes = _on_grid(codes, own, geobox, address)
            regridded = True
            notes.append(f"labels {address} have another grid than the scene: they are resampled by nearest neighbour")
    return LabelCodes(codes, of_colours, tuple(notes), regridded)


def _whole_numbers(values: NDArray[Any], address: str | Path) -> tuple[NDArray[np.int64], bool]:
    """Return one number a pixel for (y, x, band) values, `NO_VALUE` for NaN, and whether they are colours."""
    if values.shape[2] == 1:
        values = values[..., 0]
        if values.dtype.kind != "f":
            return values.astype(np.int64), False
        known = values[~np.isnan(values)]
        if (known != np.rint(known)).any() or (np.abs(known) > MOST_LABEL).any():
            raise SceneError(f"labels {address} hold fractions or huge numbers, expected whole ones; is it a scene?")
        return np.where(np.isnan(values), NO_VALUE, np.nan_to_num(values).astype(np.int64)), False
    if values.shape[2:] == (3,) and values.dtype == np.uint8:
        planes = values.astype(np.int64)
        return planes[..., 0] << 16 | planes[..., 1] << 8 | planes[..., 2], True
    raise SceneError(
        f"labels {address} have shape {values.shape} and type {values.dtype}; expected whole numbers (y, x) or colours "
        f"(y, x, 3) of 8 bits"
    )


def _on_grid(codes: NDArray[np.int64], own: GeoBox, grid: GeoBox, address: str | Path) -> NDArray[np.int64]:
    """Return the nearest code to each pixel of a grid, `NO_VALUE` beside the labels (SceneError: all pixels are)."""
    import odc.geo.warp as odc_warp

    values, index = np.unique(codes, return_inverse=True)
    found = np.full(tuple(grid.shape), -1, np.int32)
    odc_warp.rio_reproject(index.reshape(codes.shape).astype(np.int32), found, own, grid, "nearest", -1, -1)
    if (found < 0).all():
        raise SceneError(
            f"labels {address} do not lie on the scene: {_extent(own)}, the scene {_extent(grid)}; give the labels of "
            "this scene, or correct the CRS of one of them (gdal_edit -a_srs)"
        )
    return np.where(found < 0, NO_VALUE, values[found])


def _extent(grid: GeoBox) -> str:
    west, south, east, north = grid.extent.boundingbox
    return f"x {west:g} to {east:g}, y {south:g} to {north:g} in {crs_name(grid)}"


def _code(value: ClassValue) -> int:
    return value if isinstance(value, int) else value[0] << 16 | value[1] << 8 | value[2]


def colour_of(code: int) -> Colour:
    """Return the colour of a number of `load_codes`."""
    return code >> 16 & 255, code >> 8 & 255, code & 255


def found_codes(codes: NDArray[np.int64], none: int | None, is_colour: bool, where: str) -> dict[str, ClassValue]:
    """Return one class for each value, ascending, named ``class_N`` or ``colour_RRGGBB``."""
    found = [int(code) for code in np.unique(codes) if code != none and code >= 0]
    if len(found) > MOST_FOUND_CLASSES:
        what = "colours" if is_colour else "numbers"
        raise SceneError(
            f"labels {where} have {len(found)} different {what}, at most {MOST_FOUND_CLASSES} are taken for classes: "
            f"{MIXED}"
        )
    return {f"colour_{code:06x}": colour_of(code) for code in found} if is_colour else {f"class_{n}": n for n in found}


def _index(
    codes: NDArray[np.int64], classes: Mapping[str, ClassValue], none: int | None, where: str
) -> NDArray[np.uint8]:
    """Return the class indices of codes, 255 for none (SceneError: a code is no class, or two things at once)."""

    def shown(code: int) -> str:
        return f"colour {list(colour_of(code))}" if by_colour else f"value {code}"

    by_colour = any(isinstance(value, tuple) for value in classes.values())
    values, inverse = np.unique(codes, return_inverse=True)
    table = {_code(value): index for index, value in enumerate(classes.values())}
    if none is not None and none in table:
        name = tuple(classes)[table[none]]
        raise SceneError(f"scene.toml has {shown(none)} as unlabelled and as class {name}; keep one")
    unknown = [int(value) for value in values if int(value) not in table and value not in (none, NO_VALUE)]
    if unknown:
        count = int((codes == unknown[0]).sum())
        others = f" (and {len(unknown) - 1} more such values)" if len(unknown) > 1 else ""
        cure = MIXED if len(unknown) > _MANY_UNKNOWN else "add it to [classes] or state it as unlabelled in scene.toml"
        raise SceneError(f"labels {where} have {count} px of {shown(unknown[0])}, which is no class{others}; {cure}")
    index = np.array([table.get(int(value), UNLABELLED) for value in values], np.uint8)
    return index[inverse.reshape(codes.shape)]


def map_values(values: Sequence[ClassValue]) -> tuple[int, ...]:
    """Return the numbers of classes in maps: the values of the label files, empty unless all are 0 to 254."""
    numbers = tuple(value for value in values if isinstance(value, int) and 0 <= value < UNLABELLED)
    return numbers if len(numbers) == len(values) else ()


def class_colours(classes: Mapping[str, ClassValue], stated: Mapping[str, Colour] | None = None) -> NDArray[np.uint8]:
    """Return a colour (class, 3) for each class: as stated, as in the label file, or the next default one."""
    found = {name: value for name, value in classes.items() if isinstance(value, tuple)} | dict(stated or {})
    free = cycle([colour for colour in DEFAULT_COLOURS if colour not in found.values()] or DEFAULT_COLOURS)
    colours = [found[name] if name in found else next(free) for name in classes]
    return np.array(colours, np.uint8).reshape(-1, 3)
