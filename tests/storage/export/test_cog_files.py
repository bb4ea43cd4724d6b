"""Cloud-optimised GeoTIFFs: rasterio reads them as written, with their layout; only whole files get a name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
import rasterio.shutil
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays.class_maps import ClassNames
from spectralzoom.storage.export.image_files import Layer, write_cog
from tests.storage.export.stac_rules import is_cog

LEGEND = ClassNames(("sugar beet", "soil & stones", "maïs"), np.array([[9, 200, 30], [120, 90, 60], [0, 0, 255]], "u1"))
FEW = (90, 70)


def on_map(shape: tuple[int, int], crs: str = "EPSG:32632") -> GeoBox:
    """Return a grid of 0.5 m somewhere in Germany."""
    height, width = (size / 2 for size in shape)
    return GeoBox.from_bbox((500000, 5770000, 500000 + width, 5770000 + height), crs=crs, resolution=0.5)


def angular(shape: tuple[int, int]) -> GeoBox:
    """Return a grid in tangents of angles."""
    return GeoBox(shape, Affine(1e-4, 0, -0.05, 0, 1e-4, -0.06), None)


def classes_of(shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return blocks of three classes, with 10 % of the pixels unlabelled."""
    rng = np.random.default_rng(4)
    small = rng.integers(0, 3, (-(-shape[0] // 20), -(-shape[1] // 20)), dtype=np.uint8)
    found = np.kron(small, np.ones((20, 20), np.uint8))[: shape[0], : shape[1]]
    return np.where(rng.random(shape) < 0.1, np.uint8(UNLABELLED), found)


def image_of(values: NDArray[Any], geobox: GeoBox, **more: Any) -> Layer:
    """Return an image whose rows come in blocks of 64."""
    bands = ("r", "g", "b")[: values.shape[2]] if values.ndim == 3 else ("class",)
    rows = lambda: ((first, values[first : first + 64]) for first in range(0, len(values), 64))  # noqa: E731
    return Layer(name="a", title="", geobox=geobox, dtype=values.dtype.name, bands=bands, rows=rows, **more)


def class_image(values: NDArray[Any], geobox: GeoBox) -> Layer:
    """Return an image of classes."""
    return image_of(values, geobox, nodata=UNLABELLED, legend=LEGEND, tags={"run": "r1"})


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832", "EPSG:3035", "EPSG:32733"])
def test_rasterio_reads_values_and_tags_as_written(tmp_path: Path, crs: str) -> None:
    """Values, CRS, transform, nodata, band names and tags of a map are those given."""
    values = classes_of(FEW)
    box = on_map(FEW, crs)
    write_cog(tmp_path / "a.tif", class_image(values, box))
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(file.read(1), values)
        assert file.crs == rasterio.crs.CRS.from_string(crs)
        assert file.transform == box.affine
        assert (file.nodata, file.descriptions, file.dtypes) == (UNLABELLED, ("class",), ("uint8",))
        assert file.tags()["run"] == "r1"


@pytest.mark.parametrize("dtype", ["uint8", "float32", "float64"])
def test_a_large_image_is_cloud_optimised(tmp_path: Path, dtype: str) -> None:
    """GDAL finds the COG layout with three bands: tiles of 512 px, and halving overviews down to one tile."""
    values = np.random.default_rng(1).integers(0, 200, (1100, 600, 3)).astype(dtype)
    write_cog(tmp_path / "a.tif", image_of(values, angular((1100, 600)), nodata=0))
    assert is_cog(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1), values)
        assert file.overviews(1) == [2, 4]
        assert file.block_shapes[0] == (512, 512)


def test_overviews_of_classes_show_the_commonest_class(tmp_path: Path) -> None:
    """Three white pixels and a black one give white, though grey is nearer to the mean of their colours."""
    greys = ClassNames(("black", "grey", "white"), np.repeat(np.array([[0], [180], [255]], "u1"), 3, axis=1))
    values = np.tile(np.array([[0, 2], [2, 2]], np.uint8), (300, 280))
    write_cog(tmp_path / "a.tif", replace(class_image(values, on_map(values.shape)), legend=greys))
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as file:
        assert set(np.unique(file.read(1))) == {2}


def test_overviews_of_confidence_ignore_nan(tmp_path: Path) -> None:
    """The mean of two known pixels and two NaN is the mean of the known."""
    values = np.full((1300, 1100), 0.25, np.float32)
    values[1::2] = np.nan
    write_cog(tmp_path / "a.tif", image_of(values, angular(values.shape)))
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as file:
        assert (file.read(1) == 0.25).all()


@pytest.mark.parametrize("numbers", [(0, 1, 2), (4, 1, 2)])
def test_classes_have_colours_and_names(tmp_path: Path, numbers: tuple[int, ...]) -> None:
    """The file has a colour table, tags, and GDAL's own category names, which a VRT made by GDAL repeats."""
    image = class_image(classes_of(FEW), on_map(FEW))
    write_cog(tmp_path / "a.tif", replace(image, legend=replace(LEGEND, values=numbers)))
    with rasterio.open(tmp_path / "a.tif") as file:
        table = file.colormap(1)
        tags = file.tags(1)
    assert [table[number][:3] for number in numbers] == [tuple(colour) for colour in LEGEND.colours.tolist()]
    assert [tags[f"CLASS_{number}"] for number in numbers] == list(LEGEND.names)
    assert tags["flag_meanings"] == "sugar_beet soil_&_stones maïs"
    rasterio.shutil.copy(str(tmp_path / "a.tif"), str(tmp_path / "a.vrt"), driver="VRT")
    names = ElementTree.parse(tmp_path / "a.vrt").getroot().findall(".//CategoryNames/Category")
    assert [names[number].text for number in numbers] == list(LEGEND.names)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_file_gets_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: float) -> None:
    """A file that does not read back as written is an error, even if GDAL reported none."""
    whole = rasterio.shutil.copy

    def cut(source: str, target: str, **options: str) -> None:
        whole(source, target, **options)
        with Path(target).open("r+b") as file:
            file.truncate(int(kept * Path(target).stat().st_size))

    monkeypatch.setattr(rasterio.shutil, "copy", cut)
    values = np.random.default_rng(2).random(FEW).astype(np.float32)
    with pytest.raises(ArchiveError, match=r"a\.tif (cannot be written|does not read back as written)"):
        write_cog(tmp_path / "a.tif", image_of(values, on_map(FEW)))
    assert list(tmp_path.iterdir()) == []
