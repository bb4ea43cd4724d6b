"""What a survey found out on the way: how it was planned, where the mirror looked, lines that were lost, hectares."""

from __future__ import annotations

from typing import Any

import numpy as np

from flows.survey.run import SurveyRun
from flows.survey.stages.attention import load_orientation, load_plan
from flows.survey.stages.class_map import strange_pixels
from flows.survey.stages.ground import STORE
from flows.survey.stages.placement import line_facts, seen_shares
from flows.survey.stages.registration import load_registration
from flows.survey.survey import Products
from pipeline.geometry.grid import UNLABELLED
from pipeline.planning.fine_pass import FinePlan
from storage.archive.keys import StageRef
from storage.arrays.class_maps import load_class_map
from storage.arrays.ground_maps import load_ground_map


def find_out(run: SurveyRun, products: Products) -> dict[str, Any]:
    """Gather ``plan`` and the parts of the receipt that not every survey has.

    These are ``pointing``, ``ground``, ``pixels`` and ``lines``.
    """
    found: dict[str, Any] = {"plan": _plan(run, products)}
    passes = {"coarse": products.get("register_coarse"), "fine": products.get("register_fine")}
    pointing = {name: _pointing(ref) for name, ref in passes.items() if ref is not None}
    if "fine" in pointing:
        pointing["fine"]["partly_seen"] = int(np.count_nonzero(seen_shares(run, products.of("cut_patches")) < 1))
    if pointing:
        found["pointing"] = {"prior_px": run.settings.pointing_px, **pointing}
    for ground_map in products.there(["ground"]):
        found["ground"] = _ground(ground_map)
    pixels = _pixels(run, products.of("draw_map"))
    if any(pixels.values()):
        found["pixels"] = pixels
    troubled = {name: facts for name, facts in line_facts(products.of("rectify")).items() if any(facts.values())}
    if troubled:
        found["lines"] = troubled
    return found


def _pixels(run: SurveyRun, class_map: StageRef) -> dict[str, int]:
    """Pixels of which not all was known: of the scene, of what was captured, and of the map."""
    classes = load_class_map(class_map.path / "class_map.zarr").classes
    return {
        "scene_without_a_value": run.scene.filled_px,
        "coarse_px_no_reading": 0,
        "fine_px_no_reading": 0,
        **{f"{name}_no_reading": count for name, count in strange_pixels(class_map).items()},
        "map_without_a_class": int(np.count_nonzero(classes == UNLABELLED)),
    }


def _plan(run: SurveyRun, products: Products) -> dict[str, Any]:
    """How the fine pass was laid out, and what the other orientation would have shown."""
    plan = load_plan(products.of("attend"))
    return {
        "kind": plan.kind,
        "reason": plan.reason,
        "lines": plan.lines,
        "seconds": plan.seconds,
        "score_share": plan.worth / plan.wanted_worth if plan.wanted_worth else None,
        "score_per_second": plan.worth_per_second,
        "full_seconds": plan.full_seconds,
        "out_of_reach": plan.out_of_reach,
        "orientation": load_orientation(products.of("compare_turned")),
        **_spared(run, plan),
    }


def _spared(run: SurveyRun, plan: FinePlan) -> dict[str, Any]:
    """What the threshold left: seconds, their share of the full scan's, and the score that was not worth more of them.

    Nothing without a threshold.
    """
    if plan.threshold is None:
        return {}
    return {
        "threshold": plan.threshold,
        "spared_s": plan.spared_s,
        "spared_share": None if plan.spared_s is None else plan.spared_s / run.plan.full_s,
        "spared_score": plan.wanted_worth - plan.worth,
    }


def _pointing(ref: StageRef) -> dict[str, Any]:
    """Corrections of one pass, and what its windows say of them.

    Each sweep beside the held one has an offset and a drift: where windows are no more than these, they leave nothing.
    """
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


def _ground(ref: StageRef) -> dict[str, Any]:
    """The map's grid and what each class covers on the ground."""
    found = load_ground_map(ref.path / STORE)
    box = found.geobox
    return {
        "crs": str(box.crs),
        "resolution_m": abs(float(box.resolution.x)),
        "shape": [int(size) for size in box.shape],
        "areas_ha": {name: area["ha"] for name, area in found.areas.items()},
    }
