"""Write and read the georeference of stored images: a GeoBox, or the camera's angles.

A GeoBox is written as CF's grid mapping with coordinates of pixel centres, and as GeoZarr's attributes ``proj:`` and
``spatial:``. Plain xarray, rioxarray and odc-geo read both. The coordinates of a rotated grid count pixels, as in
odc-geo; its grid mapping has the GeoTransform.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import odc.geo.crs as odc_crs
import odc.geo.geobox as odc_geobox
import zarr
from affine import Affine
from odc.geo.geobox import GeoBox

from spectralzoom.pipeline.ground.georeference import zoomed_out
from spectralzoom.storage.arrays.layout import SmallArray, create_group, damage_named, open_group

GRID_MAPPING = "spatial_ref"
# on every image: CF's link to the grid mapping, and the same as a coordinate, so that plain xarray takes it for one
ON_THE_MAP = {"grid_mapping": GRID_MAPPING, "coordinates": GRID_MAPPING}
_PROJ, _SPATIAL = (
    {
        "uuid": uuid,
        "name": name,
        "schema_url": f"https://raw.githubusercontent.com/zarr-conventions/{name}/refs/tags/v0.1/schema.json",
        "spec_url": f"https://github.com/zarr-conventions/{name}/blob/v0.1/README.md",
        "description": description,
    }
    for uuid, name, description in (
        ("f17cb550-5864-4468-aeb7-f3180cfb622f", "proj", "Coordinate reference system of the map"),
        ("689b58e2-cf7b-45e0-9fff-9cfc0883d6b4", "spatial", "Relation of array indices to the map's coordinates"),
    )
)
_OF_ANGLES = "Relation of array indices to tangents of the undeflected direction; there is no CRS"
_DEGREES = {"x": ("longitude", "degrees_east"), "y": ("latitude", "degrees_north")}


@dataclass(frozen=True)
class AngularGrid:
    """The grid of an image in tangents from the undeflected direction, the scene's centre; and its place on earth."""

    ifov_rad: float
    scene_shape: tuple[int, int]  # (y, x) of the fine grid [px]
    factor: int = 1  # fine px a pixel
    geobox: GeoBox | None = None  # of the fine grid, where the scene's file says it

    def box(self, shape: tuple[int, int]) -> GeoBox:
        """Return the grid of an image of (y, x) ``shape``: on the earth if known, else in tangents without a CRS."""
        if self.geobox is not None:
            return zoomed_out(self.geobox, self.factor, shape)
        step = self.ifov_rad * self.factor
        top, left = (-size / 2 * self.ifov_rad for size in self.scene_shape)
        return odc_geobox.GeoBox(shape, Affine(step, 0.0, left, 0.0, step, top), None)

    def record(self) -> dict[str, Any]:
        """Return the values from which `grid_of` makes this grid of angles again."""
        return {"ifov_rad": self.ifov_rad, "scene_shape": list(self.scene_shape), "factor": self.factor}


def grid_of(attributes: Mapping[str, Any]) -> AngularGrid | None:
    """Return the grid of angles that a group's attributes record, or None."""
    record = attributes.get("angular_grid")
    if not isinstance(record, dict):
        return None
    y, x = record["scene_shape"]
    return AngularGrid(float(record["ifov_rad"]), (int(y), int(x)), int(record["factor"]))


def create_placed_group(
    path: Path, title: str, grid: AngularGrid | None, shape: tuple[int, ...], attributes: Mapping[str, Any]
) -> tuple[zarr.Group, dict[str, Any]]:
    """Create a store for images of (y, x) ``shape`` on a scene's grid, with the coordinates y and x.

    Returns the store, and the georeference attributes for each of its images.
    """
    if grid is None:
        return create_group(path, title, attributes), {}
    geobox = grid.box((shape[0], shape[1]))
    place = map_attributes(geobox)
    facts = {**place, "angular_grid": grid.record(), **attributes}
    group = create_group(path, title, facts, map_coordinates(geobox))
    return group, place if geobox.crs is None else {**place, **ON_THE_MAP}


def map_attributes(geobox: GeoBox) -> dict[str, Any]:
    """Return the GeoZarr ``proj:`` and ``spatial:`` attributes of a grid; the transform maps pixel corners."""
    crs = geobox.crs
    return {
        **({} if crs is None or crs.epsg is None else {"proj:code": f"EPSG:{crs.epsg}"}),
        **({} if crs is None else {"proj:wkt2": crs.to_wkt()}),
        "spatial:dimensions": ["y", "x"],
        "spatial:shape": list(geobox.shape),
        "spatial:transform_type": "affine",
        "spatial:transform": [float(number) for number in geobox.affine[:6]],
        "spatial:bbox": [float(number) for number in geobox.boundingbox.bbox],
        "spatial:registration": "pixel",
        "zarr_conventions": [_SPATIAL | {"description": _OF_ANGLES}] if crs is None else [_PROJ, _SPATIAL],
    }


def map_coordinates(geobox: GeoBox) -> dict[str, SmallArray]:
    """Return ``x`` and ``y`` of a grid, and of one on the earth the grid mapping ``spatial_ref``, by CF's rules."""
    import odc.geo.xr as odc_xr

    found: dict[str, SmallArray] = {}
    a, _, c, _, e, f = (float(number) for number in geobox.affine[:6])
    for name, size, step, first in (("x", geobox.shape[1], a, c), ("y", geobox.shape[0], e, f)):
        about = _axis(geobox.crs, name)
        if not geobox.axis_aligned:
            step, first = 1.0, 0.0
            about = {"long_name": f"pixels along {name}; the grid is turned, see GeoTransform", "units": "pixel"}
        centres = np.arange(size) * step + (first + step / 2)
        found[name] = SmallArray((name,), centres, {**about, "axis": name.upper()})
    if geobox.crs is None:
        return found
    mapping = odc_xr.xr_crs_coord(geobox.crs, transform=geobox.transform)
    return {**found, GRID_MAPPING: SmallArray((), np.asarray(mapping.values, np.int32), dict(mapping.attrs))}


def _axis(crs: odc_crs.CRS | None, name: str) -> dict[str, str]:
    """Return CF's attributes of one axis of a map, or of a grid of angles."""
    if crs is None:
        return {"long_name": f"tangent of the angle from the undeflected direction along {name}", "units": "rad"}
    unit = str(crs.proj.axis_info[0].unit_name).replace(" ", "_")
    standard, degrees = _DEGREES[name] if crs.geographic else (f"projection_{name}_coordinate", "")
    if crs.geographic and crs.proj.is_derived:
        standard, degrees = f"grid_{standard}", "degrees"
    units = {"metre": "m", "degree": degrees}.get(unit, unit)
    return {"standard_name": standard, "long_name": f"{name} of the pixel's centre on the map", "units": units}


def load_geobox(path: Path) -> GeoBox | None:
    """Read the grid of a stored map; None where it lies on an angular grid (IncompleteStoreError: missing, damaged)."""
    return geobox_of_group(open_group(path))


def geobox_of_group(group: zarr.Group) -> GeoBox | None:
    """Read the grid of an opened store; None where it lies on an angular grid (IncompleteStoreError: damaged)."""
    if GRID_MAPPING not in group:
        return None
    with damage_named(f"the grid of {group.store_path}"):
        mapping = dict(group[GRID_MAPPING].attrs)
        transform = Affine.from_gdal(*map(float, str(mapping["GeoTransform"]).split()))
        about: dict[str, Any] = dict(group.attrs)
        return odc_geobox.GeoBox(tuple(about["spatial:shape"]), transform, odc_crs.CRS(str(mapping["crs_wkt"])))
