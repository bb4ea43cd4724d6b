"""Anything that holds a cube, opened to be read 64 lines at a time, and stored so: as one immutable array.

::

    cube.zarr/values          (line, sample, band): whole numbers as uint8 or uint16 where they fit, else float32
    cube.zarr/wavelength      (band,) nm, fwhm beside it; missing where nothing says them
    cube.zarr/valid_line      (line,) false for lines that no file holds whole; time, exposure_ms, frame where told
    cube.zarr/dark, white     (sample, band) reference frames, where there are some
    cube.zarr/quicklook       (y, x, 3) uint8 for viewers; the same as quicklook.png beside the cube

Attributes say where it came from: file names without folders, sizes, SHA-256, header texts, notes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from PIL import Image

from pipeline.errors import SceneError
from storage.arrays.georeference import ON_THE_MAP, map_attributes, write_grid_mapping
from storage.arrays.layout import create_array, create_group, image_spec, write_bands, write_counts, write_small
from storage.arrays.quicklooks import LineThumbnail, write_quicklook
from storage.readers.cube_sources import BLOCK_LINES, Bands, CubeSource, LineFacts, check_cube_source, read_by_chunks
from storage.readers.envi_cubes import DATA_ENDINGS, find_envi_pair, open_envi_cube
from storage.readers.hdf_cubes import HDF_ENDINGS, open_hdf_cube
from storage.readers.headwall_folders import find_reference, open_envi_source, open_headwall_cube
from storage.readers.labels import load_frame_or_raster
from storage.readers.raster_files import (
    ROW_ENDINGS,
    SCENE_ENDINGS,
    TiffRows,
    load_raster,
    open_tiff_rows,
    split_variable,
)
from storage.readers.safe_products import is_safe_product, open_safe_rows
from storage.readers.scene_toml import BandWavelengths, SceneSettings, find_scene_settings, settle_wavelengths
from storage.readers.zarr_scenes import find_zarr_store, open_zarr_cube

Reader = Literal["zarr", "headwall", "envi", "hdf", "safe", "raster"]


def reader_of(address: str | Path) -> Reader:
    """Which reader takes an address, for scenes, cubes to ingest and reference frames alike.

    A folder is a Zarr store or a Headwall camera's, an ENVI cube is named by its header or its data file: these come in
    lines. Everything else, also what is not there, is for `load_raster`, which refuses what it does not know.
    """
    path, _ = split_variable(address)
    if is_safe_product(path):
        return "safe"
    if path.is_dir():
        return "headwall" if find_zarr_store(path) is None else "zarr"
    if path.suffix.lower() == ".hdr":
        return "envi"
    if path.suffix.lower() in HDF_ENDINGS and path.is_file():
        return "hdf"
    if path.suffix.lower() in SCENE_ENDINGS or not path.is_file():
        return "raster"
    beside = {path.with_name(path.name + ".hdr").name.lower(), path.with_suffix(".hdr").name.lower()}
    of_envi = path.suffix.lower() in DATA_ENDINGS or any(one.name.lower() in beside for one in path.parent.iterdir())
    return "envi" if of_envi else "raster"


def open_cube_source(
    address: str | Path, *, dark: str | Path | None = None, white: str | Path | None = None
) -> CubeSource:
    """Open whatever holds a cube; nothing of its numbers is read yet but small images, .mat and .npz, which are whole.

    That is an ENVI header or data file, a Headwall folder, a Zarr store (``STORE:ARRAY``), or a file that
    :func:`storage.readers.raster_files.load_raster` reads. ``dark`` and ``white`` are ENVI or .npy files of reference
    frames, averaged over their lines; they win over those in a Headwall folder. Raises SceneError: there is no such
    thing, it is damaged, or not of a kind or shape that can be used.
    """
    path, variable = split_variable(address)
    stated, found = [("dark", dark), ("white", white)], list[tuple[str, Path | None]]()
    match reader_of(address):
        case "zarr":
            source = open_zarr_cube(path, variable)
        case "headwall":
            source = open_headwall_cube(path)
            found = [(kind, find_reference(path, kind)) for kind, frame in stated if frame is None]
        case "envi":
            source = open_envi_source(path)
        case "hdf":
            source = open_hdf_cube(path, variable)
        case "safe":
            source = _tiff_source(path, open_safe_rows(path, variable))
        case "raster":
            source = _raster_source(address)
    for kind, frame in (*found, *stated):
        if frame is not None:
            values, more = load_frame(frame)
            notes = (*source.notes, f"{kind} frame from {Path(frame).name}")
            source = replace(source, **{kind: values}, files=(*source.files, *more), notes=notes)  # type: ignore[arg-type]
    check_cube_source(source)
    return source


def with_wavelengths(source: CubeSource, stated: Sequence[float]) -> CubeSource:
    """The same cube with wavelengths as a flag says them [nm], one a band (WavelengthError where they do not fit)."""
    path, count = Path(source.name), source.shape[2]
    found = settle_wavelengths(path, range(count), count, stated=stated, settings=SceneSettings(), assumed_nm=None)
    return replace(source, bands=Bands(found.centre_nm, None, "nm", found.origin))


def known_bands(source: CubeSource) -> BandWavelengths | None:
    """What a scene takes as its file's own wavelengths."""
    bands = source.bands
    if bands.wavelength_nm is None:
        return None
    return BandWavelengths(bands.wavelength_nm, bands.fwhm_nm, bands.origin)


def load_frame(address: str | Path) -> tuple[NDArray[np.float32], tuple[Path, ...]]:
    """Read one reference frame, (sample, band), the mean of its lines, and the files that it stands in.

    Raises SceneError: the file cannot be read or holds no real numbers.
    """
    path, _ = split_variable(address)
    match reader_of(address):
        case "zarr" | "headwall" | "safe":
            raise SceneError(f"{path} is a folder, expected a reference frame (ENVI or .npy); name the file")
        case "envi":
            files: tuple[Path, ...] = find_envi_pair(path)
            values = open_envi_cube(path).values
        case "hdf" | "raster":
            values, files = load_raster(address, dims=3).values, (path,)
    if values.dtype.kind not in "uif":
        raise SceneError(f"{path} holds {values.dtype}, expected the real numbers of a reference frame")
    frame = values[None] if values.ndim == 2 else values
    return np.asarray(frame.mean(axis=0, dtype=np.float64), np.float32), files


def _raster_source(address: str | Path) -> CubeSource:
    path, _ = split_variable(address)
    if path.suffix.lower() in ROW_ENDINGS:
        return _tiff_source(path, open_tiff_rows(path))
    raster, _ = load_frame_or_raster(address)
    values = raster.three_axes(path)
    gaps = raster.void is not None and bool(raster.void.any())
    if raster.void is not None and gaps:
        values = _with_gaps(values, raster.void)
    native = values.dtype.newbyteorder("=")
    return CubeSource(
        name=path.name,
        shape=(values.shape[0], values.shape[1], values.shape[2]),
        dtype=native,
        read=lambda start, stop: np.asarray(values[start:stop], native),
        files=tuple(raster.files) or (path,),
        lines=LineFacts(np.ones(values.shape[0], np.bool_)),
        bands=_raster_bands(path, raster.assumed_nm, raster.known, values.shape[2]),
        nodata=raster.nodata,
        geobox=raster.geobox,
        bad_bands=raster.bad_bands,
        gaps=gaps,
        notes=raster.notes,
    )


def _tiff_source(path: Path, rows: TiffRows) -> CubeSource:
    """A TIFF or JPEG 2000 as lines; of one with transparent or masked pixels they are float32, with NaN there."""
    starts = range(0, rows.shape[0], BLOCK_LINES)
    voids = (rows.void(start, min(start + BLOCK_LINES, rows.shape[0])) for start in starts)
    gaps = any(void is not None and bool(void.any()) for void in voids)

    def read(start: int, stop: int) -> NDArray[Any]:
        void = rows.void(start, stop)
        assert void is not None  # of a file with gaps
        return _with_gaps(rows.read(start, stop), void)

    return CubeSource(
        name=path.name,
        shape=rows.shape,
        dtype=np.dtype(np.float32) if gaps else rows.dtype,
        read=read_by_chunks(read if gaps else rows.read, rows.shape[0], rows.block_lines),
        files=rows.files or (path,),
        lines=LineFacts(np.ones(rows.shape[0], np.bool_)),
        bands=_raster_bands(path, rows.assumed_nm, rows.known, rows.shape[2]),
        nodata=rows.nodata,
        geobox=rows.geobox,
        bad_bands=rows.bad_bands,
        gaps=gaps,
        notes=rows.notes,
    )


def _with_gaps(values: NDArray[Any], void: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(y, x, band) values as float32, NaN in the (y, x) pixels that are void."""
    return np.where(void[..., None], np.float32(np.nan), values.astype(np.float32))


def _raster_bands(path: Path, assumed_nm: Sequence[float] | None, known: BandWavelengths | None, count: int) -> Bands:
    """Wavelengths by ``scene.toml``, the file, or its colours; none where nothing says those of every band."""
    settings = find_scene_settings(path)
    if settings.bands is not None and settings.wavelengths_nm is not None and len(settings.wavelengths_nm) != count:
        settings = SceneSettings()  # stated for some of the bands only
    said = settings.wavelengths_nm is not None or settings.wavelengths_file is not None
    if not said and known is None and (assumed_nm is None or len(assumed_nm) != count):
        return Bands()
    found = settle_wavelengths(
        path, range(count), count, stated=None, settings=settings, assumed_nm=assumed_nm, known=known
    )
    folder = "" if settings.path is None else f"{settings.path.parent}/"
    return Bands(found.centre_nm, found.fwhm_nm, "nm", found.origin.replace(folder, ""))


KIND = "ingested cube"
LONGEST_HEADER = 1 << 16  # characters of a header's text that are kept

Report = Callable[[float], None]


@dataclass(frozen=True)
class SourceFile:
    """One file that a cube came from."""

    name: str  # without folders, but those within a store
    size: int
    sha256: str

    def record(self) -> dict[str, Any]:
        """As attributes and receipts hold it."""
        return {"name": self.name, "size": self.size, "sha256": self.sha256}


def write_ingested_cube(
    folder: Path, source: CubeSource, files: Sequence[SourceFile], *, name: str, report: Report = lambda done: None
) -> None:
    """Store a cube as ``cube.zarr`` and ``quicklook.png`` in a folder, 64 lines at a time.

    Its attributes have its name and the files that it came from; ``report`` is told how far it is, 0..1. Raises
    SceneError: lines cannot be read.
    """
    kind = stored_dtype(source, lambda done: report(0.3 * done))
    looked_at = source.dtype.kind in "ui" and source.dtype not in (np.uint8, np.uint16)
    begin = 0.3 if looked_at else 0.0
    group = create_group(folder / "cube.zarr", f"{KIND} {name}", _attributes(source, files, name))
    about: dict[str, Any] = {"long_name": "numbers of the file", "units": "1", **_write_coordinates(group, source)}
    array = create_array(group, "values", image_spec(("line", "sample", "band"), source.shape, kind.str), about)
    thumbnail = LineThumbnail(
        source.shape, source.bands.wavelength_nm, dark=source.dark, white=source.white, panel=source.panel
    )
    for start, stop in _blocks(source):
        lines = source.read(start, stop)
        valid = source.lines.valid[start:stop]
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
    for start, stop in _blocks(source):
        lines = source.read(start, stop)
        if lines.min() < 0 or lines.max() > np.iinfo(np.uint16).max:
            return np.dtype(np.float32)
        report(stop / source.shape[0])
    return np.dtype(np.uint16)


def _blocks(source: CubeSource) -> Iterator[tuple[int, int]]:
    for start in range(0, source.shape[0], BLOCK_LINES):
        yield start, min(start + BLOCK_LINES, source.shape[0])


def _attributes(source: CubeSource, files: Sequence[SourceFile], name: str) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "kind": KIND,
        "name": name,
        "files": [file.record() for file in files],
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
        "valid_line": (source.lines.valid, {"long_name": "line is whole in its file"}),
    }
    for name, (values, about) in columns.items():
        if values is not None:
            write_small(group, name, ("line",), np.asarray(values), about)
            names.append(name)
    _write_references(group, source)
    placed = {} if source.geobox is None else ON_THE_MAP
    if source.geobox is not None:
        write_grid_mapping(group, source.geobox)
        names.append(ON_THE_MAP["coordinates"])
    return {**placed, **({"coordinates": " ".join(names)} if names else {})}


def _write_references(group: zarr.Group, source: CubeSource) -> None:
    frames: Mapping[str, tuple[NDArray[Any] | None, str]] = {
        "dark": (source.dark, "dark reference frame"),
        "white": (source.white, "white reference frame"),
        "bad": (source.bad, "bad elements of the detector"),
        "flat": (source.flat, "relative response left over by the white frame"),
    }
    for name, (frame, title) in frames.items():
        if frame is not None:
            write_small(group, name, ("sample", "band"), np.asarray(frame), {"long_name": title, "units": "1"})
    if source.panel is not None:
        write_small(group, "panel", ("band",), source.panel, {"long_name": "scene value of the white panel"})
    if source.position is not None:
        for name, axis in zip(("mirror_x", "mirror_y"), source.position.T, strict=True):
            write_small(group, name, ("line",), np.ascontiguousarray(axis), {"long_name": "mirror position"})
