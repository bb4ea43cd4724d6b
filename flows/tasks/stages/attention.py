"""The stage of attention: a score for every patch, and the sweeps that show most of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import SPARING
from flows.tasks.capture_plan import CapturePlan
from flows.tasks.field_work import FieldWork, region_params
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
from pipeline.planning.coverage import field_px, patches_shown
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.uniform_scans import format_scan
from storage.archive.keys import StageRef, array_digest
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import Attention, chosen_patches, open_mosaic, write_attention
from storage.readers.raster_fields import RasterPixels

READING = "attention.zarr"  # beside a map, where patches were chosen while it was drawn
ATTENTION = Product("score", version=9, files=("attention.zarr", "plan.json"), by_weights=True)
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
    model_key: dict[str, Any],
    report: Report,
) -> Wanted:
    """Score every patch by the coarse mosaic, and plan the sweeps that show the most score in the time left."""
    grid, fractions = frame.grid, zones.fractions

    def expected_gain() -> Scores:
        """Return the (patch,) worth of a fine look at each patch, by the fraction of it that zones leave."""
        if policy in SEEING_POLICIES:
            scores = work.score(policy, mosaic.path / "mosaic.zarr", capture, lambda done: report(0.5 * done)).ravel()
        else:
            nothing = np.empty((0, 0, 0), np.float32)
            scores = score_patches(policy, CoarsePrediction(grid, nothing, nothing), seed=seed, mask=mask)
        if frame.missing is not None:  # a patch without any pixel of the scene is worth no look
            void = patch_pixels(grid, frame.missing).mean(axis=(1, 2)) >= grid.valid_fraction().ravel()
            scores = np.where(void, 0.0, scores)
        return scores if fractions is None else np.where(fractions > 0, scores, 0.0) * fractions

    def planned() -> tuple[Scores, FinePlan]:
        """Return the scores where patches are chosen, and what is seen of the field in detail."""
        if not plan.plain:
            scores = expected_gain()
            return scores, plan_detail(grid, plan, camera, cost, scores, recorded)
        seen = all_seen(grid, () if raster is not None else plan.coarse, camera, part=part)
        if budget is None:
            return np.zeros(int(np.prod(grid.patch_shape))), seen
        scores = expected_gain()
        return scores, kept_within(budget, scores, seen)

    def build(path: Path) -> None:
        """Write every patch's score and rank, and the plan of sweeps; refuse a map that does not fit."""
        scores, found = planned()
        if fractions is not None:  # patches of which zones leave something
            found = replace(found, patch_index=found.patch_index[fractions[found.patch_index] > 0])
        work.pool_for(
            found.patch_index, len(open_mosaic(mosaic.path / "mosaic.zarr").components)
        )  # refuses what does not fit before the rig goes back
        rank = np.full(scores.shape, -1, np.int32)
        rank[found.patch_index[np.argsort(-scores[found.patch_index], kind="stable")]] = np.arange(
            len(found.patch_index)
        )
        shape = grid.patch_shape
        write_attention(path / "attention.zarr", Attention(scores.reshape(shape), rank.reshape(shape), policy))
        content = asdict(found) | {"patch_index": found.patch_index.tolist()}
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
        **({"plain": True} if plan.plain else {}),
        **({} if budget is None else {"patches": {name: getattr(budget, name) for name in SPARING}}),
        **zones.key,
    }
    return Wanted(build, params, [mosaic])


def plan_detail(
    grid: SceneGrid,
    plan: CapturePlan,
    camera: LineCamera,
    cost: CostModel,
    scores: Scores,
    recorded: RecordedPasses | None,
) -> FinePlan:
    """Plan the runs of lines that show most of the (patch,) scores in the time left.

    Of a recording it is the plan of free strips where that has its lines, else the one on the strips that it has.
    """
    plan_on = partial(
        plan_fine,
        grid,
        camera,
        cost,
        plan.along,
        scores,
        budget_s=plan.fine_s,
        margin_px=plan.margin_px,
        full=plan.full,
    )
    found = plan_on()
    if recorded is None:
        return found
    taken = recorded.served(found.sweeps)
    if taken is None and (swaths := recorded.swaths(-(field_px(grid, plan.along)[1] - 1) / 2)):
        found = plan_on(swaths=swaths)
    sweeps = recorded.fine_pass(found.sweeps) if taken is None else taken
    return replace(found, sweeps=sweeps, seconds=cost.seconds(sweeps, camera))


def all_seen(grid: SceneGrid, sweeps: Sequence[Sweep], camera: LineCamera, *, part: bool) -> FinePlan:
    """Return the plan of a uniform scan, or of a raster without sweeps: the patches seen, nothing to go back for."""
    patch_index = grid.valid_patches()
    if not sweeps:
        return FinePlan([], patch_index, 0.0, 0.0, "raster", "the pixels of the raster were taken as they are")
    words = format_scan(sweeps[0].step, exposing(camera, sweeps[0]).exposure_ms)
    if part:
        patch_index = np.flatnonzero(patches_shown(list(sweeps), grid, camera))
    what = "a part of the field was" if part else "the field was"
    return FinePlan([], patch_index, 0.0, 0.0, "scan", f"{what} scanned once: {words}")


def kept_within(budget: PatchBudget, scores: Scores, seen: FinePlan) -> FinePlan:
    """Return the plan of a uniform scan with the patches that the budget pays for; all patches were seen."""
    bought = budget.choose(scores)
    reason = f"{seen.reason}; {len(bought)} of {len(budget.patch_index)} patches are read in full"
    finite = np.where(np.isfinite(scores), scores, 0.0)
    expected_gain, wanted = float(finite[bought].sum()), float(np.maximum(finite, 0.0).sum())
    return replace(seen, patch_index=np.sort(bought), reason=reason, expected_gain=expected_gain, wanted_gain=wanted)


def load_plan(attention: StageRef, class_map: StageRef | None = None) -> FinePlan:
    """Read the plan of an attention store, with the patches that were chosen while ``class_map`` was drawn, if any."""
    plan = read_table(attention.path / "plan.json")
    if class_map is not None and (store := class_map.path / READING).exists():
        chosen, everything = chosen_patches(store), len(plan["patch_index"])
        words = f"{plan['reason']}; {len(chosen)} of {everything} patches are read in full"
        plan |= {"patch_index": chosen, "reason": words}
    kept = {
        "sweeps": [Sweep(**sweep) for sweep in plan["sweeps"]],
        "patch_index": np.array(plan["patch_index"], np.intp),
    }
    return FinePlan(**(plan | kept))
