"""Write sweeps as the recorded files that `storage.readers.recordings` reads: ENVI, frames and a pointing table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.storage.arrays.cubes import RawCube

CODES = {"u1": 1, "f4": 4, "u2": 12}


def write_cube(header: Path, values: NDArray[Any], dtype: str, data: str = ".img", **entries: object) -> None:
    """Write (line, sample, band) values, interleaved by band, and their header with further entries."""
    lines, samples, bands = values.shape
    fields = {"samples": samples, "lines": lines, "bands": bands, "header offset": 0, "file type": "ENVI Standard"}
    fields |= {"data type": CODES[dtype], "interleave": "bil", "byte order": 0}
    header.parent.mkdir(parents=True, exist_ok=True)
    header.with_suffix(data).write_bytes(values.transpose(0, 2, 1).astype(f"<{dtype}").tobytes())
    lines_of_header = (f"{key} = {value}\n" for key, value in (fields | entries).items())
    header.write_text("ENVI\n" + "".join(lines_of_header), encoding="utf-8")


def listed(values: NDArray[np.floating]) -> str:
    """Return numbers as a list of a header, with as many digits as give the same float64 again."""
    return "{" + ", ".join(map(repr, values.astype(np.float64).tolist())) + "}"


def write_recorded_files(cube: RawCube, folder: Path) -> Path:
    """Write a raw cube as ENVI with a pointing table and reference frames, named like its sweep; return the header."""
    name = cube.sweep.name
    bands = {"wavelength units": "Nanometers", "wavelength": listed(cube.wavelength_nm)}
    if cube.fwhm_nm is not None:
        bands["fwhm"] = listed(cube.fwhm_nm)
    header = folder / f"{name}.hdr"
    write_cube(header, cube.read(), "u2", ".bil", **bands, **{"line axis": cube.sweep.along})
    known = cube.references
    white = {"white_reference": listed(known.white_reference)} | ({"mirror at rest": 1} if known.by_mirror else {})
    bad = np.zeros(known.dark.shape, np.bool_) if known.bad is None else known.bad
    frames: dict[str, tuple[NDArray[Any], str, dict[str, Any]]] = {
        "dark": (known.dark, "f4", {}),
        "white": (known.white, "f4", white),
        "bad": (bad, "u1", {}),
    }
    for kind, (frame, dtype, more) in frames.items():
        write_cube(folder / f"{name}.{kind}.hdr", frame[None], dtype, **bands, **more)
    rows = ["line,time,mirror_x,mirror_y,exposure_ms,valid"]
    columns = (cube.time_s, *cube.position.T, cube.exposure_ms)
    for number, values in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        rows.append(",".join([str(number), *map(repr, values), str(int(cube.valid_line[number]))]))
    (folder / f"{name}.pointing.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return header
