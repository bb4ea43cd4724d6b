"""The second round of detail: where to go with what is left of the time, by what the first round showed.

Its sweeps are captured and registered as those of the first; its patches are stored together with the first ones
(`flows.survey.placement.cut_again`), so that the map is drawn from both as from one round.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.survey.field_work import FieldWork, region_params
from flows.survey.placement import seen_shares
from flows.survey.run import SurveyRun
from flows.survey.stages import Produce, load_plan, write_plan
from models.second_look import rescore
from pipeline.planning.fine_pass import FinePlan, plan_fine
from storage.archive.archive import StageRef
from storage.arrays.attention import Attention, load_attention, write_attention
from storage.arrays.patches import open_patches

WHOLE = 1 - 1e-9  # of a seat's pixels on the scene, seen: nothing is left to look at


def attend_again(
    run: SurveyRun, produce: Produce, mosaic: StageRef, attention: StageRef, patches: StageRef
) -> StageRef:
    """Score the seats that are left by what the first round showed, and plan the sweeps for the rest of the seconds.

    The store has the scores that either round was planned by last, and ranks over both.
    """

    def build(path: Path) -> None:
        """Both rounds as one plan, and the scores that the second was planned by."""
        work = FieldWork.of(run)
        before, first = load_attention(attention.path / "attention.zarr"), load_plan(attention)
        seats, share = open_patches(patches.path / "patches.zarr").seats, seen_shares(run, patches)
        whole = seats[share >= WHOLE]
        found = work.compare(mosaic.path / "mosaic.zarr", patches.path / "patches.zarr", run.report)
        scores = rescore(
            before.score.ravel(), seats, found[seats], run.grid.seat_shape,
            seen=np.where(share >= WHOLE, 1.0, share), relative=run.settings.policy != "gain",
        )  # fmt: skip
        plan = plan_fine(
            run.grid, run.camera, run.settings.cost, run.plan.along, scores, budget_s=run.plan.fine_s - first.seconds,
            margin_px=run.plan.margin_px, full=run.plan.full, threshold=run.settings.threshold,
        )  # fmt: skip
        plan = _of_round_two(plan, whole)
        work.check_memory(np.union1d(seats, plan.seats), len(run.scene.wavelength_nm))
        write_attention(path / "attention.zarr", _ranked_on(before, scores, seats, plan))
        write_plan(path, plan)

    params = {"weights": run.weights_key, "round": 2, **region_params(run.grid)}  # the rest is the first round's
    return produce("attend", build, params, [mosaic, attention, patches])


def _of_round_two(plan: FinePlan, whole: NDArray[np.integer]) -> FinePlan:
    """The plan without seats that a line passes again, and sweeps that no other of the survey is called like."""
    named = [replace(sweep, name=f"again-{sweep.name}") for sweep in plan.sweeps]
    return replace(plan, sweeps=named, seats=np.setdiff1d(plan.seats, whole))


def _ranked_on(
    before: Attention, scores: NDArray[np.float64], captured: NDArray[np.integer], plan: FinePlan
) -> Attention:
    """Scores and ranks of both rounds: seats of the second follow those of the first."""
    score, rank = scores.copy(), before.rank.ravel().copy()
    score[captured] = before.score.ravel()[captured]
    new = plan.seats[rank[plan.seats] < 0]
    rank[new[np.argsort(-scores[new], kind="stable")]] = rank.max(initial=-1) + 1 + np.arange(len(new))
    return Attention(score.reshape(before.score.shape), rank.reshape(before.rank.shape), before.policy)
