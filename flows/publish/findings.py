"""Compute the findings of a run: warnings, areas, changes, zones, plots, scans, expected score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.plan import SurveyPlan
from spectralzoom.flows.planning.capture_plan import as_figures
from spectralzoom.flows.products import Products
from spectralzoom.flows.publish.class_sentence import main_places
from spectralzoom.flows.publish.scores import MOST_ERROR, warning_column
from spectralzoom.flows.stages.condense import SIGNAL_RECORD
from spectralzoom.flows.stages.ground import STORE
from spectralzoom.flows.stages.register import load_registration
from spectralzoom.flows.stages.score import load_plan, read_in_full
from spectralzoom.flows.stages.segment import PRIOR_FIGURES, SPECTRA
from spectralzoom.flows.terminal.figures import format_count, format_points
from spectralzoom.models.evaluation.expected_scores import ENOUGH_PX, expected_counts
from spectralzoom.models.evaluation.unlike_scenes import UNLIKE
from spectralzoom.pipeline.capture.recorded_passes import lines_served
from spectralzoom.pipeline.geometry.grid import UNLABELLED, cuts, patch_pixels
from spectralzoom.pipeline.ground.field_places import M2_PER_HECTARE, FieldPlace, areas_by_number
from spectralzoom.pipeline.ground.georeference import crs_name, pixel_side_m
from spectralzoom.pipeline.ground.zones import figures_of_plot
from spectralzoom.pipeline.planning.fine_pass import FinePlan
from spectralzoom.storage.arrays.class_maps import ClassMap, ProbabilityStore, class_counts, load_class_map
from spectralzoom.storage.arrays.ground_maps import GroundMap, load_ground_map, open_image
from spectralzoom.storage.arrays.layout import SHARD_ROWS
from spectralzoom.storage.arrays.mosaics import open_mosaic
from spectralzoom.storage.export.csv_tables import csv_table
from spectralzoom.storage.store import Ref, read_table

PLOTS_FILE = "plots.csv"
STRIP_PX = 2**20  # of class probabilities read at a time: 1 to 4 shards high
MANY = 100  # times as far as usual, from which on the factor says no more


def find_out(plan: SurveyPlan, products: Products) -> dict[str, Any]:
    """Return the findings of a run by their names in the receipt; those that do not apply are empty."""
    field, fine = plan.field, load_plan(products.attention)
    drawn = load_class_map(products.class_map.path / "class_map.zarr")
    posed = None if products.ground is None else load_ground_map(products.ground.path / STORE)
    prior, kept = None, None
    if field.prior is not None:
        prior = {"run": field.prior.run, **read_table(products.class_map.path / PRIOR_FIGURES)}
    if plan.reading.chooses and (plan.passes.plain or plan.reading.least_gain is not None):
        kept = plan.reading.figures(read_in_full(products.attention, products.class_map), fine.changed)
    warnings = map_warnings(plan, products.class_map)
    unscored = no_expected_score(warnings, int(np.count_nonzero(drawn.classes != UNLABELLED)))
    return {
        "warnings": warnings,
        "field": field_figures(plan, fine),
        "plan": _plan(plan, fine),
        "recording": _recording(plan, fine),
        "kept": kept,
        "prior_map": prior,
        "scans": _scans(plan, fine, scored=not unscored),
        "extent": _extent(plan, fine, scored=not unscored) if plan.part else None,
        "pointing": _pointing(plan, products, fine),
        "areas": _areas(plan, products, posed, drawn),
        "ground": _ground(plan, products, posed, drawn, {} if prior is None else prior),
        **_zones(plan, drawn),
        **_map(plan, products.class_map, drawn),
        "expected": {"not_predicted": unscored} if warnings else _expected(plan, products.class_map, unscored),
        **({} if field.raster is not None else _lines(products.mosaic)),
    }


def map_warnings(plan: SurveyPlan, class_map: Ref | None) -> list[str]:
    """Return the warnings about a map, also those by its spectra where it is drawn in the store ``class_map``."""
    warnings = list(plan.field.warnings)
    mean, spectra = (class_map and read_table(class_map.path / SPECTRA)["distances"]) or (0.0, 0.0)
    if max(mean, spectra) > UNLIKE:
        times = f"{max(mean, spectra):.1f}" if max(mean, spectra) < MANY else f"more than {MANY}"
        what = "its mean spectrum lies" if mean >= spectra else "its spectra lie"
        far = f"{what} {times} times as far from it as any part of it from the rest"
        warnings.append(f"the scene is unlike the training ({far}): the map may be wrong with confidence")
    return warnings


def no_expected_score(warnings: Sequence[str], pixels: int) -> str:
    """Return why a map with so many ``pixels`` of a class has no expected score; empty where it may have one."""
    if warnings:
        return "no expected score: under a warning, neither the map's probabilities nor the weights' record predict it"
    if pixels < ENOUGH_PX:
        return f"no expected score: {format_count(pixels)} px have a class, fewer than {format_count(ENOUGH_PX)}"
    return ""


def _scans(plan: SurveyPlan, fine: FinePlan, *, scored: bool) -> dict[str, Any]:
    """Return the uniform scans by the scan performance table, where there is one."""
    scans = {
        "taken": plan.scans.chosen,
        "best_in_time": plan.scans.best_in_time(plan.passes.coarse_s + fine.seconds),
        "reference": plan.scans.reference,
    }
    return {name: as_figures(scan, scored=scored) for name, scan in scans.items() if scan is not None}


def field_figures(plan: SurveyPlan, fine: FinePlan | None) -> dict[str, Any]:
    """Return figures of the field and of the captures, for JSON; None for unknown ones.

    Without a planned fine pass, ``fine``, its seconds are those that the budget leaves. Hectares are those within the
    zones, and hectares per hour refer to all capture time. A raster has neither capture time nor lines.
    """
    zones, passes = plan.field.zones, plan.passes
    scale = kept = plan.field.place.scale(plan.field.camera.ifov_rad)
    if zones.kept is not None and scale.area_m2 is not None:
        kept = replace(scale, area_m2=_ground_m2(plan, zones.kept))  # the area within the zones
    footprint = scale.footprint
    captured = plan.field.raster is None
    fine_s = passes.fine_s if fine is None else fine.seconds
    seconds = passes.coarse_s + fine_s
    camera_s = {"coarse": passes.coarse_s, "fine": fine_s, "all": seconds, "full_scan": passes.full_s}
    coarse, full = (sum(sweep.lines for sweep in sweeps) for sweeps in (passes.coarse, passes.full))
    lines = {"coarse": coarse, "fine": None if fine is None else fine.lines, "full_scan": full}
    ranges = None if footprint is None else zip(("nearest", "median", "farthest"), footprint.range_m, strict=True)
    return {
        "size_px": [scale.shape[1], scale.shape[0]],
        "view_deg": [scale.view_deg[1], scale.view_deg[0]] if captured or footprint is not None else None,
        "ground_pixel_m": scale.pixel_m,
        "range_m": None if ranges is None else dict(ranges),
        "footprint_m": None if footprint is None else {"width": footprint.width_m, "depth": footprint.depth_m},
        "hectares": kept.hectares,
        "kept_fraction": None if zones.kept is None else float(zones.kept.mean()),
        "camera_s": camera_s if captured else None,
        "fine_planned": fine is not None or passes.plain,
        "lines": lines if captured else None,
        "hectares_per_hour": kept.hectares_per_hour(seconds) if captured and not plan.part else None,
    }


def _plan(plan: SurveyPlan, fine: FinePlan) -> dict[str, Any]:
    """Return kind, reason and costs of the second pass, and in words where it captured a part of the field again."""
    facts = {"kind": fine.kind, "reason": fine.reason, "lines": fine.lines, "seconds": fine.seconds}
    if fine.kind != "lines" or not fine.sweeps:
        return facts
    again = np.full(plan.field.grid.patch_shape, UNLABELLED, np.uint8)
    again.ravel()[plan.field.kept_patches] = 1
    again.ravel()[fine.patch_index] = 0
    geobox = plan.field.scene.geobox  # patches lie as pixels do
    return {**facts, "place": main_places(again, ("again", "once"), geobox).get("again", "")}


def _recording(plan: SurveyPlan, fine: FinePlan) -> dict[str, Any] | None:
    """Return the lines read and recorded, and the seconds of a camera; None without a recording."""
    if (recorded := plan.field.recorded) is None:
        return None
    return {
        "sweeps": str(plan.settings.sweeps),
        "lines_read": lines_served(recorded, [*plan.passes.coarse, *fine.sweeps]),
        "lines_recorded": sum(int(one.valid_line.sum()) for one in recorded.sweeps),
        "passes_s": plan.passes.coarse_s + fine.seconds,
        "full_scan_s": plan.settings.cost.seconds(plan.passes.full, plan.field.camera),
    }


def _extent(plan: SurveyPlan, fine: FinePlan, *, scored: bool) -> dict[str, Any]:
    return {
        "lines": plan.settings.extent,
        "patches_touched": len(fine.patch_index) / max(len(plan.field.kept_patches), 1),
        "uses_prior_map": plan.field.prior is not None,
        **({} if plan.extent is None else asdict(plan.extent)),
        **({} if scored else {"expected_wrong": None}),
    }


def _pointing(plan: SurveyPlan, products: Products, fine: FinePlan) -> dict[str, Any] | None:
    """Return the pointing corrections of each pass; None where none was registered."""
    passes = {"coarse": products.first, "fine": products.second}
    found = {name: _corrections(one.seams) for name, one in passes.items() if one is not None and one.seams is not None}
    if "fine" in found:
        found["fine"]["partly_seen"] = _partly_seen(plan, products.mosaic, fine)
    return {"prior_px": plan.settings.pointing_px, **found} if found else None


def _partly_seen(plan: SurveyPlan, mosaic: Ref, fine: FinePlan) -> int:
    """Count the chosen patches that the fine pass did not capture completely."""
    kinds = open_mosaic(mosaic.path / "mosaic.zarr").captures()
    if kinds is None:
        return 0
    coarse = np.array([step >= plan.passes.coarse[0].step for _, step, _ in kinds[0]])[kinds[1]]
    return int(np.count_nonzero(patch_pixels(plan.field.grid, coarse)[fine.patch_index].any(axis=(1, 2))))


def _corrections(ref: Ref) -> dict[str, Any]:
    """Return the pointing corrections of a pass; residuals only where there are more windows than unknowns."""
    record = load_registration(ref)
    left = np.array([window["residual_px"] for window in record["windows"] if window.get("residual_px")])
    tells = len(left) > 2 * (len(record["sweeps"]) - len(record["untied"]) - 1)
    return {
        "held": record["reference"],
        "sweeps": {name: one["offset_px"] for name, one in record["sweeps"].items()},
        "residual_rms_px": float(np.sqrt(np.mean(left**2))) if left.size and tells else None,
        "not_found": record["untied"],
        "too_narrow": record["narrow"],
    }


def _areas(plan: SurveyPlan, products: Products, posed: GroundMap | None, drawn: ClassMap) -> dict[str, Any]:
    """Return pixels of each class, its place, and hectares where a pixel's size is known.

    With a pose, places and hectares are those of the map on the ground.
    """
    pixels = class_counts(drawn.classes, len(drawn.names)).tolist()
    m2 = None if posed is not None else areas_by_number(plan.field.place, drawn.classes, len(drawn.names))
    hectares = {} if m2 is None else dict(zip(drawn.names, (m2 / M2_PER_HECTARE).tolist(), strict=True))
    geobox, classes = plan.field.scene.geobox, drawn.classes
    if posed is not None and products.ground is not None:
        geobox = posed.geobox
        hectares = {name: area["ha"] for name, area in posed.areas.items()}
        stored = open_image(products.ground.path / STORE, "classes")
        classes = drawn.legend.index(np.concatenate([rows for _, rows in stored.rows()]))
    found = {"px": dict(zip(drawn.names, pixels, strict=True)), "ha": hectares}
    found["place"] = main_places(classes, drawn.names, geobox)
    return {name: figures for name, figures in found.items() if figures}


def _ground(
    plan: SurveyPlan, products: Products, posed: GroundMap | None, drawn: ClassMap, prior: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Return the grid, and changes against the prior map; None without a georeference."""
    geobox = plan.field.scene.geobox if posed is None else posed.geobox
    if geobox is None:
        return None
    figures: dict[str, Any] = {
        "crs": crs_name(geobox),
        "resolution_m": pixel_side_m(geobox) if posed is None else abs(float(geobox.resolution.x)),
        "shape": [int(size) for size in geobox.shape],
    }
    old_class = ProbabilityStore(products.class_map.path / "class_probabilities.zarr").old_class()
    if old_class is not None:
        beyond = {(old, new): changed / differing for changed, differing, old, new in prior.get("changes", ())}
        figures["changes_ha"] = changed_hectares(plan.field.place, old_class, drawn, beyond)
    return figures


def changed_hectares(
    place: FieldPlace, old_class: NDArray[np.uint8], found: ClassMap, beyond: Mapping[tuple[str, str], float]
) -> list[list[Any]]:
    """Return hectares, class before and class now of the (y, x) pixels that changed, largest first.

    ``old_class`` is 255 where prior map and map agree. ``beyond`` is the fraction of differing pixels in excess of the
    differences between two maps of the same ground, by class before and now. Pairs without it did not change.
    """
    names = found.names
    count = len(names)
    differing = (old_class != UNLABELLED) & (found.classes != UNLABELLED)
    pairs = np.where(differing, old_class.astype(np.int64) * count + found.classes, -1)
    areas = areas_by_number(place, pairs, count**2)
    assert areas is not None
    areas *= [beyond.get((old, new), 0.0) for old in names for new in names]
    largest = [pair for pair in np.argsort(-areas, kind="stable").tolist() if areas[pair] > 0]
    return [[float(areas[pair]) / M2_PER_HECTARE, names[pair // count], names[pair % count]] for pair in largest]


def _zones(plan: SurveyPlan, drawn: ClassMap) -> dict[str, Any]:
    """Return ``zones``, the size of the mapped part, and ``plots``, a row each."""
    found: dict[str, Any] = {}
    zones = plan.field.zones
    if (kept := zones.kept) is not None:
        pixels = int(np.count_nonzero(kept))
        found["zones"] = {"kept_px": pixels, "field_px": kept.size, "kept_m2": _ground_m2(plan, kept)}
    if zones.plots is not None:
        found["plots"] = [
            asdict(figures_of_plot(name, shape, plan.field.place, drawn.classes, drawn.confidence, drawn.names))
            for name, shape in zones.plots.items()
        ]
    return found


def _ground_m2(plan: SurveyPlan, kept: NDArray[np.bool_]) -> float | None:
    rows, columns = (slice(0, size) for size in kept.shape)
    areas = plan.field.place.pixel_areas_m2(rows, columns)
    return None if areas is None else float(np.nansum(areas[kept]))


def plots_csv(plots: Sequence[Mapping[str, Any]], warnings: Sequence[str] = ()) -> str:
    """Return figures of all plots and warnings about their map as CSV, a row for each; unknown cells are empty."""
    names = list(plots[0]["fractions"]) if plots else []
    facts = ("plot", "pixels", "mapped_pixels", "area_m2", "confidence")
    columns = {fact: [plot[fact] for plot in plots] for fact in facts}
    fractions = {f"fraction_{name}": [plot["fractions"][name] for plot in plots] for name in names}
    return csv_table(columns | fractions | warning_column(warnings, len(plots)))


def _map(plan: SurveyPlan, ref: Ref, drawn: ClassMap) -> dict[str, Any]:
    """Return ``unlike`` and ``pixels`` of the map in the store ``ref``."""
    spectra = read_table(ref.path / SPECTRA)
    mean, distance = spectra["distances"] or (0.0, 0.0)
    unclassed = drawn.classes == UNLABELLED
    if plan.field.zones.left_out is not None:
        unclassed &= ~plan.field.zones.left_out
    pixels = {
        "scene_without_a_value": plan.field.scene.filled_px,
        "px_no_reading": spectra["out_of_range_px"],
        "map_without_a_class": int(np.count_nonzero(unclassed)),
    }
    return {
        "unlike": {"mean": mean, "spectra": distance} if max(mean, distance) > UNLIKE else None,
        "pixels": pixels if any(pixels.values()) else None,
    }


def _expected(plan: SurveyPlan, ref: Ref, unscored: str) -> dict[str, Any] | None:
    """Return the expected score by the map's own probabilities; None where these were never compared with labels.

    They were compared for maps of uniform scans segmented in full without a prior map. Pixels without a class do not
    count. A score with too large an error is not predicted, nor one that is ``unscored`` for a reason.
    """
    scores = plan.field.described.map_scores
    if (
        scores is None
        or plan.field.raster is not None
        or not plan.passes.plain
        or plan.part
        or plan.settings.macs is not None
        or plan.field.prior is not None
    ):
        return None
    if unscored:
        return {"not_predicted": unscored}
    names = plan.field.described.class_names
    store = ProbabilityStore(ref.path / "class_probabilities.zarr")
    high = SHARD_ROWS * int(np.clip(STRIP_PX // (SHARD_ROWS * store.shape[1]), 1, 4))
    strips = (store.read(rows)[0] for rows in cuts(store.shape[0], high))
    exposure_ms = (plan.settings.scan_exposure_ms or plan.field.camera.exposure_ms) * plan.field.scene.light_fraction
    score = scores.expected(expected_counts(strips, len(names)), plan.step, exposure_ms)
    if score is None or not np.isfinite(score.miou):
        return None
    if not score.error <= MOST_ERROR:  # or NaN
        text = f"no expected score: it would be off by {format_points(score.error)} points (one standard deviation)"
        return {"not_predicted": f"{text}; judge the map by labels"}
    of_classes = {name: float(iou) for name, iou in zip(names, score.per_class_iou, strict=True) if np.isfinite(iou)}
    return {"miou": score.miou, "error": score.error, "per_class_iou": of_classes}


def _lines(mosaic: Ref) -> dict[str, Any]:
    """Return ``signal``, the fraction of spectra with saturated bands, and ``lines``, the sweeps that lost some."""
    saturated = read_table(mosaic.path / SIGNAL_RECORD)["saturated"]
    sweeps = read_table(mosaic.path / "lines.json")
    return {
        "signal": {"saturated": saturated} if saturated else None,
        "lines": {name: facts for name, facts in sweeps.items() if any(facts.values())},
    }
