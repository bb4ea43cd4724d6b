"""Two public sets of labelled road scenes, read as their files lie once unpacked.

HyKo2 (Winkens and others, University of Koblenz): one .mat file a frame, with ``data`` (y, x, band), ``wavelengths``
and labels of two kinds beside it. The names and the meaning of the label's numbers are taken from public programs that
read the set (hsdatasets and hyperseg by N. Theisen, of the same university).

RANUS 1.0 (Choe and others, "RANUS: RGB and NIR Urban Scene Dataset for Deep Scene Parsing", 2018): folders ``RGB``,
``NIR`` and ``GT`` with the same numbered folders in each, and files that differ in ``_rgb``, ``_nir``, ``_gt`` alone.
Folders, names and colours of the classes are taken from public programs that prepare the set for training.

Neither set was at hand: both readers are tested on small files made in these layouts, and on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.grid import UNLABELLED
from storage.readers.array_files import variable_names
from storage.readers.cube_sources import NEAR_INFRARED_NM, RGB_NM, Raster
from storage.readers.labels import Labels, load_labels
from storage.readers.raster_files import load_raster
from storage.readers.wavelengths import BandWavelengths

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

    name: str
    raster: Raster
    labels: Labels | None
    label_note: str


def find_layout(path: Path, variable: str | None) -> Layout | None:
    """Read a frame of HyKo2 (by its .mat file) or RANUS (by its RGB image); None where the file is of neither.

    Raises
    ------
    SceneError : the frame's files are damaged or do not fit each other.
    """
    if variable is not None or not path.is_file():
        return None
    if path.suffix.lower() == ".mat":
        return _hyko_frame(path)
    if path.suffix.lower() == ".png" and path.parent.parent.name == "RGB":
        return _ranus_frame(path)
    return None


def _hyko_frame(path: Path) -> Layout | None:
    names = _variables(path)
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
        return Layout("HyKo2", raster, None, f"no labels: {path} has no {HYKO_LABELS!r}")
    labels = load_labels(f"{path}:{HYKO_LABELS}", cube.shape[:2], classes=HYKO_CLASSES, unlabelled=HYKO_UNDEFINED)
    return Layout("HyKo2", raster, labels, f"labels from {path}, {HYKO_LABELS!r}; 0 is undefined")


def _variables(path: Path) -> set[str]:
    """Names in a .mat file, without reading their arrays; none where it is damaged (whoever reads it says how)."""
    try:
        return variable_names(path)
    except Exception:  # decoders raise anything at all on damaged bytes
        return set()


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
        return Layout("RANUS", raster, None, f"no labels: nothing in {root / 'GT' / folder} belongs to {path.name}")
    return Layout("RANUS", raster, *_ranus_labels(truth, plane.shape))


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
