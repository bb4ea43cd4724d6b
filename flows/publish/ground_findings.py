"""What a receipt says of the ground: the map's grid there, and hectares of each class."""

from __future__ import annotations

from typing import Any

from flows.survey.run import SurveyRun
from pipeline.ground.georeference import class_areas_m2, crs_name, pixel_side_m
from storage.arrays.class_maps import ClassMap
from storage.arrays.ground_maps import M2_PER_HECTARE, GroundMap


def posed_findings(drawn: GroundMap) -> dict[str, Any]:
    """Of a survey with a pose: the map that was drawn on the ground."""
    return {
        "crs": crs_name(drawn.geobox),
        "resolution_m": abs(float(drawn.geobox.resolution.x)),
        "shape": [int(size) for size in drawn.geobox.shape],
        "areas_ha": {name: area["ha"] for name, area in drawn.areas.items()},
    }


def placed_findings(run: SurveyRun, found: ClassMap) -> dict[str, Any]:
    """Of a survey whose scene's file says where it lies: the class map itself; nothing where it does not.

    Hectares are of the ellipsoid, not of the map's plane.
    """
    geobox = run.scene.geobox
    if geobox is None:
        return {}
    areas = class_areas_m2(geobox, found.classes, len(found.names)) / M2_PER_HECTARE
    ground = {
        "crs": crs_name(geobox),
        "resolution_m": pixel_side_m(geobox),
        "shape": [int(size) for size in geobox.shape],
        "areas_ha": dict(zip(found.names, areas.tolist(), strict=True)),
    }
    return {"ground": ground}
