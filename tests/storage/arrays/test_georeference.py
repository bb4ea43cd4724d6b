"""Where a map lies: CF and GeoZarr attributes, and the same GeoBox for whoever opens the store."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from odc.geo.geobox import GeoBox
from pyproj import CRS

from pipeline.errors import IncompleteStoreError, PoseError
from storage.arrays.ground_maps import ON_THE_MAP, load_geobox, map_attributes, write_map_coordinates
from storage.arrays.layout import AngularGrid, create_group, write_image

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # odc-geo on affine 3


def box(epsg: int = 32632, resolution: float = 0.03) -> GeoBox:
    """A map of 20 x 30 px or so at an awkward place."""
    return GeoBox.from_bbox((534257.67, 5772300.8, 534258.6, 5772301.43), crs=f"EPSG:{epsg}", resolution=resolution)


def write(path: Path, geobox: GeoBox) -> Path:
    """A store with one image on the map."""
    group = create_group(path, "a map", map_attributes(geobox))
    write_map_coordinates(group, geobox)
    image = np.arange(np.prod(geobox.shape), dtype=np.float32).reshape(geobox.shape)
    write_image(group, "height", ("y", "x"), image, {"units": "m", **ON_THE_MAP})
    return path


@pytest.mark.parametrize("epsg", [32632, 32756, 5041, 3034])
@pytest.mark.parametrize("resolution", [0.03, 0.007, 1 / 3])
def test_plain_xarray_sees_the_same_geobox(tmp_path: Path, epsg: int, resolution: float) -> None:
    """Opened without this project's code, dataset and image have the grid that was written, to the last bit."""
    geobox = box(epsg, resolution)
    path = write(tmp_path / "a.zarr", geobox)
    with xr.open_zarr(path, consolidated=False) as content:
        assert content.odc.geobox == geobox
        assert content["height"].odc.geobox == geobox
    assert load_geobox(path) == geobox


def test_coordinates_and_grid_mapping_are_cfs(tmp_path: Path) -> None:
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
        found = content["height"]
        assert "spatial_ref" in found.coords


def test_geozarr_attributes_say_the_same_as_the_grid() -> None:
    """proj: has code and WKT2, spatial: the transform and box of the grid, and both conventions are registered."""
    geobox = box()
    found = map_attributes(geobox)
    assert found["proj:code"] == "EPSG:32632"
    assert CRS(found["proj:wkt2"]) == CRS.from_epsg(32632)
    a, b, c, d, e, f = found["spatial:transform"]
    rows, columns = found["spatial:shape"]
    assert (a, b, d, e) == (0.03, 0.0, 0.0, -0.03)
    assert found["spatial:bbox"] == pytest.approx([c, f + rows * e, c + columns * a, f])
    registered = {entry["name"]: entry for entry in found["zarr_conventions"]}
    assert set(registered) == {"proj", "spatial"}
    assert all(entry["uuid"] in text for entry, text in zip(registered.values(), UUIDS, strict=True))


UUIDS = ("f17cb550-5864-4468-aeb7-f3180cfb622f", "689b58e2-cf7b-45e0-9fff-9cfc0883d6b4")


def test_an_angular_store_has_no_geobox(tmp_path: Path) -> None:
    """Without a pose a store stays as it was: no CRS, no grid mapping, no coordinates."""
    grid = AngularGrid(1e-4, (20, 30))
    group = create_group(tmp_path / "a.zarr", "a mosaic", grid.attributes((20, 30)))
    write_image(group, "values", ("y", "x"), np.zeros((20, 30), np.float32), grid.attributes((20, 30)))
    assert load_geobox(tmp_path / "a.zarr") is None
    assert not {"proj:code", "proj:wkt2"} & set(group.attrs)


def test_damage_is_named(tmp_path: Path) -> None:
    """A store that is not there, and one whose grid mapping says nothing."""
    with pytest.raises(IncompleteStoreError, match="no readable Zarr store"):
        load_geobox(tmp_path / "none.zarr")
    path = write(tmp_path / "a.zarr", box())
    group = zarr.open_group(path, mode="r+")
    group["spatial_ref"].attrs.put({})
    with pytest.raises(IncompleteStoreError, match=r"the grid of .*a\.zarr cannot be read"):
        load_geobox(path)


def test_a_grid_without_a_crs_is_no_map() -> None:
    """What has no CRS, or lies askew, is refused."""
    for geobox in (GeoBox(box().shape, box().affine, None), box().rotate(20)):
        with pytest.raises(PoseError, match="needs a CRS and a grid along its axes"):
            map_attributes(geobox)
