"""Where an image lies on the earth: CF grid mapping and coordinates, GeoZarr attributes, and the GeoBox they hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import PoseError
from storage.arrays.layout import SHARD_ROWS, damage_named, open_group, read_array, read_bands, write_small

if TYPE_CHECKING:
    from odc.geo.crs import CRS
    from odc.geo.geobox import GeoBox


GRID_MAPPING = "spatial_ref"
# on every image: CF's link to the grid mapping, and the same as a coordinate, so that plain xarray takes it for one
ON_THE_MAP = {"grid_mapping": GRID_MAPPING, "coordinates": GRID_MAPPING}
_CONVENTIONS = [
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
]


def map_attributes(geobox: GeoBox) -> dict[str, Any]:
    """GeoZarr ``proj:`` and ``spatial:`` attributes of a map; the transform maps pixel corners.

    Raises PoseError: the grid has no CRS, or does not lie along its axes.
    """
    crs = _crs_of(geobox)
    code = {} if crs.epsg is None else {"proj:code": f"EPSG:{crs.epsg}"}
    return {
        **code,
        "proj:wkt2": crs.to_wkt(),
        "spatial:dimensions": ["y", "x"],
        "spatial:shape": list(geobox.shape),
        "spatial:transform_type": "affine",
        "spatial:transform": [float(number) for number in geobox.affine[:6]],
        "spatial:bbox": [float(number) for number in geobox.boundingbox.bbox],
        "spatial:registration": "pixel",
        "zarr_conventions": _CONVENTIONS,
    }


def write_map_coordinates(group: zarr.Group, geobox: GeoBox) -> None:
    """Store ``x``, ``y`` and the grid mapping ``spatial_ref`` of a map, as CF wants them."""
    from odc.geo.xr import xr_crs_coord

    for name in ("x", "y"):
        about = {
            "standard_name": f"projection_{name}_coordinate",
            "long_name": f"{name} of the pixel's centre on the map",
            "units": "m",
            "axis": name.upper(),
        }
        write_small(group, name, (name,), np.asarray(geobox.coordinates[name].values, np.float64), about)
    mapping = xr_crs_coord(_crs_of(geobox), transform=geobox.transform)
    write_small(group, GRID_MAPPING, (), np.asarray(mapping.values, np.int32), dict(mapping.attrs))


def _crs_of(geobox: GeoBox) -> CRS:
    if geobox.crs is None or not geobox.axis_aligned:
        raise PoseError(f"a map needs a CRS and a grid along its axes, got {geobox!r}")
    return geobox.crs


def load_geobox(path: Path) -> GeoBox | None:
    """Read the grid of a stored map; None where the store lies on an angular grid.

    Raises IncompleteStoreError: the store is missing, or what says its grid is damaged.
    """
    if GRID_MAPPING not in open_group(path):
        return None
    import odc.geo.xr  # noqa: F401 - registers the accessor
    import xarray as xr

    with damage_named(f"the grid of {path}"), xr.open_zarr(path, consolidated=False) as content:
        geobox: GeoBox | None = content.odc.geobox
        if geobox is None or geobox.crs is None:
            raise KeyError(f"{GRID_MAPPING}, x and y give none")
    return geobox


@dataclass(frozen=True)
class StoredImage:
    """An image or cube of a store, (y, x) or (y, x, band), not yet read."""

    group: zarr.Group
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def about(self) -> Mapping[str, Any]:
        """Attributes of the store."""
        return dict(self.group.attrs)

    @property
    def on_map(self) -> bool:
        """Whether the store says where on the earth it lies."""
        return GRID_MAPPING in self.group

    def rows(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Rows with the number of the first, as many at a time as a shard has.

        Raises IncompleteStoreError: a checksum says that the bytes have changed.
        """
        for first in range(0, self.shape[0], SHARD_ROWS):
            yield first, read_array(self.group, self.name, slice(first, min(first + SHARD_ROWS, self.shape[0])))


def open_image(path: Path, name: str) -> StoredImage:
    """Open one array of the store at ``path``. Raises IncompleteStoreError where it is missing or damaged."""
    group = open_group(path)
    with damage_named(f"{group.store_path}/{name}"):
        array = group[name]
        if not isinstance(array, zarr.Array):
            raise KeyError(f"{name} is no array")
        return StoredImage(group, name, array.shape, array.dtype)


def load_bands(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Wavelengths and widths [nm] of the store at ``path``. Raises IncompleteStoreError where they are damaged."""
    return read_bands(open_group(path))
