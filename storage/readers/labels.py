"""Label and mask files: colours or numbers in, class indices out. 255 means unlabelled.

Two public sets of labelled road scenes are read as their files lie once unpacked. HyKo2 (Winkens and others, University
of Koblenz): one .mat file a frame, with ``data`` (y, x, band), ``wavelengths`` and labels of two kinds; the names and
the meaning of the numbers are taken from hsdatasets and hyperseg by N. Theisen, of the same university. RANUS 1.0 (Choe
and others, "RANUS: RGB and NIR Urban Scene Dataset for Deep Scene Parsing", 2018): folders ``RGB``, ``NIR`` and ``GT``
with the same numbered folders in each, and files that differ in ``_rgb``, ``_nir``, ``_gt`` alone; names and colours of
its classes are taken from public programs that prepare the set. Neither set was at hand: both readers are tested on
small files made in these layouts, and on nothing else.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.readers.array_files import NAMED_ENDINGS, check_picture, variable_names
from storage.readers.cube_sources import NEAR_INFRARED_NM, RGB_NM, Raster
from storage.readers.raster_files import load_raster, split_variable
from storage.readers.scene_toml import BandWavelengths, ClassValue, Colour

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
    stated = dict(classes) or _found_classes(codes, none, is_colour or by_colour, str(address))
    colours = [v if isinstance(v, tuple) else default_colour(index) for index, v in enumerate(stated.values())]
    return Labels(
        index=_index(codes, stated, none, str(address)),
        names=tuple(stated),
        values=tuple(stated.values()),
        colours=np.array(colours, np.uint8).reshape(-1, 3),
    )


def found_classes(addresses: Iterable[str | Path], unlabelled: ClassValue | None = None) -> dict[str, ClassValue]:
    """Every value of several label files as one class each, named by it; errors as for :func:`load_labels`."""
    codes: set[int] = set()
    is_colour = isinstance(unlabelled, tuple)
    parts: list[tuple[NDArray[np.int64], bool]] = []
    for address in addresses:
        values, of_colours = load_codes(address, by_number=False)
        is_colour = is_colour or of_colours
        parts.append((np.unique(values), of_colours))
        if len(parts[-1][0]) > MOST_FOUND_CLASSES:
            _found_classes(parts[-1][0], None, of_colours, str(address))  # refuses this file by its name
    for values, of_colours in parts:  # a grey value g is the colour (g, g, g) where others have colours
        codes |= {int(code) * (0x010101 if is_colour and not of_colours else 1) for code in values if code >= 0}
    none = None if unlabelled is None else _code(unlabelled)
    return _found_classes(np.array(sorted(codes), np.int64), none, is_colour, f"of {len(parts)} files")


def load_codes(address: str | Path, *, by_number: bool) -> tuple[NDArray[np.int64], bool]:
    """Read a file as one whole number a pixel, (y, x); colours become r * 65536 + g * 256 + b, NaN becomes -1.

    The second value says whether the numbers are colours. ``by_number`` takes the indices of an image with a palette,
    and the one value of an image whose channels are alike.
    """
    raster = load_raster(address, dims=2)
    values = raster.indices if by_number and raster.indices is not None else raster.values
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim == 2:
        if values.dtype.kind != "f":
            return values.astype(np.int64), False
        rounded = np.where(np.isnan(values), -1, values)
        if not np.isfinite(rounded).all() or (rounded != np.rint(rounded)).any():
            raise SceneError(f"labels {address} hold fractions, expected whole numbers; is it a scene?")
        return rounded.astype(np.int64), False
    if values.ndim == 3 and values.shape[2] == 3 and values.dtype == np.uint8:
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


def _colour(code: int) -> Colour:
    return code >> 16 & 255, code >> 8 & 255, code & 255


def value_of_code(code: int, *, is_colour: bool) -> ClassValue:
    """What a number of `load_codes` is in its file: itself, or a colour."""
    return _colour(code) if is_colour else code


def shown_value(code: int, *, is_colour: bool) -> str:
    """The same, in words."""
    return f"colour {list(_colour(int(code)))}" if is_colour else f"value {code}"


def _found_classes(codes: NDArray[np.int64], none: int | None, is_colour: bool, where: str) -> dict[str, ClassValue]:
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
        return {f"colour_{code:06x}": _colour(code) for code in found}
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
    lookup = np.array([table.get(int(value), UNLABELLED) for value in values], np.uint8)
    return lookup[inverse.reshape(codes.shape)]


def _shown(code: int, classes: Mapping[str, ClassValue]) -> str:
    return shown_value(code, is_colour=any(isinstance(value, tuple) for value in classes.values()))


def default_colour(index: int) -> Colour:
    """Colour of class ``index`` where the file says none: eight safe ones, then hues a golden angle apart."""
    if index < len(_EIGHT_COLOURS):
        return _EIGHT_COLOURS[index]
    turn = index * 0.618033988749895 % 1.0
    red, green, blue = colorsys.hsv_to_rgb(turn, 0.55 + 0.15 * (index % 3), 0.95 - 0.2 * (index % 2))
    return round(red * 255), round(green * 255), round(blue * 255)


HYKO_LABELS = "label_Semantic Classes for Urban Scenes"
HYKO_CLASSES = {
    "road": 1,
    "sidewalk": 2,
    "lane markers": 3,
    "grass": 4,
    "vegetation": 5,
    "panels, signs, traffic lights": 6,
    "building": 7,
    "vehicle": 8,
    "person": 9,
    "sky": 10,
}
HYKO_UNDEFINED = 0
RANUS_CLASSES = {
    "sky": (128, 128, 128),
    "ground": (128, 0, 0),
    "water": (0, 128, 128),
    "mountain": (128, 128, 0),
    "road": (128, 64, 128),
    "construction": (128, 0, 128),
    "vegetation": (0, 128, 0),
    "object": (64, 64, 0),
    "vehicle": (0, 0, 128),
    "human": (64, 0, 128),
}
RANUS_TOLERANCE = 10  # by which a pixel's colour may differ from its class's, over all channels; black is no class


@dataclass(frozen=True)
class Layout:
    """A frame of a set that is known: its cube, and its labels where there are some."""

    raster: Raster
    labels: Labels | None
    label_note: str


def load_frame_or_raster(address: str | Path) -> tuple[Raster, Layout | None]:
    """Read a frame of a public set, with its layout, or any other file that `load_raster` reads, (y, x, band).

    Raises SceneError: there is no such file, it is damaged, or of a kind that is not read.
    """
    path, variable = split_variable(address)
    layout = find_layout(path, variable)
    if layout is not None:
        return layout.raster, layout
    raster = load_raster(address, dims=3)
    if path.suffix.lower() in (".npy", *NAMED_ENDINGS):
        check_picture(raster.values.shape, address)
    return raster, None


def find_layout(path: Path, variable: str | None) -> Layout | None:
    """Read a frame of HyKo2 (by its .mat file) or RANUS (by its RGB image); None where the file is of neither.

    Raises SceneError: the frame's files are damaged or do not fit each other.
    """
    if variable is not None or not path.is_file():
        return None
    if path.suffix.lower() == ".mat":
        return _hyko_frame(path)
    if path.suffix.lower() == ".png" and path.parent.parent.name == "RGB":
        return _ranus_frame(path)
    return None


def _hyko_frame(path: Path) -> Layout | None:
    try:
        names = variable_names(path)
    except Exception:  # decoders raise anything at all on damaged bytes; whoever reads it says how
        return None
    if not {"data", "wavelengths"} <= names or not any(name.startswith("label_") for name in names):
        return None
    cube = load_raster(f"{path}:data", dims=3).values
    if cube.ndim != 3:
        raise SceneError(
            f"{path}: data has shape {cube.shape}, HyKo's is (y, x, band); read one array with {path}:NAME"
        )
    centres = np.asarray(load_raster(f"{path}:wavelengths", dims=2).values, np.float64).ravel()
    known = BandWavelengths(centres, None, f"wavelengths from {path}") if len(centres) == cube.shape[2] else None
    notes: tuple[str, ...] = ("a frame of HyKo2 by the names in its file",)
    if known is None:
        notes += (f"wavelengths are left out: {len(centres)} for {cube.shape[2]} bands",)
    raster = Raster(cube, None, None, notes, known=known)
    if HYKO_LABELS not in names:
        return Layout(raster, None, f"no labels: {path} has no {HYKO_LABELS!r}")
    labels = load_labels(f"{path}:{HYKO_LABELS}", cube.shape[:2], classes=HYKO_CLASSES, unlabelled=HYKO_UNDEFINED)
    return Layout(raster, labels, f"labels from {path}, {HYKO_LABELS!r}; 0 is undefined")


def _ranus_frame(path: Path) -> Layout | None:
    root, folder = path.parent.parent.parent, path.parent.name
    infrared = _sibling(root / "NIR" / folder, path.name, "nir")
    if infrared is None:
        return None
    colours, nir = load_raster(path, dims=3).values, load_raster(infrared, dims=2).values
    plane = nir[..., 0] if nir.ndim == 3 else nir
    if colours.ndim != 3 or colours.shape != (*plane.shape, 3) or colours.dtype != plane.dtype:
        raise SceneError(
            f"{path} is {colours.shape} {colours.dtype}, {infrared} {plane.shape} {plane.dtype}; expected a colour and "
            "a grey image of the same pixels"
        )
    notes = (f"near infrared from {infrared.name}: a frame of RANUS by its folders",)
    raster = Raster(np.dstack([colours, plane]), (*RGB_NM, NEAR_INFRARED_NM), None, notes, files=(path, infrared))
    truth = _sibling(root / "GT" / folder, path.name, "gt")
    if truth is None:
        return Layout(raster, None, f"no labels: nothing in {root / 'GT' / folder} belongs to {path.name}")
    return Layout(raster, *_ranus_labels(truth, plane.shape))


def _sibling(folder: Path, name: str, ending: str) -> Path | None:
    """The same frame in another folder: its name ends in another word, or is the same."""
    stem, suffix = Path(name).stem, Path(name).suffix
    bare = stem.removesuffix("_rgb")
    candidates = (folder / f"{bare}_{ending}{suffix}", folder / name)
    return next((file for file in candidates if file.is_file()), None)


def _ranus_labels(path: Path, shape: tuple[int, ...]) -> tuple[Labels, str]:
    """The class whose colour is a pixel's, up to the tolerance."""
    image = load_raster(path, dims=3).values
    if image.shape != (*shape, 3):
        raise SceneError(f"labels {path} are {image.shape}, the scene is {shape}; expected colours on its pixels")
    index = np.full(shape, UNLABELLED, np.uint8)
    for number, colour in enumerate(RANUS_CLASSES.values()):
        index[_distance(image, colour) <= RANUS_TOLERANCE] = number
    none = int(np.count_nonzero((index == UNLABELLED) & (_distance(image, (0, 0, 0)) > RANUS_TOLERANCE)))
    names, values = tuple(RANUS_CLASSES), tuple(RANUS_CLASSES.values())
    labels = Labels(index, names, values, np.array(values, np.uint8))
    return labels, f"labels from {path}, black is unlabelled" + (f"; {none} px of no class's colour" if none else "")


def _distance(image: NDArray[Any], colour: tuple[int, int, int]) -> NDArray[np.int64]:
    apart = np.abs(image.astype(np.int16) - np.array(colour, np.int16))
    return np.asarray(apart.sum(axis=-1), np.int64)
