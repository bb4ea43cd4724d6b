"""Read area of interest, no-go zones and plots, and transform them to the pixels of the field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import Settings, ZoneChoice
from pipeline.errors import ZoneError
from pipeline.geometry.grid import SceneGrid
from pipeline.ground.field_places import FieldPlace, NoPlace, PlacedPicture, PosedField
from pipeline.ground.map_grid import ground_grid
from pipeline.ground.view import GroundView
from pipeline.ground.zones import FieldZones, extent_deg, field_zones, on_field, pixels_inside
from pipeline.lazy import BaseGeometry
from pipeline.simulator.scenes.scene import RasterScene
from storage.archive.keys import array_digest
from storage.readers.polygons import ZoneFile, crs_on, read_zones


@dataclass(frozen=True)
class SurveyZones:
    """Zones and plots on the pixels of a field."""

    place: FieldPlace
    grid: SceneGrid
    kept: FieldZones | None = None  # None: all of the field
    plots: Mapping[str, BaseGeometry] | None = None  # by name, in pixels; None where there are none
    notes: tuple[str, ...] = ()

    @cached_property
    def fractions(self) -> NDArray[np.float64] | None:
        """Return the fraction of each patch inside zones (patch,); None: all of it."""
        return None if self.kept is None else self.kept.patch_fractions(self.grid)

    @cached_property
    def left_out(self) -> NDArray[np.bool_] | None:
        """Return the pixels (y, x) outside of zones; None where there are none."""
        return None if self.kept is None else self.kept.left_out

    @cached_property
    def key(self) -> dict[str, str]:
        """Return the parameters of zones for store keys; empty without zones."""
        if self.kept is None:
            return {}
        no_go = {} if self.kept.no_go is None else {"no_go": array_digest(self.kept.no_go)}
        return {"zones": array_digest(self.kept.kept), **no_go}


def place_of_field(settings: Settings, scene: RasterScene) -> FieldPlace:
    """Return the georeference of the field: by a pose, by the scene, or none.

    Raises PoseError: no ground is visible from the pose, or the CRS does not suit it.
    """
    if settings.pose is None:
        return NoPlace(scene.shape, scene.pixel_m) if scene.geobox is None else PlacedPicture(scene.geobox)
    view = GroundView(settings.pose, settings.camera.ifov_rad)
    return PosedField(ground_grid(view, scene.shape, epsg=settings.map.epsg, resolution_m=settings.map.resolution_m))


def open_zones(files: ZoneChoice, place: FieldPlace, grid: SceneGrid) -> SurveyZones:
    """Read the ``files`` of the settings, and transform their polygons to the field.

    Raises ZoneError: a file is not valid, area or plots lie outside of the field, or zones leave no pixel.
    """
    notes: list[str] = []
    shape = grid.height, grid.width

    def read(source: str, *, named_by: str | None = None, needed: bool = True) -> dict[str, BaseGeometry]:
        """Return the polygons of a file by name, in pixels of the field."""
        found = read_zones(source, named_by=named_by)
        notes.extend(found.notes)
        found = replace(found, crs=crs_on(place, found.crs, source, ZoneError))
        if found.crs is None:
            notes.append(f"{source} is in pixels of the scene, x to the right and y down from its upper left corner")
        shapes = {name: on_field(one, found.crs, place) for name, one in found.shapes.items()}
        if not any(one.intersection(NoPlace(shape).outline).area > 0 for one in shapes.values()):
            if needed:
                raise ZoneError(_format_beside(found, place))
            notes.append(_format_beside(found, place))
        return shapes

    area = None if files.area is None else tuple(read(files.area).values())
    no_go = None if files.no_go is None else tuple(read(files.no_go, needed=False).values())
    plots = None if files.plots is None else read(files.plots, named_by=files.plots_name)
    inside = None if area is None else pixels_inside(area, shape)
    if inside is not None and not inside.any():
        raise ZoneError(
            f"the area of {files.area} contains no pixel centre: it is smaller than a pixel of this field; give a "
            "larger one, or leave it out"
        )
    kept = field_zones(inside, None if no_go is None else pixels_inside(no_go, shape, touched=True))
    if kept is not None and not kept.kept.any():
        all_of_it = "all of the field" if files.area is None else f"all of the area of {files.area}"
        raise ZoneError(f"the no-go zones of {files.no_go} cover {all_of_it}: nothing is left to survey")
    return SurveyZones(place, grid, kept, plots, tuple(notes))


def _format_beside(found: ZoneFile, place: FieldPlace) -> str:
    """Return a message on polygons that do not overlap the field, with the bounds of both."""
    each = [one.bounds if found.crs is None else extent_deg(one, found.crs) for one in found.shapes.values()]
    low, high = np.min(each, axis=0).tolist(), np.max(each, axis=0).tolist()
    field = place.outline.bounds if place.crs is None else extent_deg(place.outline, place.crs)
    expected, got = (
        f"x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}"
        for west, south, east, north in (field, (*low[:2], *high[2:]))
    )
    return (
        f"the polygons of {found.path} do not lie on the field: expected some in {expected}, got {got} "
        f"[{'px' if place.crs is None else 'deg'}]; check their CRS and the place of the field"
    )
