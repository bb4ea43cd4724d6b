"""Where a scene lies on the earth, as its file says: a GeoBox, what keys hold of it, and its coarser grids."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from affine import Affine

from pipeline.lazy import deferred

if TYPE_CHECKING:  # half a second to import, for scenes with a place alone
    import odc.geo.geobox as odc_geobox
    from odc.geo.geobox import GeoBox
else:
    odc_geobox = deferred("odc.geo.geobox")


def zoomed_out(geobox: GeoBox, factor: int, shape: tuple[int, int]) -> GeoBox:
    """The grid of (y, x) ``shape`` whose pixels are ``factor`` of the given one's a side, from the same corner.

    The last row and column may reach beyond the given grid: a scene is padded to whole coarse pixels.
    """
    if factor == 1 and tuple(geobox.shape) == shape:
        return geobox
    a, b, c, d, e, f = geobox.affine[:6]
    coarser = Affine(a * factor, b * factor, c, d * factor, e * factor, f)
    return odc_geobox.GeoBox(shape, coarser, geobox.crs)


def georeference_record(geobox: GeoBox | None) -> dict[str, Any]:
    """What says a place in the keys of stores: nothing for a scene that has none, so that its keys stay."""
    if geobox is None:
        return {}
    return {"georeference": {"crs": str(geobox.crs), "transform": [float(number) for number in geobox.affine[:6]]}}
