"""What a plan says of the field itself: its size, field of view, ground pixel, range, and the camera's seconds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flows.tasks.run import SurveyRun
from flows.terminal.figures import area_words, format_count, format_metres, format_percent, format_seconds, three_digits
from pipeline.ground.field_places import FieldScale
from pipeline.planning.fine_pass import FinePlan

NO_METRES = "nothing says how large a pixel is: a [pose], or a georeferenced scene, gives metres and hectares an hour"
EVERY_LINE = "every line at full exposure"


def field_figures(run: SurveyRun, fine: FinePlan | None) -> dict[str, Any]:
    """Figures of the field and of the captures as JSON tells them; None for what nobody knows.

    ``fine`` is the fine pass where it is planned already, else it takes what the budget leaves at most. Hectares are
    those that the survey keeps to, and those an hour are of all of the camera's seconds. A raster has no camera: no
    view but by a pose, no seconds, no lines.
    """
    scale, fine_s = run.zones.place.scale(run.camera.ifov_rad), run.plan.fine_s if fine is None else fine.seconds
    seconds = run.plan.coarse_s + fine_s
    kept = _kept(run, scale)
    footprint, captured = scale.footprint, run.raster is None
    camera_s = {"coarse": run.plan.coarse_s, "fine": fine_s, "all": seconds, "full_scan": run.plan.full_s}
    lines = {
        "coarse": sum(sweep.lines for sweep in run.plan.coarse),
        "fine": None if fine is None else fine.lines,
        "full_scan": sum(sweep.lines for sweep in run.plan.full),
    }
    return {
        "size_px": [scale.shape[1], scale.shape[0]],
        "view_deg": [scale.view_deg[1], scale.view_deg[0]] if captured or footprint is not None else None,
        "ground_pixel_m": scale.pixel_m,
        "range_m": None
        if footprint is None
        else dict(zip(("nearest", "median", "farthest"), footprint.range_m, strict=True)),
        "footprint_m": None if footprint is None else {"width": footprint.width_m, "depth": footprint.depth_m},
        "footprint_east_north_m": None if footprint is None else footprint.outline_m.tolist(),
        "hectares": kept.hectares,
        "kept_share": None if run.zones.kept is None else float(run.zones.kept.kept.mean()),
        "camera_s": camera_s if captured else None,
        "fine_planned": fine is not None or run.plan.plain,
        "lines": lines if captured else None,
        "hectares_per_hour": kept.hectares_per_hour(seconds) if captured else None,
        "full_scan_hectares_per_hour": kept.hectares_per_hour(run.plan.full_s) if captured else None,
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
    (width, height), view, camera = figures["size_px"], figures["view_deg"], figures["camera_s"]
    degrees = "" if view is None else f", {view[0]:.3g} x {view[1]:.3g} degrees"
    lines = [f"field: {width} x {height} px{degrees}{_ground_words(figures)}"]
    if figures["kept_share"] is not None:
        lines.append(f"zones: {format_percent(figures['kept_share'])} of the field is kept to")
    if figures["ground_pixel_m"] is None:
        lines.append(NO_METRES)
    else:
        lines.append(f"ground: {format_metres(figures['ground_pixel_m'])} a pixel{_range_words(figures)}")
    if camera is None:
        return [*lines, "camera: none; the pixels of the raster are taken as they are"]
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
