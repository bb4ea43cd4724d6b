"""Read area of interest and plots, and transform them to the pixels of the field."""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.zones import SurveyZones
from spectralzoom.pipeline.errors import ZoneError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.field_places import FieldPlace, GroundPlace, NoPlace, PlacedPicture, PosedField
from spectralzoom.pipeline.ground.map_grid import ground_grid
from spectralzoom.pipeline.ground.view import GroundView
from spectralzoom.pipeline.ground.zones import extent_deg, on_field, pixels_inside
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.readers.polygons import ZoneFile, place_on_earth, read_zones


def place_of_field(settings: Settings, scene: RasterScene) -> FieldPlace:
    """Return the georeference of the field: by a pose, by the scene, or none.

    Raises PoseError: no ground is visible from the pose, or the CRS does not suit it.
    """
    if settings.pose is None:
        return NoPlace(scene.shape, scene.pixel_m) if scene.geobox is None else PlacedPicture(scene.geobox)
    view = GroundView(settings.pose, settings.camera.ifov_rad)
    return PosedField(ground_grid(view, scene.shape))


def open_zones(settings: Settings, place: FieldPlace, grid: SceneGrid) -> SurveyZones:
    """Read the files of area and plots of the settings, and transform their polygons to the field.

    Raises ZoneError: a file is not valid, the field has no place on the earth, or area or plots lie outside of it.
    """
    notes: list[str] = []
    shape = grid.height, grid.width

    def read(source: str, *, named_by: str | None = None) -> dict[str, BaseGeometry]:
        """Return the polygons of a file by name, in pixels of the field."""
        found = read_zones(source, named_by=named_by)
        notes.extend(found.notes)
        on = place_on_earth(place, source, ZoneError)
        shapes = {name: on_field(one, found.crs, on) for name, one in found.shapes.items()}
        if not any(one.intersection(shapely.box(0, 0, *shape[::-1])).area > 0 for one in shapes.values()):
            raise ZoneError(_format_beside(found, on))
        return shapes

    area = None if settings.area is None else tuple(read(settings.area).values())
    plots = None if settings.plots is None else read(settings.plots, named_by=settings.plots_name)
    inside = None if area is None else pixels_inside(area, shape)
    if inside is not None and not inside.any():
        raise ZoneError(
            f"the area of {settings.area} contains no pixel centre: it is smaller than a pixel of this field; give a "
            "larger one, or leave it out"
        )
    return SurveyZones(grid, None if inside is None or inside.all() else inside, plots, tuple(notes))


def _format_beside(found: ZoneFile, place: GroundPlace) -> str:
    """Return a message on polygons that do not overlap the field, with the bounds of both."""
    each = [extent_deg(one, found.crs) for one in found.shapes.values()]
    low, high = np.min(each, axis=0).tolist(), np.max(each, axis=0).tolist()
    field = extent_deg(place.outline, place.crs)
    expected, got = (
        f"x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}"
        for west, south, east, north in (field, (*low[:2], *high[2:]))
    )
    return (
        f"the polygons of {found.path} do not lie on the field: expected some in {expected}, got {got} "
        "[deg]; check their CRS and the place of the field"
    )
