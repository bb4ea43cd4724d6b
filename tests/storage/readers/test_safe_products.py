"""Sentinel-2 products, JPEG 2000, and TIFF files that say scale and offset; GDAL reads the same."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray

from pipeline.errors import SceneError
from storage.readers.open_cubes import open_cube
from storage.readers.scene_files import load_scene_file

pytestmark = pytest.mark.filterwarnings(
    "ignore:Use `@` matmul:PendingDeprecationWarning", "ignore:Dataset has no geotransform"
)
RNG = np.random.default_rng(9)
SIDE = 120  # pixels of 10 m
FINE, COARSE = ("B02", "B03", "B04", "B08"), ("B02", "B03", "B04", "B05", "B06", "B07", "B8A", "B11", "B12")
TILE, NAME = "L2A_T32UPC_A051234_20250601T101559", "S2B_MSIL2A_20250601T101559_N0511_R065_T32UPC_20250601T140211"
CENTRES = [442.2, 492.3, 558.9, 664.9, 703.8, 739.1, 779.7, 832.9, 864.0, 943.2, 1376.9, 1610.4, 2185.7]
BANDS = ("B1", "B2", "B3", "B4", "B5", "B6", "B7", "B8", "B8A", "B9", "B10", "B11", "B12")
REVERSIBLE = {"QUALITY": "100", "REVERSIBLE": "YES"}


def write_jp2(path: Path, values: NDArray[np.uint16], pixel_m: float = 10.0, **about: Any) -> Path:
    """A lossless JPEG 2000 of (band, y, x) values on a map."""
    count, height, width = values.shape
    place = {"crs": "EPSG:32632", "transform": Affine(pixel_m, 0, 600_000, 0, -pixel_m, 5_700_000)}
    path.parent.mkdir(parents=True, exist_ok=True)
    known = {"driver": "JP2OpenJPEG", "count": count, "height": height, "width": width, "dtype": "uint16"}
    with rasterio.open(path, "w", **known, **place, **REVERSIBLE, **about) as file:
        file.write(values)
    return path


def metadata_of_product(images: list[str], offset: int | None) -> str:
    """MTD_MSIL2A.xml with what GDAL and this reader ask of it."""
    spectra = "".join(
        f'<Spectral_Information bandId="{number}" physicalBand="{band}"><Wavelength><MIN unit="nm">1</MIN>'
        f'<MAX unit="nm">2</MAX><CENTRAL unit="nm">{centre}</CENTRAL></Wavelength></Spectral_Information>'
        for number, (band, centre) in enumerate(zip(BANDS, CENTRES, strict=True))
    )
    offsets = "".join(f'<BOA_ADD_OFFSET band_id="{number}">{offset}</BOA_ADD_OFFSET>' for number in range(13))
    files = "".join(f"<IMAGE_FILE>{name}</IMAGE_FILE>" for name in images)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<n1:Level-2A_User_Product xmlns:n1="https://psd-15.sentinel2.eo.esa.int/PSD/User_Product_Level-2A.xsd"><n1:General_Info>
<Product_Info><PRODUCT_URI>{NAME}.SAFE</PRODUCT_URI><PROCESSING_LEVEL>Level-2A</PROCESSING_LEVEL>
<PRODUCT_TYPE>S2MSI2A</PRODUCT_TYPE><Query_Options completeSingleTile="true">
<PRODUCT_FORMAT>SAFE_COMPACT</PRODUCT_FORMAT></Query_Options><Product_Organisation><Granule_List>
<Granule datastripIdentifier="DS" granuleIdentifier="{TILE}" imageFormat="JPEG2000">{files}</Granule>
</Granule_List></Product_Organisation></Product_Info>
<Product_Image_Characteristics><Special_Values><SPECIAL_VALUE_TEXT>NODATA</SPECIAL_VALUE_TEXT>
<SPECIAL_VALUE_INDEX>0</SPECIAL_VALUE_INDEX></Special_Values><QUANTIFICATION_VALUES_LIST>
<BOA_QUANTIFICATION_VALUE unit="none">10000</BOA_QUANTIFICATION_VALUE></QUANTIFICATION_VALUES_LIST>
{"" if offset is None else f"<BOA_ADD_OFFSET_VALUES_LIST>{offsets}</BOA_ADD_OFFSET_VALUES_LIST>"}
<Spectral_Information_List>{spectra}</Spectral_Information_List></Product_Image_Characteristics>
</n1:General_Info></n1:Level-2A_User_Product>"""


def metadata_of_tile() -> str:
    """MTD_TL.xml: the grid of each resolution."""
    grids = "".join(
        f'<Size resolution="{step}"><NROWS>{SIDE * 10 // step}</NROWS><NCOLS>{SIDE * 10 // step}</NCOLS></Size>'
        f'<Geoposition resolution="{step}"><ULX>600000</ULX><ULY>5700000</ULY><XDIM>{step}</XDIM><YDIM>-{step}</YDIM>'
        "</Geoposition>"
        for step in (10, 20, 60)
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<n1:Level-2A_Tile_ID xmlns:n1="https://psd-15.sentinel2.eo.esa.int/PSD/S2_PDI_Level-2A_Tile_Metadata.xsd">
<n1:Geometric_Info><Tile_Geocoding metadataLevel="Brief"><HORIZONTAL_CS_NAME>WGS84 / UTM zone 32N</HORIZONTAL_CS_NAME>
<HORIZONTAL_CS_CODE>EPSG:32632</HORIZONTAL_CS_CODE>{grids}</Tile_Geocoding></n1:Geometric_Info></n1:Level-2A_Tile_ID>"""


def write_product(folder: Path, offset: int | None = -1000) -> tuple[Path, dict[str, NDArray[np.uint16]]]:
    """Write a small product of level 2A; gives its folder and the numbers of its bands by name and resolution."""
    root = folder / f"{NAME}.SAFE"
    numbers: dict[str, NDArray[np.uint16]] = {}
    names = []
    for bands, pixel in ((FINE, 10), (COARSE, 20)):
        for band in bands:
            side = SIDE * 10 // pixel
            values = RNG.integers(1, 12_000, (1, side, side)).astype(np.uint16)
            values[0, 0, :3] = 0
            name = f"GRANULE/{TILE}/IMG_DATA/R{pixel}m/T32UPC_20250601T101559_{band}_{pixel}m"
            write_jp2(root / f"{name}.jp2", values, pixel)
            numbers[f"{band}_{pixel}m"], names = values[0], [*names, name]
    (root / "MTD_MSIL2A.xml").write_text(metadata_of_product(names, offset))
    (root / f"GRANULE/{TILE}/MTD_TL.xml").write_text(metadata_of_tile())
    return root, numbers


@pytest.fixture(scope="module")
def product(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, NDArray[np.uint16]]]:
    return write_product(tmp_path_factory.mktemp("product"))


def reflectance(numbers: dict[str, NDArray[np.uint16]], names: list[str], offset: float = -1000) -> NDArray[np.float64]:
    raw = np.stack([numbers[name] for name in names], axis=-1).astype(float)
    return np.where(raw == 0, np.nan, (raw + offset) / 10000)


@pytest.mark.parametrize("packed", [False, True])
def test_ten_metre_bands(packed: bool, product: Any, tmp_path: Path) -> None:
    """Reflectances with the offset of baseline 04.00, NaN for 0, wavelengths of the satellite, and the place."""
    path, numbers = product
    if packed:
        path = Path(shutil.make_archive(str(tmp_path / NAME), "zip", path.parent, path.name))
    scene = load_scene_file(path)
    expected = reflectance(numbers, [f"{band}_10m" for band in FINE])
    np.testing.assert_allclose(scene.values, expected, rtol=1e-6, atol=1e-9)
    assert scene.wavelength_nm.tolist() == [492.3, 558.9, 664.9, 832.9]
    assert scene.fwhm_nm is not None
    assert scene.fwhm_nm.tolist() == [65, 35, 30, 115]
    assert scene.geobox is not None
    assert scene.geobox.crs.epsg == 32632
    assert scene.geobox.affine[:6] == (10, 0, 600_000, 0, -10, 5_700_000)
    assert any(note.startswith("Sentinel-2 level 2A, bands B02, B03, B04, B08 of 10m") for note in scene.provenance)


def test_gdal_reads_the_same_product(product: Any) -> None:
    """Its driver gives the same numbers, which are the reflectances once offset and quantification are applied."""
    path, _ = product
    source = open_cube(path)
    with rasterio.open(f"SENTINEL2_L2A:{path / 'MTD_MSIL2A.xml'}:10m:EPSG_32632") as other:
        order = [
            other.descriptions.index(next(d for d in other.descriptions if d.startswith(f"{b},"))) + 1
            for b in ("B2", "B3", "B4", "B8")
        ]
        raw = np.moveaxis(other.read(order), 0, -1).astype(float)
        assert source.geobox is not None
        assert other.transform == source.geobox.affine
        assert [float(other.tags(band)["WAVELENGTH"]) for band in order] == [490, 560, 665, 842]
        widths = source.bands.fwhm_nm
        assert widths is not None
        assert [float(other.tags(band)["BANDWIDTH"]) for band in order] == widths.tolist()
    expected = np.where(raw == 0, np.nan, (raw - 1000) / 10000)
    np.testing.assert_allclose(source.read(0, SIDE), expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(source.read(50, 53), expected[50:53], rtol=1e-6, atol=1e-9)


def test_another_resolution_is_named(product: Any) -> None:
    """20 m has nine bands, with copies of the finer ones; 60 m has none here."""
    path, numbers = product
    scene = load_scene_file(f"{path}:20m")
    expected = reflectance(numbers, [f"{band}_20m" for band in COARSE])
    np.testing.assert_allclose(scene.values, expected, rtol=1e-6, atol=1e-9)
    assert scene.geobox is not None
    assert scene.geobox.affine.a == 20
    with pytest.raises(SceneError, match="has no bands of 60m"):
        load_scene_file(f"{path}:60m")
    with pytest.raises(SceneError, match="expected a resolution, 10m, 20m, 60m, after the colon"):
        load_scene_file(f"{path}:30m")


def test_products_before_the_offset(tmp_path: Path) -> None:
    """Without a list of offsets reflectance is the number over the quantification value."""
    path, numbers = write_product(tmp_path, offset=None)
    expected = reflectance(numbers, ["B02_10m"], offset=0)
    np.testing.assert_allclose(load_scene_file(path, bands=[0]).values, expected, rtol=1e-6)


def no_metadata(path: Path) -> None:
    (path / "MTD_MSIL2A.xml").unlink()


def damaged_metadata(path: Path) -> None:
    (path / "MTD_MSIL2A.xml").write_text("<Level-2A")


def no_quantification(path: Path) -> None:
    text = (path / "MTD_MSIL2A.xml").read_text()
    (path / "MTD_MSIL2A.xml").write_text(text.replace("BOA_QUANTIFICATION_VALUE", "OTHER"))


def cut_band(path: Path) -> None:
    band = next(path.rglob("*_B03_10m.jp2"))
    band.write_bytes(band.read_bytes()[:60])


def odd_band(path: Path) -> None:
    write_jp2(next(path.rglob("*_B03_10m.jp2")), np.ones((1, 8, 8), np.uint16))


def second_tile(path: Path) -> None:
    shutil.copytree(path / "GRANULE" / TILE, path / "GRANULE" / "L2A_T32UQC")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (no_metadata, r"has no metadata .*; give a Sentinel-2 product of level 1C or 2A"),
        (damaged_metadata, "MTD_MSIL2A.xml cannot be read as XML"),
        (no_quantification, "has no quantification value above 0"),
        (cut_band, "cannot be read as JPEG 2000"),
        (odd_band, "are of several sizes or places"),
        (second_tile, "holds 2 tiles, expected one"),
    ],
)
def test_damaged_products_end_in_one_message(spoil: Any, words: str, product: Any, tmp_path: Path) -> None:
    """Each names the product and what to do."""
    path = tmp_path / f"{NAME}.SAFE"
    shutil.copytree(product[0], path)
    spoil(path)
    with pytest.raises(SceneError, match=words):
        load_scene_file(path)


def test_a_zip_of_something_else(tmp_path: Path) -> None:
    """A .zip that is none, and one without a product."""
    (tmp_path / "a.zip").write_text("text")
    with pytest.raises(SceneError, match=r"cannot be read as a \.zip"):
        load_scene_file(tmp_path / "a.zip")
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "notes.txt").write_text("text")
    shutil.make_archive(str(tmp_path / "b"), "zip", tmp_path / "inner")
    with pytest.raises(SceneError, match="has no metadata"):
        load_scene_file(tmp_path / "b.zip")


def test_jpeg_2000(tmp_path: Path) -> None:
    """Numbers and place as rasterio gives them, whole and by lines; wavelengths have to be stated."""
    values = RNG.integers(1, 60_000, (3, 70, 50)).astype(np.uint16)
    path = write_jp2(tmp_path / "a.jp2", values)
    source = open_cube(path)
    assert source.geobox is not None
    np.testing.assert_array_equal(np.concatenate([source.read(0, 64), source.read(64, 70)]), np.moveaxis(values, 0, -1))
    np.testing.assert_array_equal(
        load_scene_file(path, wavelengths=[500, 600, 700]).values, np.moveaxis(values, 0, -1).astype(np.float32)
    )
    path.write_bytes(path.read_bytes()[:80])
    with pytest.raises(SceneError, match="cannot be read as JPEG 2000"):
        load_scene_file(path, wavelengths=[500, 600, 700])


def write_tiff(path: Path, scales: tuple[float, ...] | None = None, offsets: tuple[float, ...] = (0, 0)) -> Path:
    values = np.arange(24, dtype=np.int16).reshape(2, 3, 4) * 100
    with rasterio.open(path, "w", "GTiff", 4, 3, 2, dtype="int16", nodata=0, photometric="MINISBLACK") as file:
        file.write(values)
        if scales is not None:
            file.scales, file.offsets = scales, offsets
    return path


def test_scale_and_offset_of_tiff(tmp_path: Path) -> None:
    """Applied band by band, to a scene and by lines alike; no-data is found before; another scale, another hash."""
    scaled = write_tiff(tmp_path / "scaled.tif", (0.001, 0.002), (0.5, 0.0))
    scene = load_scene_file(scaled, wavelengths=[500, 600])
    raw = np.moveaxis(np.arange(24).reshape(2, 3, 4) * 100, 0, -1)
    expected = np.where(raw == 0, np.nan, raw * [0.001, 0.002] + [0.5, 0.0])
    np.testing.assert_allclose(scene.values, expected, rtol=1e-6)
    np.testing.assert_allclose(open_cube(scaled).read(1, 3), expected[1:3], rtol=1e-6)
    assert any(
        note.startswith("values are the file's numbers times 0.001 plus 0.5, or others") for note in scene.provenance
    )
    sidecar = write_tiff(tmp_path / "sidecar.tif")
    before = load_scene_file(sidecar, wavelengths=[500, 600])
    bands = "".join(f'<PAMRasterBand band="{band}"><Scale>0.1</Scale></PAMRasterBand>' for band in (1, 2))
    (tmp_path / "sidecar.tif.aux.xml").write_text(f"<PAMDataset>{bands}</PAMDataset>")
    after = load_scene_file(sidecar, wavelengths=[500, 600])
    np.testing.assert_allclose(after.values, before.values * 0.1, rtol=1e-6)
    assert before.light_hash != after.light_hash


def test_labels_are_never_scaled(tmp_path: Path) -> None:
    """A label file is numbers, whatever scale it says."""
    write_tiff(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "labels.tif", "w", "GTiff", 4, 3, 1, dtype="uint8", photometric="MINISBLACK") as file:
        file.write(np.arange(12, dtype=np.uint8).reshape(1, 3, 4) % 3 + 1)
        file.scales = (0.5,)
    scene = load_scene_file(tmp_path / "a.tif", labels=tmp_path / "labels.tif", wavelengths=[500, 600])
    assert scene.class_values == (1, 2, 3)


def test_unscaled_files_keep_their_hash(tmp_path: Path) -> None:
    """Files without a scale have the hash of their bytes, bands and wavelengths alone."""
    path = write_tiff(tmp_path / "plain.tif")
    scene = load_scene_file(path, wavelengths=[500, 600])

    parts = [hashlib.sha256(path.read_bytes()).hexdigest(), None, [0, 1], [500.0, 600.0], None]
    assert scene.light_hash == hashlib.sha256(json.dumps(parts).encode()).hexdigest()
