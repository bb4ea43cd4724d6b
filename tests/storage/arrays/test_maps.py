"""Stored maps are read as written, in blocks or at once, with areas in hectares; wrong blocks are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS

from spectralzoom.pipeline.errors import IncompleteStoreError, ShapeError
from spectralzoom.pipeline.geometry.grid import UNLABELLED
from spectralzoom.storage.arrays import class_maps, georeference, layout
from spectralzoom.storage.arrays.ground_maps import GroundMapWriter, load_ground_map
from tests.storage.small_archive import write_class_map

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # odc-geo on affine 3
LEGEND = class_maps.ClassNames(("sugar beet", "bare soil"), np.array([[10, 200, 30], [120, 90, 60]], np.uint8))


def begin(path: Path, shape: tuple[int, int] = (100, 90), *, goes_on: bool = False) -> GroundMapWriter:
    """Return a writer of a map of the shape."""
    geobox = GeoBox.from_bbox((0, 0, shape[1] * 0.5, shape[0] * 0.5), crs="EPSG:32632", shape=shape, tight=True)
    return GroundMapWriter(path, geobox, LEGEND, about={"rig_pose": {"tilt_deg": 40}}, goes_on=goes_on)


def block(shape: tuple[int, int], *, goes_on: bool = False) -> dict[str, np.ndarray]:
    """Return images with some pixels unclassified: classes, confidence, picture; for a later visit changes too."""
    rng = np.random.default_rng(0)
    classes, old = rng.choice(np.array([0, 1, UNLABELLED], np.uint8), (2, *shape))
    confidence = np.where(classes == UNLABELLED, np.nan, rng.random(shape)).astype(np.float32)
    picture = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
    images = {"classes": classes, "confidence": confidence, "picture": picture}
    return images | {"changed_from": old} if goes_on else images


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_map_written_in_blocks_round_trips(tmp_path: Path, goes_on: bool) -> None:
    """Arrays, class names, colours and shape are read as written; a first visit's map has no changes."""
    writer = begin(tmp_path / "a.zarr", (150, 700), goes_on=goes_on)
    whole = block((150, 700), goes_on=goes_on)
    for rows in (slice(0, 64), slice(64, 150)):
        for columns in (slice(0, layout.SHARD_COLUMNS), slice(layout.SHARD_COLUMNS, 700)):
            writer.write_block(rows, columns, {name: image[rows, columns] for name, image in whole.items()})
    writer.finish(np.zeros(2))
    found = load_ground_map(tmp_path / "a.zarr")
    group = layout.open_group(tmp_path / "a.zarr")
    for name, image in whole.items():
        np.testing.assert_array_equal(layout.read_array(group, name), image)
    assert ("changed_from" in group) == goes_on
    legend = class_maps.legend_of(group)
    assert legend.names == LEGEND.names
    np.testing.assert_array_equal(legend.colours, LEGEND.colours)
    assert tuple(found.geobox.shape) == (150, 700)


@pytest.mark.parametrize(("areas_m2", "fractions"), [((7500.0, 2500.0), (0.75, 0.25)), ((0.0, 0.0), (0.0, 0.0))])
def test_areas_are_kept_in_hectares(tmp_path: Path, areas_m2: tuple[float, ...], fractions: tuple[float, ...]) -> None:
    """Each class has square metres, hectares and a fraction; in a map without classes all fractions are 0."""
    begin(tmp_path / "a.zarr").finish(np.array(areas_m2))
    found = load_ground_map(tmp_path / "a.zarr").areas
    for name, m2, fraction in zip(LEGEND.names, areas_m2, fractions, strict=True):
        assert found[name] == {"m2": m2, "ha": m2 / 10_000, "fraction": fraction}


def test_xarray_reads_flags_areas_and_grid_of_a_map(tmp_path: Path) -> None:
    """Flags, areas, pose, units and grid mapping need no project code; unwritten pixels are nodata or NaN."""
    writer = begin(tmp_path / "a.zarr", goes_on=True)
    images = block((64, 90), goes_on=True)
    writer.write_block(slice(0, 64), slice(0, 90), images)
    writer.finish(np.ones(2))
    with xr.open_zarr(tmp_path / "a.zarr", consolidated=False) as content:
        assert content.classes.dims == ("y", "x")
        assert content.classes.attrs["flag_meanings"] == "sugar_beet bare_soil"
        assert content.classes.odc.crs.epsg in (None, 32632)
        assert content.attrs["rig_pose"] == {"tilt_deg": 40}
        assert set(content.attrs["areas"]) == set(LEGEND.names)
        assert (content.classes[64:].values == content.classes.attrs["nodata"]).all()
        assert np.isnan(content.confidence[64:].values).all()
        assert content.changed_from.odc.geobox == content.classes.odc.geobox
        assert content.changed_from.attrs["flag_meanings"] == "sugar_beet bare_soil"
        assert (content.changed_from[64:].values == 255).all()


def test_a_class_without_a_name_is_refused(tmp_path: Path) -> None:
    """The error names the class and the number of class names."""
    writer = begin(tmp_path / "a.zarr", goes_on=True)
    images = block((64, 90), goes_on=True)
    place = slice(0, 64), slice(0, 90)
    for name in ("classes", "changed_from"):
        with pytest.raises(ShapeError, match="class 2 is in the map, but only 2 classes have names"):
            writer.write_block(*place, images | {name: np.full_like(images[name], 2)})


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_block_must_have_the_images_of_its_map(tmp_path: Path, goes_on: bool) -> None:
    """A first visit's map refuses changes, a later one requires them; the error lists the expected images."""
    writer = begin(tmp_path / "a.zarr", goes_on=goes_on)
    with pytest.raises(ShapeError, match="give classes, confidence, picture" + (", changed" if goes_on else "")):
        writer.write_block(slice(0, 64), slice(0, 90), block((64, 90), goes_on=not goes_on))


def test_load_ground_map_refuses_an_angular_map(tmp_path: Path) -> None:
    """The error says that the store has no grid mapping."""
    layout.create_group(tmp_path / "a.zarr", "class map", {})
    with pytest.raises(IncompleteStoreError, match="no grid mapping; it is no map of the ground"):
        load_ground_map(tmp_path / "a.zarr")


def box(epsg: int = 32632, resolution: float = 0.03) -> GeoBox:
    """Return a map grid of about 20 x 30 px with uneven bounds."""
    return GeoBox.from_bbox((534257.67, 5772300.8, 534258.6, 5772301.43), crs=f"EPSG:{epsg}", resolution=resolution)


def write(path: Path, geobox: GeoBox) -> Path:
    """Write a store with one image on the map grid, and return its path."""
    group = layout.create_group(
        path, "a map", georeference.map_attributes(geobox), georeference.map_coordinates(geobox)
    )
    image = np.arange(np.prod(geobox.shape), dtype=np.float32).reshape(geobox.shape)
    layout.write_image(group, "height", ("y", "x"), image, {"units": "m", **georeference.ON_THE_MAP})
    return path


@pytest.mark.parametrize(("epsg", "resolution", "turn"), [(32632, 0.03, 0), (5041, 1 / 3, 30)])
def test_xarray_reads_the_same_geobox(tmp_path: Path, epsg: int, resolution: float, turn: float) -> None:
    """Dataset and image have the grid that was written, to the last bit, without this project's code."""
    geobox = box(epsg, resolution).rotate(turn) if turn else box(epsg, resolution)
    path = write(tmp_path / "a.zarr", geobox)
    with xr.open_zarr(path, consolidated=False) as content:
        assert content.odc.geobox == geobox
        assert content["height"].odc.geobox == geobox
    assert georeference.load_geobox(path) == geobox


def test_coordinates_and_grid_mapping_follow_cf(tmp_path: Path) -> None:
    """x and y are pixel centres with standard names; the grid mapping holds WKT, GeoTransform and its CF name."""
    geobox = box()
    with xr.open_zarr(write(tmp_path / "a.zarr", geobox), consolidated=False) as content:
        for name in ("x", "y"):
            about = content[name].attrs
            assert about["standard_name"] == f"projection_{name}_coordinate"
            assert (about["units"], about["axis"]) == ("m", name.upper())
        left, top = geobox.affine * (0.5, 0.5)
        assert (content.x[0], content.y[0]) == (pytest.approx(left), pytest.approx(top))
        mapping = content["spatial_ref"].attrs
        assert CRS(mapping["crs_wkt"]) == CRS.from_epsg(32632)
        assert mapping["grid_mapping_name"] == "transverse_mercator"
        assert [float(word) for word in mapping["GeoTransform"].split()][1] == 0.03
        assert "spatial_ref" in content["height"].coords


@pytest.mark.parametrize(("epsg", "unit"), [(4326, "degrees_north"), (4807, "grad")])
def test_a_geographic_crs_has_longitude_and_latitude(tmp_path: Path, epsg: int, unit: str) -> None:
    """The axes have the standard names and units of CF, and the grid is read as it was written."""
    geobox = GeoBox((20, 30), Affine(1e-5, 0, 7.5, 0, -1e-5, 52), f"EPSG:{epsg}")
    with xr.open_zarr(write(tmp_path / "a.zarr", geobox), consolidated=False) as content:
        assert content.x.attrs["standard_name"] == "longitude"
        assert (content.y.attrs["standard_name"], content.y.attrs["units"]) == ("latitude", unit)
        assert content.odc.geobox == georeference.load_geobox(tmp_path / "a.zarr") == geobox


def test_geozarr_attributes_match_the_grid() -> None:
    """`proj:` has code and WKT2, `spatial:` has transform and bounding box, and both conventions are registered."""
    found = georeference.map_attributes(box())
    assert found["proj:code"] == "EPSG:32632"
    assert CRS(found["proj:wkt2"]) == CRS.from_epsg(32632)
    a, b, c, d, e, f = found["spatial:transform"]
    rows, columns = found["spatial:shape"]
    assert (a, b, d, e) == (0.03, 0.0, 0.0, -0.03)
    assert found["spatial:bbox"] == pytest.approx([c, f + rows * e, c + columns * a, f])
    registered = {entry["name"]: entry for entry in found["zarr_conventions"]}
    assert {name: entry["uuid"] for name, entry in registered.items()} == {
        "proj": "f17cb550-5864-4468-aeb7-f3180cfb622f",
        "spatial": "689b58e2-cf7b-45e0-9fff-9cfc0883d6b4",
    }


def test_an_angular_store_has_no_geobox(tmp_path: Path) -> None:
    """A store without a position on the earth has no CRS and no grid mapping."""
    place = georeference.map_attributes(georeference.AngularGrid(1e-4, (20, 30)).box((20, 30)))
    group = layout.create_group(tmp_path / "a.zarr", "a mosaic", place)
    layout.write_image(group, "values", ("y", "x"), np.zeros((20, 30), np.float32), place)
    assert georeference.load_geobox(tmp_path / "a.zarr") is None
    assert not {"proj:code", "proj:wkt2"} & set(group.attrs)


def test_load_geobox_refuses_a_damaged_store(tmp_path: Path) -> None:
    """A missing store and an empty grid mapping each raise an error."""
    with pytest.raises(IncompleteStoreError, match="cannot be read"):
        georeference.load_geobox(tmp_path / "none.zarr")
    path = write(tmp_path / "a.zarr", box())
    group = zarr.open_group(path, mode="r+")
    group["spatial_ref"].attrs.put({})
    group.attrs.put({})
    with pytest.raises(IncompleteStoreError, match=r"the grid of .*a\.zarr cannot be read"):
        georeference.load_geobox(path)


# --- class maps on the grid of a mosaic ---------------------------------------------------------------------------

SHAPE = (150, 700)


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _drawn() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 2, SHAPE).astype(np.uint8)
    classes[:70, :40] = 255
    return classes, np.where(classes == 255, np.nan, rng.random(SHAPE)).astype(np.float32)


def test_class_map_tiles_equal_the_map_written_at_once(tmp_path: Path) -> None:
    """Tiles of whole shards, in any order, give the same files byte by byte."""
    classes, confidence = _drawn()
    grid = georeference.AngularGrid(1e-4, SHAPE)
    write_class_map(tmp_path / "one.zarr", class_maps.ClassMap(classes, confidence, LEGEND), grid)
    class_maps.create_class_map(tmp_path / "tiles.zarr", SHAPE, LEGEND, grid=grid)
    begun = class_maps.load_class_map(tmp_path / "tiles.zarr")
    assert (begun.classes == 255).all()  # unwritten tiles
    assert np.isnan(begun.confidence).all()
    for rows, columns in [((64, 150), (640, 700)), ((0, 64), (0, 700)), ((64, 150), (0, 640))]:
        part = np.s_[slice(*rows), slice(*columns)]
        class_maps.write_class_tile(tmp_path / "tiles.zarr", (rows[0], columns[0]), classes[part], confidence[part])
    assert _contents(tmp_path / "one.zarr") == _contents(tmp_path / "tiles.zarr")


def test_write_class_tile_refuses_wrong_input(tmp_path: Path) -> None:
    """A class without a name and a map that does not exist are refused."""
    class_maps.create_class_map(tmp_path / "c.zarr", (20, 30), LEGEND)
    ones = np.ones((20, 30), np.uint8)
    with pytest.raises(ShapeError, match="class 2 is in the map, but only 2 classes have names"):
        class_maps.write_class_tile(tmp_path / "c.zarr", (0, 0), 2 * ones, ones.astype(np.float32))
    with pytest.raises(IncompleteStoreError, match=r"none\.zarr cannot be read"):
        class_maps.write_class_tile(tmp_path / "none.zarr", (0, 0), ones, ones.astype(np.float32))


def test_legends_have_the_numbers_of_the_label_files() -> None:
    """A name that has its number already, and maps that count from 0, need none."""
    legend = class_maps.ClassNames(("weed", "class_9"), LEGEND.colours, (4, 9))
    assert legend.titles == ("weed (4)", "class_9")
    assert LEGEND.titles == LEGEND.names


def test_blank_pixels_clears_only_the_chosen_pixels(tmp_path: Path) -> None:
    """The pixels may lie in any shard; if none is chosen, the files keep their bytes."""
    classes, confidence = _drawn()
    write_class_map(tmp_path / "m.zarr", class_maps.ClassMap(classes, confidence, LEGEND))
    before = _contents(tmp_path / "m.zarr")
    gone = np.zeros(SHAPE, np.bool_)
    layout.blank_pixels(tmp_path / "m.zarr", gone, layout.NO_CLASS)
    assert _contents(tmp_path / "m.zarr") == before
    gone[60:70, 630:650], gone[149, 699] = True, True
    layout.blank_pixels(tmp_path / "m.zarr", gone, layout.NO_CLASS)
    left = class_maps.load_class_map(tmp_path / "m.zarr")
    np.testing.assert_array_equal(left.classes, np.where(gone, 255, classes))
    np.testing.assert_allclose(left.confidence, np.where(gone, np.nan, confidence), atol=class_maps.CONFIDENCE_STEP / 2)


@pytest.mark.parametrize("numbers", [(), (7, 0, 254)])
def test_class_map_round_trip(tmp_path: Path, numbers: tuple[int, ...]) -> None:
    """Classes, names and colours are read as written; xarray reads CF flags and label values, 255 for no class."""
    classes = np.random.default_rng(0).integers(0, 3, (50, 70), dtype=np.uint8)
    classes[0, :9] = 255
    confidence = np.where(classes == 255, np.nan, 0.75).astype(np.float32)
    colours = np.array([[0, 0, 0], [0, 255, 0], [255, 0, 0]], np.uint8)
    made = class_maps.ClassMap(
        classes, confidence, class_maps.ClassNames(("bare soil", "crop", "weed"), colours, numbers)
    )
    write_class_map(tmp_path / "c.zarr", made)
    found = class_maps.load_class_map(tmp_path / "c.zarr")
    np.testing.assert_array_equal(found.classes, classes)
    np.testing.assert_array_equal(found.colours, colours)
    assert class_maps.class_counts(found.classes, 2).tolist() == [(classes == 0).sum(), (classes == 1).sum()]
    assert found.names == ("bare soil", "crop", "weed")
    with xr.open_zarr(tmp_path / "c.zarr", consolidated=False) as data:
        assert data["classes"].attrs["flag_meanings"] == "bare_soil crop weed"
        values = data["classes"].attrs["flag_values"]
        assert values == list(numbers or range(3))
        np.testing.assert_array_equal(data["classes"], np.append(values, [255] * 253)[np.minimum(classes, 3)])
        assert data["classes"].dtype == np.uint8
        assert int((data["classes"] == data["classes"].attrs["nodata"]).sum()) == 9
