"""The stages of attention: a score for every patch, and the sweeps that show most of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import SPARING
from flows.settings.values import EXTENT_WHOLE
from flows.tasks.field_work import FieldWork, region_params
from flows.tasks.patch_budget import PatchBudget
from flows.tasks.run import SurveyRun
from flows.tasks.stage import Product, Wanted, stage
from models.policies.policies import SEEING_POLICIES, score_patches
from models.reading.inference import CoarsePrediction
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.geometry.grid import patch_pixels
from pipeline.geometry.scan import Sweep, exposing
from pipeline.planning.coverage import field_px, patches_shown
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.uniform_scans import format_scan
from storage.archive.keys import StageRef, array_digest
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import Attention, write_attention

ATTENTION = Product("score", version=7, files=("attention.zarr", "plan.json"), by_weights=True)


@stage("score", "attention and plan", ATTENTION)
def score(run: SurveyRun, mosaic: StageRef) -> Wanted:
    """Score every patch by the coarse mosaic, and plan the sweeps that show the most score in the time left."""
    settings = run.settings

    def build(path: Path) -> None:
        """Write every patch's score and rank, and the plan of sweeps; refuse a map that does not fit."""
        work = FieldWork.of(run)
        scores, plan = _planned(run, work, mosaic)
        work.pool_for(
            plan.patch_index, len(run.scene.wavelength_nm)
        )  # refuses what does not fit before the rig goes back
        rank = np.full(scores.shape, -1, np.int32)
        rank[plan.patch_index[np.argsort(-scores[plan.patch_index], kind="stable")]] = np.arange(len(plan.patch_index))
        shape = run.grid.patch_shape
        write_attention(path / "attention.zarr", Attention(scores.reshape(shape), rank.reshape(shape), settings.policy))
        write_table(path / "plan.json", asdict(plan) | {"patches": plan.patch_index.tolist()})

    captures = {
        "fine_s": run.plan.fine_s,
        "overlap_px": run.plan.overlap_px,
        "margin_px": run.plan.margin_px,
        "along": run.plan.along,
        "camera": asdict(run.camera),
        "cost": asdict(settings.cost),
    }
    params = {
        **run.model_key,
        "grid": asdict(run.grid),
        "policy": settings.policy,
        "seed": settings.seed if settings.policy == "random" else None,
        "mask": None if run.mask is None else array_digest(run.mask),
        **(captures if run.raster is None else {}),
        **(region_params(run.grid) if settings.policy in SEEING_POLICIES else {}),
        **({"plain": True} if run.plan.plain else {}),
        **({} if run.budget is None else {"patches": {name: getattr(settings, name) for name in SPARING}}),
        **run.zones.key,
    }
    return Wanted(build, params, [mosaic])


def _planned(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> tuple[NDArray[np.float64], FinePlan]:
    """Scores of the patches where some are chosen, and what is seen of the field in detail."""
    if not run.plan.plain:
        return _scored(run, work, mosaic)
    return _whole_field(run) if run.budget is None else _part_of_scan(run, run.budget, work, mosaic)


def _scored(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> tuple[NDArray[np.float64], FinePlan]:
    """Scores of the patches, and the runs of lines that show most of them in the time left."""
    scores = _scores_within_zones(run, work, mosaic)
    plan_on = partial(
        plan_fine,
        run.grid,
        run.camera,
        run.settings.cost,
        run.plan.along,
        scores,
        budget_s=run.plan.fine_s,
        margin_px=run.plan.margin_px,
        full=run.plan.full,
    )
    plan = plan_on()
    if run.recorded is not None:
        plan = _recorded_plan(run, run.recorded, plan, plan_on)
    return scores, _kept_patches(run, plan)


def _recorded_plan(
    run: SurveyRun, recorded: RecordedPasses, plan: FinePlan, plan_on: Callable[..., FinePlan]
) -> FinePlan:
    """The plan of free strips where a recording has its lines, else the one on the strips that it has."""
    taken = recorded.served(plan.sweeps)
    if taken is None and (swaths := recorded.swaths(-(field_px(run.grid, run.plan.along)[1] - 1) / 2)):
        plan = plan_on(swaths=swaths)
    sweeps = recorded.fine_pass(plan.sweeps) if taken is None else taken
    return replace(plan, sweeps=sweeps, seconds=run.settings.cost.seconds(sweeps, run.camera))


def _kept_patches(run: SurveyRun, plan: FinePlan) -> FinePlan:
    """The plan with the patches alone of which zones leave something."""
    fractions = run.zones.fractions
    return plan if fractions is None else replace(plan, patch_index=plan.patch_index[fractions[plan.patch_index] > 0])


def _part_of_scan(
    run: SurveyRun, budget: PatchBudget, work: FieldWork, mosaic: StageRef
) -> tuple[NDArray[np.float64], FinePlan]:
    """Scores of the patches, and those of a uniform scan that the budget pays for: all were seen, some are kept."""
    scores, every = _scores_within_zones(run, work, mosaic), _whole_field(run)[1]
    bought = budget.choose(scores)
    s = run.grid.factor
    reason = (
        f"{every.reason}; {len(bought)} of {len(budget.patch_index)} patches are kept and read in detail, the others as means "
        f"of {s} x {s} px"
    )
    finite = np.where(np.isfinite(scores), scores, 0.0)
    expected_gain, wanted = float(finite[bought].sum()), float(np.maximum(finite, 0.0).sum())
    return scores, replace(
        every, patch_index=np.sort(bought), reason=reason, expected_gain=expected_gain, wanted_gain=wanted
    )


def _scores_within_zones(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> NDArray[np.float64]:
    """(patch,) worth of a fine look at each patch, by the fraction of it that zones leave.

    What is seen of the others beside it is not asked for.
    """
    scores, fractions = _scores(run, work, mosaic), run.zones.fractions
    return scores if fractions is None else np.where(fractions > 0, scores, 0.0) * fractions


def _whole_field(run: SurveyRun) -> tuple[NDArray[np.float64], FinePlan]:
    """No scores, and the plan of a uniform scan or a raster: every patch is seen, and nothing to go back for."""
    nothing = np.zeros(int(np.prod(run.grid.patch_shape)))
    if run.raster is not None:
        reason = "the pixels of the raster were taken as they are"
        return nothing, _kept_patches(run, FinePlan([], run.grid.valid_patches(), 0.0, 0.0, "raster", reason))
    sweep = run.plan.coarse[0]
    words = format_scan(sweep.step, exposing(run.camera, sweep).exposure_ms)
    patch_index, what = run.grid.valid_patches(), "the field was"
    if run.settings.extent != EXTENT_WHOLE:
        patch_index, what = (
            np.flatnonzero(patches_shown(run.plan.coarse, run.grid, run.camera)),
            "a part of the field was",
        )
    plan = FinePlan([], patch_index, 0.0, 0.0, "scan", f"{what} scanned once: {words}")
    return nothing, _kept_patches(run, plan)


def _scores(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> NDArray[np.float64]:
    """(patch,) worth of a fine look at each patch of the padded grid."""
    scores = _scores_of_patches(run, work, mosaic)
    if run.scene.missing is not None:  # a patch without any pixel of the scene is worth no look
        scores = np.where(_on_no_scene(run), 0.0, scores)
    return scores


def _on_no_scene(run: SurveyRun) -> NDArray[np.bool_]:
    """(patch,) of whose pixels the scene has none."""
    grid, missing = run.grid, run.scene.missing
    assert missing is not None
    return np.asarray(patch_pixels(grid, missing).mean(axis=(1, 2)) >= grid.valid_fraction().ravel())


def _scores_of_patches(run: SurveyRun, work: FieldWork, mosaic: StageRef) -> NDArray[np.float64]:
    policy = run.settings.policy
    if policy in SEEING_POLICIES:
        return work.score(policy, mosaic.path / "mosaic.zarr", lambda done: run.report(0.5 * done)).ravel()
    nothing = np.empty((0, 0, 0), np.float32)
    return score_patches(policy, CoarsePrediction(run.grid, nothing, nothing), seed=run.settings.seed, mask=run.mask)


def load_plan(attention: StageRef) -> FinePlan:
    """Read the plan of an attention store."""
    plan = read_table(attention.path / "plan.json")
    kept = {"sweeps": [Sweep(**sweep) for sweep in plan["sweeps"]], "patches": np.array(plan["patches"], np.intp)}
    return FinePlan(**(plan | kept))
