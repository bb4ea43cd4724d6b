"""Raw cubes as files that any ENVI program reads, and that `storage.readers.recordings` reads back bit for bit.

::

    NAME.bil NAME.hdr            raw numbers, with wavelengths and widths of the bands, and the lines' axis of the field
    NAME.pointing.csv            a row a line: line, time, mirror_x, mirror_y, exposure_ms, valid
    NAME.dark.img NAME.dark.hdr  dark frame, one line of float32
    NAME.white.*                 white frame; its header has the value of the white reference per band
    NAME.bad.*  NAME.flat.*      bad elements (1), and the relative response where there is one

Numbers stand in text with as many digits as give the same float64 again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.archive.whole_files import make_folder, write_whole
from storage.arrays.cubes import RawCube
from storage.arrays.layout import SHARD_ROWS
from storage.export.image_files import EnviFile, write_envi


def write_recorded_files(cube: RawCube, folder: Path) -> Path:
    """Write a raw cube as ENVI with a pointing table and reference frames, named like its sweep; gives the header.

    What is there under these names is replaced. Raises ArchiveError: the disk refuses; IncompleteStoreError: the cube
    is damaged.
    """
    make_folder(folder)
    name = cube.sweep.name

    def blocks() -> Iterator[tuple[int, NDArray[Any]]]:
        for first in range(0, cube.shape[0], SHARD_ROWS):
            yield first, cube.read(first, min(first + SHARD_ROWS, cube.shape[0]))

    header = folder / f"{name}.hdr"
    bands = EnviFile(cube.shape, "u2", cube.wavelength_nm, cube.fwhm_nm)
    axis = {"line axis": cube.sweep.along}
    about = f"raw numbers of sweep {name}"
    write_envi(header, replace(bands, description=about, ending=".bil", more=axis), blocks())
    known = cube.references
    white_reference = ", ".join(repr(value) for value in known.white_reference.astype(np.float64).tolist())
    of_white = {"white_reference": f"{{{white_reference}}}", **({"mirror at rest": "1"} if known.by_mirror else {})}
    bad = np.zeros(known.dark.shape, np.bool_) if known.bad is None else known.bad
    frames: dict[str, tuple[NDArray[Any], str, dict[str, str]]] = {
        "dark": (known.dark, "f4", {}),
        "white": (known.white, "f4", of_white),
        "bad": (bad.astype(np.uint8), "u1", {}),
    }
    if known.flat is not None:
        frames["flat"] = (known.flat, "f4", {})
    for kind, (frame, dtype, more) in frames.items():
        shape = (1, *known.dark.shape)
        file = replace(bands, shape=shape, dtype=dtype, description=f"{kind} frame of {name}", more=more)
        write_envi(folder / f"{name}.{kind}.hdr", file, [(0, frame[None])])
    rows = ["line,time,mirror_x,mirror_y,exposure_ms,valid"]
    columns = (cube.time_s, *cube.position.T, cube.exposure_ms)
    for number, values in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(",".join([str(number), *map(repr, values), str(int(cube.valid_line[number]))]))
    write_whole(folder / f"{name}.pointing.csv", "\n".join(rows) + "\n")
    return header
