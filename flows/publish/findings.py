"""What a plan and a run say of the field on the ground: size, pace of the camera, hectares of classes, zones, plots."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flows.survey.run import SurveyRun
from flows.terminal.figures import (
    area_words,
    counted,
    format_count,
    format_metres,
    format_percent,
    format_seconds,
    three_digits,
)
from pipeline.geometry.grid import UNLABELLED
from pipeline.ground.field_places import M2_PER_HECTARE, FieldPlace, FieldScale, areas_by_number
from pipeline.ground.georeference import class_areas_m2, crs_name, pixel_side_m
from pipeline.ground.zones import figures_of_plots
from pipeline.planning.fine_pass import FinePlan
from storage.arrays.class_maps import BeliefStore, ClassMap
from storage.arrays.ground_maps import GroundMap

if TYPE_CHECKING:
    from flows.survey.run import SurveyRun

NO_METRES = "nothing says how large a pixel is: a [pose], or a georeferenced scene, gives metres and hectares an hour"
EVERY_LINE = "every line at full exposure"
OLDER_DAYS = (1, 7, 30)  # since a look, of which the hectares are told
MOST_CHANGES = 4  # told in words
PLOTS_FILE = "plots.csv"
LEADING = 3  # classes of a plot that are told in words


def field_figures(run: SurveyRun, fine: FinePlan | None) -> dict[str, Any]:
    """Figures of the field and of the captures as JSON tells them; None for what nobody knows.

    ``fine`` is the fine pass where it is planned already, else it takes what the budget leaves at most. Hectares are
    those that the survey keeps to, and those an hour are of all of the camera's seconds.
    """
    scale, fine_s = run.zones.place.scale(run.camera.ifov_rad), run.plan.fine_s if fine is None else fine.seconds
    seconds = run.plan.coarse_s + fine_s
    kept = _kept(run, scale)
    footprint = scale.footprint
    return {
        "size_px": [scale.shape[1], scale.shape[0]],
        "view_deg": [scale.view_deg[1], scale.view_deg[0]],
        "ground_pixel_m": scale.pixel_m,
        "range_m": None
        if footprint is None
        else dict(zip(("nearest", "median", "farthest"), footprint.range_m, strict=True)),
        "footprint_m": None if footprint is None else {"width": footprint.width_m, "depth": footprint.depth_m},
        "footprint_east_north_m": None if footprint is None else footprint.outline_m.tolist(),
        "hectares": kept.hectares,
        "kept_share": None if run.zones.kept is None else float(run.zones.kept.kept.mean()),
        "camera_s": {"coarse": run.plan.coarse_s, "fine": fine_s, "all": seconds, "full_scan": run.plan.full_s},
        "fine_planned": fine is not None or run.plan.plain,
        "lines": {
            "coarse": sum(sweep.lines for sweep in run.plan.coarse),
            "fine": None if fine is None else fine.lines,
            "full_scan": sum(sweep.lines for sweep in run.plan.full),
        },
        "hectares_per_hour": kept.hectares_per_hour(seconds),
        "full_scan_hectares_per_hour": kept.hectares_per_hour(run.plan.full_s),
    }


def _kept(run: SurveyRun, scale: FieldScale) -> FieldScale:
    """The scale of what zones leave of the field."""
    if run.zones.kept is None or scale.area_m2 is None:
        return scale
    rows, columns = (slice(0, size) for size in scale.shape)
    areas = run.zones.place.pixel_areas_m2(rows, columns)
    assert areas is not None
    return FieldScale(scale.shape, scale.view_deg, scale.pixel_m, float(np.nansum(areas[run.zones.kept.kept])))


def figure_lines(figures: Mapping[str, Any]) -> list[str]:
    """The figures in words, a line each."""
    (width, height), (across, down), camera = figures["size_px"], figures["view_deg"], figures["camera_s"]
    lines = [f"field: {width} x {height} px, {across:.3g} x {down:.3g} degrees{_ground_words(figures)}"]
    if figures["kept_share"] is not None:
        lines.append(f"zones: {format_percent(figures['kept_share'])} of the field is kept to")
    if figures["ground_pixel_m"] is None:
        lines.append(NO_METRES)
    else:
        lines.append(f"ground: {format_metres(figures['ground_pixel_m'])} a pixel{_range_words(figures)}")
    known = "" if figures["fine_planned"] else " at most, chosen once the coarse pass was looked at"
    parts = f"coarse {format_seconds(camera['coarse'])}, fine {format_seconds(camera['fine'])}{known}"
    lines.append(
        f"camera: {format_seconds(camera['all'])} ({parts}); {EVERY_LINE} {format_seconds(camera['full_scan'])}"
    )
    count = figures["lines"]
    fine = "" if count["fine"] is None else f", fine {format_count(count['fine'])}"
    lines.append(
        f"lines: coarse {format_count(count['coarse'])}{fine}; {EVERY_LINE} {format_count(count['full_scan'])}"
    )
    if figures["hectares_per_hour"] is not None:
        lines.append(
            f"pace: {three_digits(figures['hectares_per_hour'])} ha an hour of the camera; {EVERY_LINE} "
            f"{three_digits(figures['full_scan_hectares_per_hour'])}"
        )
    return lines


def _ground_words(figures: Mapping[str, Any]) -> str:
    if figures["hectares"] is None:
        return ""
    footprint = figures["footprint_m"]
    size = (
        ""
        if footprint is None
        else f", {format_metres(footprint['width'])} wide and {format_metres(footprint['depth'])} deep"
    )
    ground = area_words(figures["hectares"])
    return f"{size}; {ground}{' kept to' if figures['kept_share'] is not None else ''}"


def _range_words(figures: Mapping[str, Any]) -> str:
    if figures["range_m"] is None:
        return ""
    nearest, median, farthest = (format_metres(figures["range_m"][name]) for name in ("nearest", "median", "farthest"))
    return f" in the middle, seen from {median} away ({nearest} to {farthest})"


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


def find_zones(run: SurveyRun, drawn: ClassMap) -> dict[str, Any]:
    """``zones``: how much of the field is kept to; ``plots``: a row each. Empty for a survey without either."""
    zones, found = run.zones, dict[str, Any]()
    if zones.kept is not None:
        kept = zones.kept.kept
        found["zones"] = {
            "kept_px": int(np.count_nonzero(kept)),
            "field_px": kept.size,
            "no_go_px": 0 if zones.kept.no_go is None else int(np.count_nonzero(zones.kept.no_go)),
            "kept_m2": _ground_m2(run, kept),
        }
    if zones.plots is not None:
        rows = figures_of_plots(zones.plots, zones.place, drawn.classes, drawn.confidence, drawn.names)
        found["plots"] = [asdict(row) for row in rows]
    return found


def _ground_m2(run: SurveyRun, kept: NDArray[np.bool_]) -> float | None:
    rows, columns = (slice(0, size) for size in kept.shape)
    areas = run.zones.place.pixel_areas_m2(rows, columns)
    return None if areas is None else float(np.nansum(areas[kept]))


def zone_words(zones: Mapping[str, Any]) -> str:
    """How much of the field a survey kept to."""
    ground = "" if zones["kept_m2"] is None else f", {area_words(zones['kept_m2'] / M2_PER_HECTARE)}"
    share = format_percent(zones["kept_px"] / zones["field_px"])
    no_go = f"; no-go zones touch {format_count(zones['no_go_px'])} px" if zones["no_go_px"] else ""
    return (
        f"The survey keeps to {format_count(zones['kept_px'])} px, {share} of the field{ground}{no_go}. Of the rest "
        "no detail was asked for and no map is drawn."
    )


def plot_rows(plots: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """The table of plots in words: name, ground, leading classes, confidence."""
    return [
        {
            "plot": plot["plot"],
            "area": f"{format_count(plot['pixels'])} px"
            if plot["area_m2"] is None
            else area_words(plot["area_m2"] / M2_PER_HECTARE),
            "classes": _leading(plot["shares"]) if plot["mapped_pixels"] else "not mapped",
            "confidence": format_percent(plot["confidence"]),
        }
        for plot in plots
    ]


def _leading(shares: Mapping[str, float | None]) -> str:
    """The classes that cover most of a plot."""
    known = [(share, name) for name, share in shares.items() if share]
    most = sorted(known, key=lambda one: -one[0])[:LEADING]
    return ", ".join(f"{name.replace('_', ' ')} {format_percent(share)}" for share, name in most)


def plots_csv(plots: Sequence[Mapping[str, Any]]) -> str:
    """Every figure of every plot, a row each; empty where nothing is known."""
    names = list(plots[0]["shares"]) if plots else []
    head = ["plot", "pixels", "mapped_pixels", "area_m2", "confidence"]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*head, *(f"share_{name}" for name in names)])
    for plot in plots:
        cells = [*(plot[name] for name in head), *(plot["shares"][name] for name in names)]
        table.writerow(["" if cell is None else cell for cell in cells])
    return text.getvalue()
