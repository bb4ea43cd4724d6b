"""Where the pixels of a field's map lie on the earth, as a page holds it: a lattice to interpolate in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.ground.georeference import WGS84
from pipeline.ground.map_grid import MapFrame
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import pyproj
    from odc.geo.geobox import GeoBox
else:
    pyproj = deferred("pyproj")

Floats = NDArray[np.float64]
STEP_PX, MOST_STEPS = 32, 32  # between nodes; of a side


@dataclass(frozen=True)
class PagePlaces:
    """Places of nodes that are spread evenly over a map, from its first pixel's outer corner to its last one's."""

    crs: str  # as people call it, such as EPSG:32632
    on_map: Floats  # (row, column, 2) x and y in that CRS, NaN where a pixel shows no ground
    lon_lat: Floats  # (row, column, 2) [deg] WGS 84


def places_of_pose(frame: MapFrame, shape: tuple[int, int]) -> PagePlaces:
    """The ground that a posed rig sees in a field of (y, x) px."""
    y, x = _nodes(shape)
    points = np.stack(np.meshgrid(y - shape[0] / 2, x - shape[1] / 2, indexing="ij"), axis=-1)
    ground = frame.view.scene_to_ground(points)
    return PagePlaces(_called(frame.crs), frame.ground_to_map(ground), frame.ground_to_geodetic(ground)[..., :2])


def places_of_grid(geobox: GeoBox) -> PagePlaces | None:
    """The pixels of a map that has a CRS; None where it has none."""
    if geobox.crs is None:
        return None
    shape: Any = tuple(geobox.shape)
    y, x = np.meshgrid(*_nodes(shape), indexing="ij")
    a, b, c, d, e, f = geobox.affine[:6]
    on_map = np.stack([a * x + b * y + c, d * x + e * y + f], axis=-1)
    crs = pyproj.CRS.from_wkt(geobox.crs.to_wkt())
    found = pyproj.Transformer.from_crs(crs, WGS84, always_xy=True).transform(on_map[..., 0], on_map[..., 1])
    lon_lat = np.stack(found, axis=-1)
    return PagePlaces(_called(crs), on_map, np.where(np.isfinite(lon_lat), lon_lat, np.nan))


def _nodes(shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Rows and columns of the nodes [px], 0 being the outer edge of the first pixel."""
    rows, columns = (np.linspace(0, size, int(np.clip(-(-size // STEP_PX), 1, MOST_STEPS)) + 1) for size in shape)
    return rows, columns


def _called(crs: Any) -> str:
    code = crs.to_authority()
    return ":".join(code) if code else str(crs.name)
