"""Write images as cloud-optimised GeoTIFF by GDAL, block by block."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio.errors import RasterioError

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.arrays.class_maps import ClassNames
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.whole_files import written_aside

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
    try:
        _write_cog(path, image, blocks)
    except RasterioError as error:
        raise ArchiveError(f"{path} cannot be written: {error}; is there space on the disk?") from error


def _write_cog(path: Path, image: CogImage, blocks: Blocks) -> None:
    sidecar = f"{path.name}.aux.xml"
    with written_aside(path.parent, [path.name] if image.legend is None else [path.name, sidecar]) as aside:
        plain, made = aside / "plain.tif", aside / path.name
        _write_plain(plain, image, blocks)
        options = {
            "COMPRESS": "DEFLATE",  # every reader has it; not every build of GDAL has zstd
            "PREDICTOR": "NO" if image.legend is not None else "YES",  # neighbouring class numbers have no slope
            "OVERVIEW_RESAMPLING": "AVERAGE" if image.legend is None else "MODE",
            "BLOCKSIZE": str(TILE),
            "NUM_THREADS": "1",
        }
        rasterio.shutil.copy(str(plain), str(made), driver="COG", **options)
        with rasterio.open(plain) as wanted, rasterio.open(made) as found:
            with_nan = np.dtype(image.dtype).kind == "f"
            same = all(  # a tile holds every band
                np.array_equal(wanted.read(window=tile), found.read(window=tile), equal_nan=with_nan)
                for _, tile in found.block_windows(1)
            )
        if not same:
            raise ArchiveError(f"{path} does not read back as written; is the disk full? Run again")
        if image.legend is not None:
            root = ElementTree.Element("PAMDataset")
            names = ElementTree.SubElement(ElementTree.SubElement(root, "PAMRasterBand", band="1"), "CategoryNames")
            named = dict(zip(image.legend.numbers, image.legend.names, strict=True))
            for number in range(max(named) + 1):  # the place of a name is its number
                ElementTree.SubElement(names, "Category").text = named.get(number, "")
            ElementTree.ElementTree(root).write(aside / sidecar, encoding="utf-8")


def _write_plain(path: Path, image: CogImage, blocks: Blocks) -> None:
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
