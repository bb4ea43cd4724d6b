"""Read area of interest and plots, and transform them to the pixels of the field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from spectralzoom.flows.settings.settings import Settings
from spectralzoom.pipeline.errors import ZoneError
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.field_places import FieldPlace, GroundPlace, NoPlace, PlacedPicture, PosedField
from spectralzoom.pipeline.ground.map_grid import ground_grid
from spectralzoom.pipeline.ground.view import GroundView
from spectralzoom.pipeline.ground.zones import Mask, extent_deg, on_field, patch_means, pixels_inside
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.storage.readers.polygons import ZoneFile, place_on_earth, read_zones
from spectralzoom.storage.store import array_digest


@dataclass(frozen=True)
class SurveyZones:
    """Zones and plots on the pixels of a field."""

    place: FieldPlace
    grid: SceneGrid
    kept: Mask | None = None  # (y, x) pixels inside the area; None: all of the field
    plots: Mapping[str, BaseGeometry] | None = None  # by name, in pixels; None where there are none
    notes: tuple[str, ...] = ()

    @cached_property
    def fractions(self) -> NDArray[np.float64] | None:
        """Return the fraction of each patch inside zones (patch,); None: all of it."""
        return None if self.kept is None else patch_means(self.kept, self.grid)

    @property
    def shown_patches(self) -> Mask | None:
        """Return the patches (patch,) that hold a pixel to map, which lines have to show; None: all of them."""
        return None if self.fractions is None else self.fractions > 0

    @cached_property
    def left_out(self) -> Mask | None:
        """Return the pixels (y, x) outside of zones; None where there are none."""
        return None if self.kept is None else ~self.kept

    @cached_property
    def key(self) -> dict[str, str]:
        """Return the parameters of zones for store keys; empty without zones."""
        return {} if self.kept is None else {"zones": array_digest(self.kept)}


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
    return SurveyZones(place, grid, None if inside is None or inside.all() else inside, plots, tuple(notes))


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
