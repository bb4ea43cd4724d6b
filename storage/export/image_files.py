"""Write images for programs that read no Zarr: ENVI, and cloud-optimised GeoTIFF by GDAL.

Both are written block by block.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from pipeline.errors import ArchiveError
from pipeline.geometry.grid import cuts
from pipeline.rig.camera.camera_texts import DATA_TYPES
from storage.archive.whole_files import make_folder, write_whole, written_aside
from storage.arrays.class_maps import ClassNames
from storage.arrays.cubes import RawCube
from storage.arrays.georeference import AngularGrid
from storage.arrays.layout import SHARD_ROWS
from storage.arrays.signal_cubes import RestoredCube

TILE = 512  # px: rasters within one tile need no overviews
ANGULAR = (
    "angular grid of the camera: x and y are tangents of the angle from the undeflected direction [rad], y grows "
    "downwards; there is no CRS"
)

Blocks = Iterable[tuple[int, NDArray[Any]]]  # first row, (row, x) or (row, x, band) values, in order


def angular_geobox(grid: AngularGrid, shape: tuple[int, int]) -> GeoBox:
    """Return the grid of an image of (y, x) px in tangents of the camera's angles [rad], without a CRS."""
    return GeoBox(shape, Affine(*grid.attributes(shape)["spatial:transform"]), None)


@dataclass(frozen=True)
class CogImage:
    """Grid, bands and legend of one file."""

    geobox: GeoBox  # without a CRS in tangents of angles [rad]
    dtype: str
    bands: tuple[str, ...]  # their descriptions
    nodata: float
    legend: ClassNames | None = None  # of an image of classes: overviews take the commonest, not the mean
    tags: Mapping[str, str] = field(default_factory=dict)
    wavelength_nm: Sequence[float] | None = None  # of each band
    fwhm_nm: Sequence[float] | None = None


def write_cog(path: Path, image: CogImage, blocks: Blocks) -> None:
    """Write one file atomically from blocks in order; one block at a time is in memory.

    Classes get a colour table, and their names as tags of the band and as GDAL's category names in ``NAME.aux.xml``.
    Raises ArchiveError: the disk refuses or changes the numbers.
    """
    rasterio = importlib.import_module("rasterio")  # not in the block: Ctrl-C would leave it without `errors`
    try:
        _write_cog(rasterio, path, image, blocks)
    except rasterio.errors.RasterioError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error


def _write_cog(rasterio: Any, path: Path, image: CogImage, blocks: Blocks) -> None:
    sidecar = f"{path.name}.aux.xml"
    with written_aside(path.parent, [path.name] if image.legend is None else [path.name, sidecar]) as aside:
        plain, made = aside / "plain.tif", aside / path.name
        _write_plain(rasterio, plain, image, blocks)
        options = {
            "COMPRESS": "DEFLATE",  # every reader has it; not every build of GDAL has zstd
            "PREDICTOR": "NO" if image.legend is not None else "YES",  # neighbouring class numbers have no slope
            "OVERVIEW_RESAMPLING": "AVERAGE" if image.legend is None else "MODE",
            "BLOCKSIZE": str(TILE),
            "NUM_THREADS": "1",
        }
        importlib.import_module("rasterio.shutil").copy(str(plain), str(made), driver="COG", **options)
        with rasterio.open(plain) as wanted, rasterio.open(made) as found:
            same = all(  # tile by tile: a tile holds every band
                np.array_equal(
                    wanted.read(window=part), found.read(window=part), equal_nan=np.dtype(image.dtype).kind == "f"
                )
                for _, part in found.block_windows(1)
            )
        if not same:
            raise ArchiveError(f"{path} does not read back as written; is the disk full? Run again")
        if image.legend is not None:
            root = ElementTree.Element("PAMDataset")
            names = ElementTree.SubElement(ElementTree.SubElement(root, "PAMRasterBand", band="1"), "CategoryNames")
            for name in image.legend.names:
                ElementTree.SubElement(names, "Category").text = name
            ElementTree.ElementTree(root).write(aside / sidecar, encoding="utf-8")


def _write_plain(rasterio: Any, path: Path, image: CogImage, blocks: Blocks) -> None:
    """Write an uncompressed TIFF in strips, block by block; GDAL makes the cloud-optimised file from it."""
    y, x = image.geobox.shape
    crs = image.geobox.crs
    profile = {
        "driver": "GTiff",
        "height": y,
        "width": x,
        "count": len(image.bands),
        "dtype": image.dtype,
        "nodata": image.nodata,
        "transform": image.geobox.affine,
        "crs": None if crs is None else crs.to_wkt(),
        "BIGTIFF": "IF_SAFER",
    }
    with rasterio.open(path, "w", **profile) as file:
        file.descriptions = image.bands
        file.update_tags(**image.tags)
        _tag_wavelengths(file, image)
        if image.legend is not None:
            names = image.legend.names
            file.update_tags(
                1,
                **{f"CLASS_{number}": name for number, name in enumerate(names)},
                flag_values=", ".join(str(number) for number in range(len(names))),
                flag_meanings=" ".join("_".join(name.split()) for name in names),
            )
            colours = enumerate(image.legend.colours.tolist())
            file.write_colormap(1, {number: (*colour, 255) for number, colour in colours})
        for first, values in blocks:
            planes = np.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)
            file.write(planes.astype(image.dtype, copy=False), window=((first, first + len(values)), (0, x)))


def _tag_wavelengths(file: Any, image: CogImage) -> None:
    """Write each band's wavelength and width in GDAL's domain IMAGERY [um], and as its ENVI driver has them [nm]."""
    if image.wavelength_nm is None:
        return
    widths = [None] * len(image.bands) if image.fwhm_nm is None else image.fwhm_nm
    for band, (centre, width) in enumerate(zip(image.wavelength_nm, widths, strict=True), start=1):
        own = {"CENTRAL_WAVELENGTH_UM": f"{centre / 1000:.9g}"}
        usual = {"wavelength": f"{centre:.9g}", "wavelength_units": "Nanometers"}
        if width is not None:
            own["FWHM_UM"] = f"{width / 1000:.9g}"
            usual["fwhm"] = f"{width:.9g}"
        file.update_tags(band, ns="IMAGERY", **own)
        file.update_tags(band, **usual)


@dataclass(frozen=True)
class EnviFile:
    """The content of one file, its lines interleaved by band (BIL) and its bytes little endian."""

    shape: tuple[int, int, int]  # (line, sample, band)
    dtype: str  # such as u2 or f4
    wavelength_nm: NDArray[np.float64] | None = None  # (band,)
    fwhm_nm: NDArray[np.float64] | None = None  # (band,)
    description: str = ""
    ending: str = ".img"  # of the file with the numbers
    more: Mapping[str, str] = field(default_factory=dict)  # further entries of the header


def write_envi(header: Path, file: EnviFile, blocks: Blocks) -> Path:
    """Write ``NAME.hdr`` and the numbers beside it; return the path of the latter.

    Both files replace earlier ones together. Blocks of lines come in order. Raises ArchiveError: the disk refuses.
    """
    data = header.with_suffix(file.ending)
    kind = np.dtype(file.dtype).newbyteorder("<")
    text = "".join(["ENVI\n", *(f"{key} = {value}\n" for key, value in _header_fields(file, kind))])
    with written_aside(header.parent, [data.name, header.name]) as aside:
        with (aside / data.name).open("wb") as stream:
            for _, values in blocks:
                stream.write(np.ascontiguousarray(values.transpose(0, 2, 1), kind).data)
        (aside / header.name).write_text(text, encoding="utf-8")
    return data


def _header_fields(file: EnviFile, kind: np.dtype[Any]) -> Iterator[tuple[str, str]]:
    """Yield sizes, type, byte order and bands."""
    lines, samples, bands = file.shape
    if file.description:
        yield "description", _listed([file.description.replace("{", "(").replace("}", ")")])
    yield from (("samples", str(samples)), ("lines", str(lines)), ("bands", str(bands)))
    code = {name: code for code, name in DATA_TYPES.items()}[kind.str[1:]]
    yield from (("header offset", "0"), ("file type", "ENVI Standard"), ("data type", str(code)))
    yield from (("interleave", "bil"), ("byte order", "0"))
    if file.wavelength_nm is not None:
        yield "wavelength units", "Nanometers"
    for key, values in (("wavelength", file.wavelength_nm), ("fwhm", file.fwhm_nm)):
        if values is not None:
            yield key, _listed([repr(number) for number in values.tolist()])
    yield from file.more.items()


def _listed(items: list[str]) -> str:
    return "{" + ", ".join(items) + "}"


def write_recorded_files(cube: RawCube, folder: Path) -> Path:
    """Write a raw cube as ENVI with a pointing table and reference frames, named like its sweep; return the header.

    `storage.readers.recordings` reads them back bit for bit::

        NAME.bil NAME.hdr            raw numbers, with wavelengths and widths of the bands, and the lines' axis
        NAME.pointing.csv            a row a line: line, time, mirror_x, mirror_y, exposure_ms, valid
        NAME.dark.img NAME.dark.hdr  dark frame, one line of float32
        NAME.white.*                 white frame; its header has the value of the white reference per band
        NAME.bad.*  NAME.flat.*      bad elements (1), and the relative response where there is one

    Numbers have as many digits as give the same float64 again. Files of these names are replaced. Raises ArchiveError:
    the disk refuses; IncompleteStoreError: the cube is damaged.
    """
    make_folder(folder)
    name = cube.sweep.name
    header = folder / f"{name}.hdr"
    bands = EnviFile(cube.shape, "u2", cube.wavelength_nm, cube.fwhm_nm)
    axis = {"line axis": cube.sweep.along}
    what = "restored" if isinstance(cube, RestoredCube) else "raw"
    blocks = ((rows.start, cube.read(rows.start, rows.stop)) for rows in cuts(cube.shape[0], SHARD_ROWS))
    write_envi(header, replace(bands, description=f"{what} numbers of sweep {name}", ending=".bil", more=axis), blocks)
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
