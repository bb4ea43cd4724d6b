"""Cubes of files stored as one immutable array.

::

    cube.zarr/values          (line, sample, band): whole numbers as uint8 or uint16 where they fit, else float32
    cube.zarr/wavelength      (band,) nm, fwhm beside it; missing where nothing says them
    cube.zarr/valid_line      (line,) false for lines that no file holds whole; time, exposure_ms, frame where known
    cube.zarr/dark, white     (sample, band) reference frames, where there are some
    cube.zarr/quicklook       (y, x, 3) uint8 for viewers; the same as quicklook.png beside the cube

Attributes say where it came from: file names without folders, sizes, SHA-256, header texts, notes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from PIL import Image

from storage.arrays.georeference import ON_THE_MAP, map_attributes, write_grid_mapping
from storage.arrays.layout import create_array, create_group, image_spec, write_bands, write_counts, write_small
from storage.arrays.quicklooks import LineThumbnail, write_quicklook
from storage.readers.cube_sources import BLOCK_LINES, CubeSource

KIND = "ingested cube"
LONGEST_HEADER = 1 << 16  # characters of a header's text that are kept

Report = Callable[[float], None]


@dataclass(frozen=True)
class SourceFile:
    """One file that a cube came from."""

    name: str  # without folders, but those within a store
    size: int
    sha256: str


def write_ingested_cube(
    folder: Path, source: CubeSource, files: Sequence[SourceFile], *, name: str, report: Report = lambda done: None
) -> None:
    """Store a cube as ``cube.zarr`` and ``quicklook.png`` in a folder, 64 lines at a time.

    Its attributes have its name and the files that it came from; ``report`` is told how far it is, 0..1. Raises
    SceneError: lines cannot be read.
    """
    kind = stored_dtype(source, lambda done: report(0.3 * done))
    sampled = source.dtype.kind in "ui" and source.dtype not in (np.uint8, np.uint16)
    begin = 0.3 if sampled else 0.0
    group = create_group(folder / "cube.zarr", f"{KIND} {name}", _attributes(source, files, name))
    about: dict[str, Any] = {"long_name": "numbers of the file", "units": "1", **_write_coordinates(group, source)}
    array = create_array(group, "values", image_spec(("line", "sample", "band"), source.shape, kind.str), about)
    thumbnail = LineThumbnail(
        source.shape,
        source.bands.wavelength_nm,
        dark=source.dark,
        white=source.white,
        white_reference=source.white_reference,
    )
    for start in range(0, source.shape[0], BLOCK_LINES):
        stop = min(start + BLOCK_LINES, source.shape[0])
        lines, valid = source.read(start, stop), source.valid[start:stop]
        with np.errstate(over="ignore"):  # a float64 beyond float32 becomes infinite, which a scene takes for missing
            block = lines.astype(kind)
        if not valid.all():
            block[~valid] = np.nan if kind.kind == "f" else 0
        array[start:stop] = block
        thumbnail.add(start, lines, valid)
        report(begin + (1 - begin) * stop / source.shape[0])
    picture = thumbnail.finish()
    write_quicklook(group, picture)
    Image.fromarray(picture.image).save(folder / "quicklook.png")


def stored_dtype(source: CubeSource, report: Report = lambda done: None) -> np.dtype[Any]:
    """Type of the store: uint8 and uint16 stay, other whole numbers become uint16 where all fit, the rest float32."""
    if source.dtype.kind == "b" or source.dtype == np.uint8:
        return np.dtype(np.uint8)
    if source.dtype == np.uint16:
        return np.dtype(np.uint16)
    if source.dtype.kind not in "ui":
        return np.dtype(np.float32)
    for start in range(0, source.shape[0], BLOCK_LINES):
        stop = min(start + BLOCK_LINES, source.shape[0])
        lines = source.read(start, stop)
        if lines.min() < 0 or lines.max() > np.iinfo(np.uint16).max:
            return np.dtype(np.float32)
        report(stop / source.shape[0])
    return np.dtype(np.uint16)


def _attributes(source: CubeSource, files: Sequence[SourceFile], name: str) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "kind": KIND,
        "name": name,
        "files": [asdict(file) for file in files],
        "headers": {file: text[:LONGEST_HEADER] for file, text in source.headers.items()},
        "source_dtype": source.dtype.str,
        "lost_lines": source.lost_lines,
        "notes": list(source.notes),
        "wavelength_origin": source.bands.origin or "nothing says the wavelengths",
        "wavelength_units_in_file": source.bands.units,
    }
    if source.nodata is not None and np.isfinite(source.nodata):
        facts["nodata"] = source.nodata
    if source.position is not None:
        facts["by_mirror"] = True
    if source.bad_bands:
        facts["bad_bands"] = list(source.bad_bands)
    if source.geobox is not None:
        facts |= {**map_attributes(source.geobox), "spatial:dimensions": ["line", "sample"]}
    if source.lines.first_stamp_us is not None:
        facts["first_stamp_us"] = source.lines.first_stamp_us
    return facts


def _write_coordinates(group: zarr.Group, source: CubeSource) -> dict[str, str]:
    """Store what is known of lines, bands and place, and the reference frames; give the attributes that name it."""
    write_counts(group, line=source.shape[0], sample=source.shape[1])
    names: list[str] = []
    if source.bands.wavelength_nm is not None:
        names.append(write_bands(group, source.bands.wavelength_nm, source.bands.fwhm_nm))
    columns: Mapping[str, tuple[NDArray[Any] | None, dict[str, Any]]] = {
        "time": (source.lines.time_s, {"long_name": "since the first stamp of a frame", "units": "s"}),
        "exposure_ms": (source.lines.exposure_ms, {"units": "ms"}),
        "frame": (source.lines.frame, {"long_name": "number that the camera gave, -1 where not known", "units": "1"}),
        "valid_line": (source.valid, {"long_name": "line is whole in its file"}),
    }
    for name, (values, about) in columns.items():
        if values is not None:
            write_small(group, name, ("line",), np.asarray(values), about)
            names.append(name)
    frames: Mapping[str, tuple[NDArray[Any] | None, str]] = {
        "dark": (source.dark, "dark reference frame"),
        "white": (source.white, "white reference frame"),
        "bad": (source.bad, "bad elements of the detector"),
        "flat": (source.flat, "relative response left over by the white frame"),
    }
    for name, (frame, title) in frames.items():
        if frame is not None:
            write_small(group, name, ("sample", "band"), np.asarray(frame), {"long_name": title, "units": "1"})
    if source.white_reference is not None:
        write_small(
            group,
            "white_reference",
            ("band",),
            source.white_reference,
            {"long_name": "scene value of the white reference"},
        )
    if source.position is not None:
        for name, axis in zip(("mirror_x", "mirror_y"), source.position.T, strict=True):
            write_small(group, name, ("line",), np.ascontiguousarray(axis), {"long_name": "mirror position"})
    placed = {} if source.geobox is None else ON_THE_MAP
    if source.geobox is not None:
        write_grid_mapping(group, source.geobox)
        names.append(ON_THE_MAP["coordinates"])
    return {**placed, **({"coordinates": " ".join(names)} if names else {})}
