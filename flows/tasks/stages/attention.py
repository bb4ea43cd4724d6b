"""Define the stage that scores patches and plans the second pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tasks.capture_plan import CapturePlan
from flows.tasks.field_work import FieldWork, region_params
from flows.tasks.patch_budget import PatchBudget
from flows.tasks.stage import FieldFrame, Product, Report, Wanted, stage
from flows.tasks.zones import SurveyZones
from models.network.spectral import LineSpec
from models.policies.policies import SEEING_POLICIES, score_patches
from models.reading.expected_errors import PatchExpectedErrors
from models.reading.inference import CoarsePrediction
from pipeline.capture.recorded_passes import RecordedPasses
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid, patch_pixels
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.planning.coverage import field_px, patches_shown
from pipeline.planning.fine_pass import FinePlan, plan_fine
from pipeline.planning.partial_scans import lines_between, merged_ms, most_within
from pipeline.planning.uniform_scans import MIOU, ScanPerformance, format_scan, longest_exposure
from storage.archive.keys import StageRef, array_digest
from storage.archive.manifests import read_table, write_table
from storage.arrays.mosaics import Attention, chosen_patches, open_mosaic, write_attention
from storage.readers.scene_files import RasterPixels

READING = "attention.zarr"  # beside a class map whose drawing chose the patches
ATTENTION = Product("score", version=10, files=("attention.zarr", "plan.json"), by_weights=True)
Scores = NDArray[np.float64]
LEAST_GAIN = 1e-3  # of mIoU; below it there is no second pass
EXPOSURES = 7  # that are tried, equally spaced by logarithm
PLANNED = 2  # spacings and exposures with the highest bound of gain, of which plans are made
TRIES = 5  # to fit runs into the time


@stage("score", "patch scores", ATTENTION)
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
        scan_plan = all_seen(grid, () if raster is not None else plan.coarse, camera, part=part)
        if budget is None:
            return np.zeros(int(np.prod(grid.patch_shape))), scan_plan
        scores = expected_gain()
        return scores, kept_within(budget, scores, scan_plan)

    def build(path: Path) -> None:
        """Write score and rank of every patch, and the plan."""
        scores, found = planned()
        if fractions is not None:
            found = replace(found, patch_index=found.patch_index[fractions[found.patch_index] > 0])
        read = found.patch_index
        if not plan.plain and (least_gain is not None or found.kind == "full" or not found.sweeps):
            read = grid.valid_patches()  # the segmentation chooses among them
            read = read if fractions is None else read[fractions[read] > 0]
        # raises an error before the second pass where the map will not fit the memory
        work.pool_for(read, len(open_mosaic(mosaic.path / "mosaic.zarr").components))
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
    return Wanted(build, params, [mosaic], shown=not plan.plain or budget is not None)


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


def kept_within(budget: PatchBudget, scores: Scores, scan_plan: FinePlan) -> FinePlan:
    """Return the plan of a uniform scan with the patches that the budget pays for."""
    chosen = budget.choose(scores)
    reason = f"{scan_plan.reason}; the full network reads {len(chosen)} of {len(budget.patch_index)} patches"
    finite = np.where(np.isfinite(scores), scores, 0.0)
    expected_gain, wanted = float(finite[chosen].sum()), float(np.maximum(finite, 0.0).sum())
    return replace(
        scan_plan, patch_index=np.sort(chosen), reason=reason, expected_gain=expected_gain, wanted_gain=wanted
    )


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


@dataclass(frozen=True)
class LaterPasses:
    """Planner of the second pass within the time that the first leaves."""

    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    plan: CapturePlan
    recorded: RecordedPasses | None = None

    @property
    def interlaces(self) -> bool:
        """Return whether new lines lie between those of the first pass: not with pointing errors."""
        return not self.plan.margin_px

    @property
    def _apart(self) -> int:
        """Return the line spacing of the first pass [px]."""
        return self.plan.coarse[0].step

    def _exposures(self, record: ScanPerformance, step: int) -> list[float]:
        """Return the exposures to try [ms], including the longest one for which the whole field fits the time."""
        shortest, longest = record.offered_ms(self.camera)
        tried = np.geomspace(shortest, longest, EXPOSURES).round(1).tolist()
        between = lines_between(self.plan.full, self.plan.coarse if self.interlaces else [], step=step)
        last = longest_exposure(self.plan.fine_s, between, self.camera, self.cost, shortest, longest)
        return sorted({*tried, *([] if last is None else [last])})

    def _most_gain(self, gain: Scores, step: int, exposure_ms: float) -> float:
        """Return an upper bound of the gain of a line spacing and an exposure."""
        field = self.grid, self.plan.coarse, self.camera, self.cost
        return most_within(
            self.plan.fine_s, gain, *field, step=step, exposure_ms=exposure_ms, interlaced=self.interlaces
        )

    def within(
        self, gain: Scores, *, step: int = 1, exposure_ms: float | None = None, own_swaths: bool = True
    ) -> FinePlan:
        """Return the runs of lines with a spacing of ``step`` px that have the highest sum of (patch,) ``gain``.

        With ``own_swaths``, runs lie on the swaths of the first pass and consist of the lines between. Otherwise swaths
        are free, and runs consist of all lines.
        """
        plan, interlaced = self.plan, own_swaths and self.interlaces
        exposed = self.camera if exposure_ms is None else replace(self.camera, exposure_ms=exposure_ms)
        start = -(field_px(self.grid, plan.along)[1] - 1) / 2
        first_pass = plan.coarse if interlaced else []
        swaths = [
            Sweep(f"fine-{number:03d}", "fine", plan.along, place, start, 0)
            for number, place in enumerate(sorted({sweep.swath_px for sweep in first_pass}))
        ]
        missing = 1 / step - 1 / first_pass[0].step if first_pass else 1 / step  # new lines per line of the full scan
        budget_s, found = plan.fine_s / missing, None
        for _ in range(TRIES):
            found = plan_fine(
                self.grid,
                exposed,
                self.cost,
                plan.along,
                gain,
                budget_s=budget_s,
                margin_px=plan.margin_px,
                full=plan.full,
                swaths=swaths or None,
            )
            sweeps = lines_between(found.sweeps, first_pass, step=step, exposure_ms=exposure_ms)
            seconds = self.cost.seconds(sweeps, self.camera)
            if seconds <= plan.fine_s:
                if self.recorded is not None:  # only its lines exist
                    sweeps = self.recorded.fine_pass(sweeps)
                    seconds = self.cost.seconds(sweeps, self.camera)
                return replace(found, sweeps=sweeps, seconds=seconds)
            budget_s *= 0.98 * plan.fine_s / seconds
        assert found is not None
        return replace(found, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, expected_gain=0.0)

    def best(
        self,
        errors: PatchExpectedErrors,
        record: ScanPerformance,
        class_names: tuple[str, ...],
        value: Callable[[Scores], Scores],
    ) -> FinePlan:
        """Return the plan with the highest expected gain in mIoU, by the scan performance table.

        ``errors`` are the expected errors after the first pass; ``value`` weights (patch,) gains by zones.
        """
        first, steps = exposing(self.camera, self.plan.coarse[0]), [one for one in record.steps if one < self._apart]
        gains: dict[tuple[int, float], Scores] = {}
        for step in steps:
            for exposure_ms in self._exposures(record, step):
                again = step / self._apart if self.interlaces else 0.0
                mean_ms = merged_ms(first.exposure_ms, exposure_ms, again)  # mean exposure of old and new lines
                expected = record.expected(step, float(np.clip(mean_ms, *record.offered_ms(self.camera))))
                iou = np.array([expected.get(name, expected[MIOU]) for name in class_names])
                gains[step, exposure_ms] = value(errors.expected_gain((1 - iou) / (1 + iou)))
        ranked = sorted(gains, key=lambda one: -self._most_gain(gains[one], *one))
        plans: list[tuple[tuple[int, float], FinePlan]] = []
        for one in ranked[:PLANNED]:
            plans.append((one, self.within(gains[one], step=one[0], exposure_ms=one[1])))
        if self.recorded is None and ranked and plans[0][1].kind != "full":
            one = max(plans, key=lambda made: made[1].expected_gain)[0]
            plans.append((one, self.within(gains[one], step=one[0], exposure_ms=one[1], own_swaths=False)))
        (step, exposure_ms), plan = max(plans, key=lambda made: (made[1].expected_gain, -made[1].seconds))
        if plan.expected_gain < LEAST_GAIN:
            nothing = f"no second pass: its expected gain is {100 * plan.expected_gain:.2f} points"
            return replace(plan, sweeps=[], patch_index=np.empty(0, np.intp), seconds=0.0, reason=nothing)
        what = "the whole field" if plan.kind == "full" else f"{len(plan.patch_index)} patches"
        return replace(plan, reason=f"captured again: {what}, {format_scan(step, exposure_ms)}")
