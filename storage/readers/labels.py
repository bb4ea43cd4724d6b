"""Labels of the pixels of a scene: numbers, exact colours or an image with a palette."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.readers.open_cubes import load_labels_array
from storage.readers.scene_toml import ClassValue, Colour

MOST_FOUND_CLASSES = 64
MIXED = (
    "JPEG, soft edges and scaling mix values; save the labels again as PNG, with hard edges and by nearest neighbour,"
    " or is this the picture itself?"
)
_MANY_UNKNOWN = 16  # values that are no class: nobody forgot so many

# Eight colours that stay apart for most kinds of colour blindness (Okabe and Ito, 2008), in an order for maps.
_EIGHT_COLOURS = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
    (90, 90, 90),
)


@dataclass(frozen=True)
class Labels:
    """Class index of every pixel and what the classes are."""

    index: NDArray[np.uint8]  # (y, x), 255 = unlabelled
    names: tuple[str, ...]
    values: tuple[ClassValue, ...]  # number or colour of each class in the file
    colours: NDArray[np.uint8]  # (class, 3)


def load_labels(
    address: str | Path,
    shape: tuple[int, int],
    *,
    classes: Mapping[str, ClassValue],
    unlabelled: ClassValue | None = None,
) -> Labels:
    """Read a label file of numbers or exact colours; without ``classes`` every value found becomes one.

    Raises SceneError: the file cannot be read, has another size than the scene, a value that is no class (named with
    its count), or more than 64 values where no classes are stated.
    """
    by_colour = any(isinstance(value, tuple) for value in (*classes.values(), unlabelled))
    codes, is_colour = load_codes(address, by_number=bool(classes) and not by_colour)
    if codes.shape != shape:
        raise SceneError(
            f"labels {address} are {codes.shape[0]} x {codes.shape[1]} px, the scene is {shape[0]} x {shape[1]} px "
            f"(y x x); give labels on the scene's own pixels"
        )
    if by_colour and not is_colour and codes.max(initial=0) < 256:
        codes = np.where(codes < 0, codes, codes * 0x010101)  # a grey value g is the colour (g, g, g)
    none = None if unlabelled is None else _code(unlabelled)
    stated = dict(classes) or found_codes(codes, none, is_colour or by_colour, str(address))
    colours = [v if isinstance(v, tuple) else default_colour(index) for index, v in enumerate(stated.values())]
    return Labels(
        index=_index(codes, stated, none, str(address)),
        names=tuple(stated),
        values=tuple(stated.values()),
        colours=np.array(colours, np.uint8).reshape(-1, 3),
    )


def found_classes(addresses: Iterable[str | Path], unlabelled: ClassValue | None = None) -> dict[str, ClassValue]:
    """Return every value of several label files as one class each, named by it; errors as for :func:`load_labels`."""
    codes: set[int] = set()
    is_colour = isinstance(unlabelled, tuple)
    parts: list[tuple[NDArray[np.int64], bool]] = []
    for address in addresses:
        values, of_colours = load_codes(address, by_number=False)
        is_colour = is_colour or of_colours
        parts.append((np.unique(values), of_colours))
        found_codes(parts[-1][0], None, of_colours, str(address))  # refuses mixed values by the file's name
    for values, of_colours in parts:  # a grey value g is the colour (g, g, g) where others have colours
        codes |= {int(code) * (0x010101 if is_colour and not of_colours else 1) for code in values if code >= 0}
    none = None if unlabelled is None else _code(unlabelled)
    return found_codes(np.array(sorted(codes), np.int64), none, is_colour, f"of {len(parts)} files")


def load_codes(address: str | Path, *, by_number: bool) -> tuple[NDArray[np.int64], bool]:
    """Read a file as one whole number a pixel, (y, x); colours become r * 65536 + g * 256 + b, NaN becomes -1.

    The second value says whether the numbers are colours. ``by_number`` takes the indices of an image with a palette,
    and the one value of an image whose channels are alike.
    """
    values = load_labels_array(address, by_number=by_number)
    if values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim == 2:
        if values.dtype.kind != "f":
            return values.astype(np.int64), False
        rounded = np.where(np.isnan(values), -1, values)
        if not np.isfinite(rounded).all() or (rounded != np.rint(rounded)).any():
            raise SceneError(f"labels {address} hold fractions, expected whole numbers; is it a scene?")
        return rounded.astype(np.int64), False
    if values.shape[2:] == (3,) and values.dtype == np.uint8:
        if by_number and (values == values[..., :1]).all():
            return values[..., 0].astype(np.int64), False
        planes = values.astype(np.int64)
        return planes[..., 0] << 16 | planes[..., 1] << 8 | planes[..., 2], True
    raise SceneError(
        f"labels {address} have shape {values.shape} and type {values.dtype}; expected whole numbers (y, x) or colours "
        f"(y, x, 3) of 8 bits"
    )


def _code(value: ClassValue) -> int:
    return value if isinstance(value, int) else value[0] << 16 | value[1] << 8 | value[2]


def colour_of(code: int) -> Colour:
    """Return the colour that a number of `load_codes` stands for."""
    return code >> 16 & 255, code >> 8 & 255, code & 255


def found_codes(codes: NDArray[np.int64], none: int | None, is_colour: bool, where: str) -> dict[str, ClassValue]:
    """One class for each value in the file, ascending: ``class_N`` after a number, ``colour_RRGGBB`` after a colour.

    A name follows from the value alone: a file without some of the classes names the others as before.
    """
    found = [int(code) for code in np.unique(codes) if code != none and code >= 0]
    if len(found) > MOST_FOUND_CLASSES:
        what = "colours" if is_colour else "numbers"
        raise SceneError(
            f"labels {where} have {len(found)} different {what}, at most {MOST_FOUND_CLASSES} are taken for classes: "
            f"{MIXED}"
        )
    if is_colour:
        return {f"colour_{code:06x}": colour_of(code) for code in found}
    return {f"class_{code}": code for code in found}


def _index(
    codes: NDArray[np.int64], classes: Mapping[str, ClassValue], none: int | None, where: str
) -> NDArray[np.uint8]:
    values, inverse = np.unique(codes, return_inverse=True)
    table = {_code(value): index for index, value in enumerate(classes.values())}
    if none is not None and none in table:
        name = tuple(classes)[table[none]]
        raise SceneError(f"scene.toml says that {_shown(none, classes)} is unlabelled and also class {name}; keep one")
    unknown = [int(value) for value in values if int(value) not in table and value not in (none, -1)]
    if unknown:
        count = int((codes == unknown[0]).sum())
        cure = "add it to [classes] or state it as unlabelled in scene.toml"
        raise SceneError(
            f"labels {where} have {count} px of {_shown(unknown[0], classes)}, which is no class (and "
            f"{len(unknown) - 1} more such values); {MIXED if len(unknown) > _MANY_UNKNOWN else cure}"
        )
    geolocation = np.array([table.get(int(value), UNLABELLED) for value in values], np.uint8)
    return geolocation[inverse.reshape(codes.shape)]


def _shown(code: int, classes: Mapping[str, ClassValue]) -> str:
    colours = any(isinstance(value, tuple) for value in classes.values())
    return f"colour {list(colour_of(code))}" if colours else f"value {code}"


def default_colour(index: int) -> Colour:
    """Colour of class ``index`` where the file says none: eight safe ones, then hues a golden angle apart."""
    if index < len(_EIGHT_COLOURS):
        return _EIGHT_COLOURS[index]
    turn = index * 0.618033988749895 % 1.0
    red, green, blue = colorsys.hsv_to_rgb(turn, 0.55 + 0.15 * (index % 3), 0.95 - 0.2 * (index % 2))
    return round(red * 255), round(green * 255), round(blue * 255)
