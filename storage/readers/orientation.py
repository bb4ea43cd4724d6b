"""Turn pictures upright by their orientation tag (Exif 2.32, tag 274), as viewers of pictures do."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from spectralzoom.storage.readers.cube_sources import CubeSource, check_memory, read_by_chunks

TAG = 274
TIFF_ENDINGS = (".tif", ".tiff")
Turn = Callable[[NDArray[Any]], NDArray[Any]]
TURNS: Mapping[int, Turn] = {
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: np.swapaxes(image, 0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.swapaxes(image[::-1, ::-1], 0, 1),
    8: lambda image: np.rot90(image),
}


def orientation_of(path: Path) -> int:
    """Return the orientation tag of a TIFF, JPEG or PNG, or that of its XMP; 1 (upright) without a valid one."""
    try:
        if path.suffix.lower() in TIFF_ENDINGS:  # of any number of bands, which Pillow does not open
            with tifffile.TiffFile(path) as file:
                tag = file.pages.first.tags.get(TAG)
                found = 1 if tag is None else tag.value
        else:
            with warnings.catch_warnings(), Image.open(path) as image:
                warnings.simplefilter("ignore")  # on size, which was checked, and on damaged tags
                found = image.getexif().get(TAG, 1)
    except Exception:  # of a kind without such tags; a damaged file is refused where it is read
        return 1
    return int(found) if found in TURNS else 1


def upright(source: CubeSource, tag: int) -> CubeSource:
    """Return an image as its orientation tag says, with a note; one with a place on the earth stays as it is."""
    if tag == 1:
        return source
    if source.geobox is not None:
        left = f"its orientation tag {tag} is not applied, since the file says where its pixels lie on the earth"
        return replace(source, notes=(*source.notes, left))
    turn = TURNS[tag]
    height, width, bands = source.shape
    shape = (width, height, bands) if tag >= 5 else source.shape
    check_memory(source.name, 2 * height * width * bands * source.dtype.itemsize)

    def read_all(_first: int, _last: int) -> NDArray[Any]:
        return np.ascontiguousarray(turn(source.read(0, height)))

    return replace(
        source,
        shape=shape,
        read=read_by_chunks(read_all, shape[0], shape[0]),
        void=None if source.void is None else turn(source.void),
        scaling=f"{source.scaling} orientation {tag}".strip(),
        notes=(*source.notes, f"the picture is turned upright, as its orientation tag {tag} says"),
    )
