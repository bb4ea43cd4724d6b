"""Write images as cloud-optimised GeoTIFF by GDAL, block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio.errors import RasterioError
from rasterio.merge import merge

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.arrays.class_maps import ClassNames
from spectralzoom.storage.whole_files import written_aside

TILE = 512  # px: rasters within one tile need no overviews
Rows = Iterator[tuple[int, NDArray[Any]]]  # first row, (row, x) or (row, x, band) values, in order


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One image to export: grid, bands, legend and values."""

    name: str  # of its file, without an ending
    title: str
    geobox: GeoBox  # without a CRS in tangents of angles [rad]
    dtype: str
    bands: tuple[str, ...]  # their descriptions
    rows: Callable[[], Rows]
    nodata: float = np.nan
    roles: tuple[str, ...] = ("data",)
    unit: str | None = None
    legend: ClassNames | None = None  # of an image of classes: overviews take the commonest, not the mean
    tags: Mapping[str, str] = field(default_factory=dict)
    wavelength_nm: Sequence[float] | None = None  # of each band
    fwhm_nm: Sequence[float] | None = None
    detector: Sequence[int] = ()  # of each band


def write_cog(path: Path, image: Layer) -> None:
    """Write one file atomically; one block of rows at a time is in memory.

    Classes get a colour table, and their names as tags of the band and as GDAL's category names in ``NAME.aux.xml``.
    Raises ArchiveError: the disk refuses or changes the numbers.
    """
    sidecar = f"{path.name}.aux.xml"
    names = [path.name] if image.legend is None else [path.name, sidecar]
    options = {
        "COMPRESS": "DEFLATE",  # every reader has it; not every build of GDAL has zstd
        "PREDICTOR": "NO" if image.legend is not None else "YES",  # neighbouring class numbers have no slope
        "OVERVIEW_RESAMPLING": "AVERAGE" if image.legend is None else "MODE",
        "BLOCKSIZE": str(TILE),
        "NUM_THREADS": "1",
    }
    try:
        with written_aside(path.parent, names) as aside:
            plain, made = aside / "plain.tif", aside / path.name
            _write_plain(plain, image)
            rasterio.shutil.copy(str(plain), str(made), driver="COG", **options)
            _check_same(plain, made, path)
            if image.legend is not None:
                _write_categories(aside / sidecar, image.legend)
    except RasterioError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error


def merged_layer(layers: Sequence[Layer], scratch: Path) -> Layer:
    """Return images on one grid as one, the first on top, kept in the folder ``scratch``; other facts of the first."""
    files = [scratch / f"{number}.tif" for number in range(len(layers))]
    for file, layer in zip(files, layers, strict=True):
        _write_plain(file, layer)
    merged = scratch / "merged.tif"
    merge(files, dst_path=merged, method="first")
    with rasterio.open(merged) as found:
        geobox = GeoBox(found.shape, found.transform, found.crs)

    def rows() -> Rows:
        with rasterio.open(merged) as found:
            for first in range(0, found.height, TILE):
                block = ((first, min(first + TILE, found.height)), (0, found.width))
                yield first, np.moveaxis(found.read(window=block), 0, -1)

    return replace(layers[0], geobox=geobox, rows=rows)


def _check_same(plain: Path, made: Path, path: Path) -> None:
    """Refuse a copy with other numbers (ArchiveError), which GDAL leaves on a full disk without an error."""
    with rasterio.open(plain) as wanted, rasterio.open(made) as found:
        for _, tile in found.block_windows(1):  # a tile holds every band
            if wanted.read(window=tile).tobytes() != found.read(window=tile).tobytes():
                raise ArchiveError(f"{path} does not read back as written; is the disk full? Run again")


def _write_categories(path: Path, legend: ClassNames) -> None:
    root = ElementTree.Element("PAMDataset")
    names = ElementTree.SubElement(ElementTree.SubElement(root, "PAMRasterBand", band="1"), "CategoryNames")
    named = dict(zip(legend.numbers, legend.names, strict=True))
    for number in range(max(named) + 1):  # the place of a name is its number
        ElementTree.SubElement(names, "Category").text = named.get(number, "")
    ElementTree.ElementTree(root).write(path, encoding="utf-8")


def _write_plain(path: Path, image: Layer) -> None:
    """Write an uncompressed TIFF in strips, block by block; GDAL makes the cloud-optimised file from it."""
    y, x = image.geobox.shape
    crs = None if image.geobox.crs is None else image.geobox.crs.to_wkt()
    size = {"height": y, "width": x, "count": len(image.bands), "dtype": image.dtype}
    place = {"transform": image.geobox.affine, "crs": crs}
    with rasterio.open(path, "w", "GTiff", **size, **place, nodata=image.nodata, BIGTIFF="IF_SAFER") as file:
        file.descriptions = image.bands
        file.update_tags(**image.tags)
        _tag_wavelengths(file, image)
        if image.legend is not None:
            names = image.legend.names
            file.update_tags(
                1,
                **{f"CLASS_{number}": name for number, name in zip(image.legend.numbers, names, strict=True)},
                flag_values=", ".join(map(str, image.legend.numbers)),
                flag_meanings=" ".join("_".join(name.split()) for name in names),
            )
            colours = zip(image.legend.numbers, image.legend.colours.tolist(), strict=True)
            file.write_colormap(1, {number: (*colour, 255) for number, colour in colours})
        for first, values in image.rows():
            planes = np.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)
            file.write(planes.astype(image.dtype, copy=False), window=((first, first + len(values)), (0, x)))


def _tag_wavelengths(file: Any, image: Layer) -> None:
    """Write each band's wavelength and width in GDAL's domain IMAGERY [um], and as its ENVI driver has them [nm]."""
    facts = {"wavelength": ("CENTRAL_WAVELENGTH_UM", image.wavelength_nm), "fwhm": ("FWHM_UM", image.fwhm_nm)}
    for name, (own, lengths) in facts.items():
        for band, length in enumerate(() if lengths is None else lengths, start=1):
            file.update_tags(band, ns="IMAGERY", **{own: f"{length / 1000:.9g}"})
            file.update_tags(band, **{name: f"{length:.9g}", "wavelength_units": "Nanometers"})
    for band, detector in enumerate(image.detector, start=1):
        file.update_tags(band, detector=str(detector))
