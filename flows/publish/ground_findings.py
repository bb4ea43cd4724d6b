"""What a receipt says of the ground: the map's grid there, hectares of each class, what changed and what is old."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flows.terminal.figures import area_words, counted
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import FieldPlace, areas_by_number
from pipeline.ground.field_scale import M2_PER_HECTARE
from pipeline.ground.georeference import class_areas_m2, crs_name, pixel_side_m
from storage.arrays.beliefs import BeliefStore
from storage.arrays.class_maps import ClassMap
from storage.arrays.ground_maps import GroundMap

if TYPE_CHECKING:
    from flows.survey.run import SurveyRun

OLDER_DAYS = (1, 7, 30)  # since a look, of which the hectares are told
MOST_CHANGES = 4  # told in words


def find_ground(run: SurveyRun, posed: GroundMap | None, found: ClassMap, belief: BeliefStore) -> dict[str, Any]:
    """``ground``: grid, hectares of each class, what changed and what is old. Empty where nobody says where it lies."""
    told = placed_findings(run, found) if posed is None else posed_findings(posed)
    if told is None:
        return {}
    place, drawn = run.zones.place, found.classes != UNLABELLED
    told |= {"older_ha": older_hectares(place, np.where(drawn, belief.age(), np.nan))}
    if (old_class := belief.old_class()) is not None:
        told |= {"changes_ha": changed_hectares(place, old_class, found)}
    return {"ground": told}


def posed_findings(drawn: GroundMap) -> dict[str, Any]:
    """Of a survey with a pose: the map that was drawn on the ground."""
    return {
        "crs": crs_name(drawn.geobox),
        "resolution_m": abs(float(drawn.geobox.resolution.x)),
        "shape": [int(size) for size in drawn.geobox.shape],
        "areas_ha": {name: area["ha"] for name, area in drawn.areas.items()},
    }


def placed_findings(run: SurveyRun, found: ClassMap) -> dict[str, Any] | None:
    """Of a survey whose scene's file says where it lies: the class map itself; None where it does not.

    Hectares are of the ellipsoid, not of the map's plane.
    """
    geobox = run.scene.geobox
    if geobox is None:
        return None
    areas = class_areas_m2(geobox, found.classes, len(found.names)) / M2_PER_HECTARE
    return {
        "crs": crs_name(geobox),
        "resolution_m": pixel_side_m(geobox),
        "shape": [int(size) for size in geobox.shape],
        "areas_ha": dict(zip(found.names, areas.tolist(), strict=True)),
    }


def older_hectares(place: FieldPlace, age_days: NDArray[np.float32]) -> dict[str, float]:
    """Hectares of (y, x) pixels that were looked at longer ago than each of `OLDER_DAYS`, by these; NaN is left out."""
    passed = np.searchsorted(OLDER_DAYS, age_days, side="left")  # how many of them an age is above
    areas = areas_by_number(place, np.where(np.isnan(age_days), -1, passed), len(OLDER_DAYS) + 1)
    assert areas is not None
    above = areas[::-1].cumsum()[::-1][1:] / M2_PER_HECTARE
    return {str(days): area for days, area in zip(OLDER_DAYS, above.tolist(), strict=True)}


def changed_hectares(place: FieldPlace, old_class: NDArray[np.uint8], found: ClassMap) -> list[list[Any]]:
    """Hectares, class before and class now of the (y, x) pixels that changed, largest first; 255 did not change."""
    count = len(found.names)
    changed = (old_class != UNLABELLED) & (found.classes != UNLABELLED)
    pairs = np.where(changed, old_class.astype(np.int64) * count + found.classes, -1)
    areas = areas_by_number(place, pairs, count**2)
    assert areas is not None
    largest = [pair for pair in np.argsort(-areas, kind="stable").tolist() if areas[pair] > 0]
    names = found.names
    return [[float(areas[pair]) / M2_PER_HECTARE, names[pair // count], names[pair % count]] for pair in largest]


def ground_words(ground: Mapping[str, Any]) -> str:
    """What the classes cover on the ground, what of it changed, and what was not looked at for long."""
    areas = [f"{_spaced(name)} {area_words(area)}" for name, area in ground["areas_ha"].items() if area]
    place = f"{ground['crs']}, {ground['resolution_m']:.4g} m a pixel"
    words = [f"On the ground ({place}) the classes cover {', '.join(areas)}."]
    if changes := ground.get("changes_ha"):
        told = [f"{_spaced(old)} to {_spaced(new)} {area_words(area)}" for area, old, new in changes[:MOST_CHANGES]]
        whole = area_words(sum(area for area, _, _ in changes))
        words.append(f"Of it {whole} changed since the look before: {', '.join(told)}.")
    older = {int(days): area for days, area in ground.get("older_ha", {}).items() if area}
    if older:
        ago = [f"{area_words(area)} more than {counted(days, 'day')} ago" for days, area in older.items()]
        words.append(f"Last looked at: {', '.join(ago)}.")
    return " ".join(words)


def _spaced(name: str) -> str:
    return name.replace("_", " ")
