"""Define the stage that scores patches and plans the second pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.capture_plan import CapturePlan
from flows.tasks.field_work import FieldWork, region_params
from flows.tasks.later_passes import LaterPasses
from flows.tasks.patch_budget import PatchBudget
from flows.tasks.stage import FieldFrame, Product, Report, Wanted, stage
from flows.tasks.zones import SurveyZones
from models.network.spectral import LineSpec
from models.policies.policies import SEEING_POLICIES, score_patches
from models.reading.inference import CoarsePrediction
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid, patch_pixels
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.planning.coverage import patches_shown
from pipeline.planning.fine_pass import FinePlan
from pipeline.planning.uniform_scans import ScanPerformance, format_scan
from storage.archive.keys import StageRef, array_digest
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import Attention, chosen_patches, open_mosaic, write_attention
from storage.readers.raster_fields import RasterPixels

READING = "attention.zarr"  # beside a class map whose drawing chose the patches
ATTENTION = Product("score", version=10, files=("attention.zarr", "plan.json"), by_weights=True)
Scores = NDArray[np.float64]


@stage("score", "attention and plan", ATTENTION)
def score(
    mosaic: StageRef,
    *,
    frame: FieldFrame,
    plan: CapturePlan,
    work: FieldWork,
    zones: SurveyZones,
    budget: PatchBudget | None,
    raster: RasterPixels | None,
    recorded: RecordedPasses | None,
    camera: LineCamera,
    cost: CostModel,
    policy: str,
    seed: int,
    mask: NDArray[np.generic] | None,
    part: bool,
    capture: LineSpec,
    scan_record: ScanPerformance | None,
    least_gain: float | None,
    model_key: dict[str, Any],
    report: Report,
) -> Wanted:
    """Score every patch by the coarse mosaic, and plan the sweeps with the highest total score in the time left."""
    grid, fractions = frame.grid, zones.fractions

    def expected_gain() -> Scores:
        """Return the (patch,) expected gain by the policy."""
        if policy in SEEING_POLICIES:
            scores = work.score(policy, mosaic.path / "mosaic.zarr", capture, lambda done: report(0.5 * done)).ravel()
        else:
            nothing = np.empty((0, 0, 0), np.float32)
            scores = score_patches(policy, CoarsePrediction(grid, nothing, nothing), seed=seed, mask=mask)
        return value(scores)

    def value(scores: Scores) -> Scores:
        """Return scores times the fraction of each patch that zones leave; 0 outside of the scene."""
        if frame.missing is not None:
            void = patch_pixels(grid, frame.missing).mean(axis=(1, 2)) >= grid.valid_fraction().ravel()
            scores = np.where(void, 0.0, scores)
        return scores if fractions is None else np.where(fractions > 0, scores, 0.0) * fractions

    def planned() -> tuple[Scores, FinePlan]:
        """Return the scores, and the plan of the second pass."""
        if not plan.plain:
            later = LaterPasses(grid, camera, cost, plan, recorded)
            if scan_record is None or policy != "gain" or not plan.by_record:
                scores = expected_gain()
                return scores, later.within(scores)
            errors = work.expected_errors(mosaic.path / "mosaic.zarr", capture, lambda done: report(0.5 * done))
            found = later.best(errors, scan_record, work.weights.load().class_names, value)
            return errors.expected_wrong_pixels(), found
        seen = all_seen(grid, () if raster is not None else plan.coarse, camera, part=part)
        if budget is None:
            return np.zeros(int(np.prod(grid.patch_shape))), seen
        scores = expected_gain()
        return scores, kept_within(budget, scores, seen)

    def build(path: Path) -> None:
        """Write score and rank of every patch, and the plan; raise an error if the map will not fit the memory."""
        scores, found = planned()
        if fractions is not None:
            found = replace(found, patch_index=found.patch_index[fractions[found.patch_index] > 0])
        read = found.patch_index
        if not plan.plain and (least_gain is not None or found.kind == "full" or not found.sweeps):
            read = grid.valid_patches()  # the segmentation chooses among them
            read = read if fractions is None else read[fractions[read] > 0]
        work.pool_for(
            read, len(open_mosaic(mosaic.path / "mosaic.zarr").components)
        )  # raises an error before the second pass
        rank = np.full(scores.shape, -1, np.int32)
        rank[read[np.argsort(-scores[read], kind="stable")]] = np.arange(len(read))
        shape = grid.patch_shape
        write_attention(path / "attention.zarr", Attention(scores.reshape(shape), rank.reshape(shape), policy))
        content = asdict(found) | {"patch_index": found.patch_index.tolist(), "read": read.tolist()}
        write_table(path / "plan.json", content)

    captures = {
        "fine_s": plan.fine_s,
        "overlap_px": plan.overlap_px,
        "margin_px": plan.margin_px,
        "along": plan.along,
        "camera": asdict(camera),
        "cost": asdict(cost),
    }
    params = {
        **model_key,
        "grid": asdict(grid),
        "policy": policy,
        "seed": seed if policy == "random" else None,
        "mask": None if mask is None else array_digest(mask),
        **(captures if raster is None else {}),
        **(region_params(grid) | {"capture": list(capture)} if policy in SEEING_POLICIES else {}),
        **({"plain": True} if plan.plain else {"by_record": plan.by_record, "least_gain": least_gain}),
        **({} if budget is None else {"macs": budget.macs}),
        **zones.key,
    }
    return Wanted(build, params, [mosaic])


def all_seen(grid: SceneGrid, sweeps: Sequence[Sweep], camera: LineCamera, *, part: bool) -> FinePlan:
    """Return the plan of a uniform scan, or of a raster without sweeps: the captured patches, and no second pass."""
    patch_index = grid.valid_patches()
    if not sweeps:
        return FinePlan([], patch_index, 0.0, 0.0, "raster", "the pixels of the raster are used as they are")
    scan = format_scan(sweeps[0].step, exposing(camera, sweeps[0]).exposure_ms)
    if part:
        patch_index = np.flatnonzero(patches_shown(list(sweeps), grid, camera))
    what = "a part of the field was" if part else "the field was"
    return FinePlan([], patch_index, 0.0, 0.0, "scan", f"{what} scanned once: {scan}")


def kept_within(budget: PatchBudget, scores: Scores, seen: FinePlan) -> FinePlan:
    """Return the plan of a uniform scan with the patches that the budget pays for."""
    chosen = budget.choose(scores)
    reason = f"{seen.reason}; the full network reads {len(chosen)} of {len(budget.patch_index)} patches"
    finite = np.where(np.isfinite(scores), scores, 0.0)
    expected_gain, wanted = float(finite[chosen].sum()), float(np.maximum(finite, 0.0).sum())
    return replace(seen, patch_index=np.sort(chosen), reason=reason, expected_gain=expected_gain, wanted_gain=wanted)


def load_plan(attention: StageRef) -> FinePlan:
    """Read the plan of the second pass: sweeps, and the patches that they cover."""
    plan = read_table(attention.path / "plan.json")
    plan.pop("read", None)
    sweeps = [Sweep(**sweep) for sweep in plan.pop("sweeps")]
    return FinePlan(sweeps, np.array(plan.pop("patch_index"), np.intp), **plan)


def read_in_full(attention: StageRef, class_map: StageRef) -> NDArray[np.intp]:
    """Return the patches (patch,) that the full network read, chosen before or during segmentation."""
    store = class_map.path / READING
    return chosen_patches(store if store.exists() else attention.path / "attention.zarr")
