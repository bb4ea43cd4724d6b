"""Score the patches of a field, and plan the second pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import FieldFrame
from spectralzoom.flows.planning.patch_budget import PatchBudget
from spectralzoom.flows.stage import Output, Report, stage
from spectralzoom.flows.stages.field_work import NO_PATCHES, FieldWork
from spectralzoom.flows.stages.overview import OVERVIEWS
from spectralzoom.flows.zones import SurveyZones
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.policies import SEEING_POLICIES, Scores, score_patches
from spectralzoom.models.reading.inference import CoarsePrediction
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid, patch_pixels
from spectralzoom.pipeline.geometry.scan import Sweep, exposing
from spectralzoom.pipeline.planning.coverage import patches_shown
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance, format_scan
from spectralzoom.storage.arrays.mosaics import Attention, chosen_patches, open_mosaic, write_attention
from spectralzoom.storage.store import Ref, read_table, write_table

SCORES = "attention.zarr"
OF_PATCHES = ("patch_index", "changed")  # of a plan
READING = SCORES  # also beside a class map, whose drawing chose the patches
MADE_BY = ("models/network", "models/reading", "models/policies", "pipeline/planning")


@dataclass(frozen=True)
class PatchGains:
    """Expected gain of the patches of a field by one policy, within its zones."""

    frame: FieldFrame
    zones: SurveyZones
    work: FieldWork
    capture: LineSpec
    policy: str
    seed: int
    mask: NDArray[np.generic] | None  # (y, x) or (y, x, channel) of policy ``mask``

    @property
    def key(self) -> dict[str, Any]:
        """Return the parameters of the gains."""
        sees = self.policy in SEEING_POLICIES
        return {
            "frame": self.frame,
            "zones": self.zones,
            "work": self.work,
            "policy": self.policy,
            "seed": self.seed if self.policy == "random" else None,
            "mask": self.mask,
            "capture": list(self.capture) if sees else None,
        }

    def by_policy(self, mosaic: Ref, overviews: Path | None, report: Report) -> Scores:
        """Return the (patch,) expected gain by the policy; ``overviews`` of the mosaic are not computed again."""
        if self.policy in SEEING_POLICIES:
            return self.within_zones(self.work.score(self.policy, mosaic, self.capture, report, overviews).ravel())
        nothing = np.empty((0, 0, 0), np.float32)
        unseen = CoarsePrediction(self.frame.grid, nothing, nothing)
        return self.within_zones(score_patches(self.policy, unseen, seed=self.seed, mask=self.mask))

    def within_zones(self, scores: Scores) -> Scores:
        """Return (patch,) scores times the fraction of each patch that zones leave; 0 outside of the scene."""
        grid = self.frame.grid
        fractions = self.zones.fractions
        if self.frame.missing is not None:
            void = patch_pixels(grid, self.frame.missing).mean(axis=(1, 2)) >= grid.valid_fraction().ravel()
            scores = np.where(void, 0.0, scores)
        return scores if fractions is None else np.where(fractions > 0, scores, 0.0) * fractions

    def kept(self, patch_index: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those patches that zones leave."""
        fractions = self.zones.fractions
        return patch_index if fractions is None else patch_index[fractions[patch_index] > 0]


@stage("patch scores", version=23, made_by=MADE_BY)
def score(
    out: Output,
    mosaic: Ref,
    overview: Ref | None,
    *,
    gains: PatchGains,
    second_pass: SecondPass | None,
    scan_record: ScanPerformance | None,
    scanned: FinePlan,
    budget: PatchBudget | None,
    least_gain: float | None,
) -> None:
    """Score every patch by the coarse mosaic, and plan the sweeps with the highest total score in the time left.

    Without a second pass, ``scanned`` is the plan, and ``budget`` limits its patches. ``overview`` is that of the
    mosaic, for policies that score by it.
    """
    overviews = None if overview is None else overview.path / OVERVIEWS
    components = len(open_mosaic(mosaic.path / "mosaic.zarr").components)
    if second_pass is None and budget is None:
        scores, found = np.zeros(int(np.prod(gains.frame.grid.patch_shape))), scanned
    elif second_pass is not None and scan_record is not None:
        scores, found = gain_by_record(gains, mosaic, overviews, second_pass, scan_record, out.report)
    else:
        scores = gains.by_policy(mosaic, overviews, out.report)
        if second_pass is not None:
            found = second_pass.by_score(scores)
        else:
            assert budget is not None
            found = within_budget(scanned, scores, replace(budget, costs=replace(budget.costs, bands=components)))
    changed = NO_PATCHES
    if second_pass is not None:
        changed = np.flatnonzero(patches_shown(found.sweeps, gains.frame.grid, second_pass.camera))
    found = replace(found, patch_index=gains.kept(found.patch_index), changed=changed)
    read = found.patch_index
    if second_pass is not None and (least_gain is not None or found.kind == "full" or not found.sweeps):
        read = gains.kept(gains.frame.grid.every_patch())  # the segmentation chooses among them
    # raises an error before the second pass where the map will not fit the memory
    gains.work.pool_for(read, components)
    rank = np.full(scores.shape, -1, np.int32)
    rank[read[np.argsort(-scores[read], kind="stable")]] = np.arange(len(read))
    shape = gains.frame.grid.patch_shape
    write_attention(out.path / SCORES, Attention(scores.reshape(shape), rank.reshape(shape), gains.policy))
    write_table(out.path / "plan.json", asdict(found) | {name: getattr(found, name).tolist() for name in OF_PATCHES})


def within_budget(scanned: FinePlan, scores: Scores, budget: PatchBudget) -> FinePlan:
    """Return the plan of a uniform scan whose patches a budget of multiply-adds limits."""
    chosen = budget.choose(scores)
    reason = f"{scanned.reason}; the full network reads {len(chosen)} of {len(budget.patch_index)} patches"
    gain = float(np.where(np.isfinite(scores), scores, 0.0)[chosen].sum())
    return replace(scanned, patch_index=np.sort(chosen), reason=reason, expected_gain=gain)


def gain_by_record(
    gains: PatchGains,
    mosaic: Ref,
    overviews: Path | None,
    second_pass: SecondPass,
    record: ScanPerformance,
    report: Report,
) -> tuple[Scores, FinePlan]:
    """Return the expected wrong pixels of the first pass, and the second pass of the highest expected gain."""
    errors = gains.work.expected_errors(mosaic, gains.capture, report, overviews)
    class_names = gains.work.weights.load().class_names

    def gain_of(step: int, exposure_ms: float) -> Scores:
        return gains.within_zones(errors.expected_gain(record.error_rates(step, exposure_ms, class_names)))

    return np.tensordot(errors.pixels, errors.expected_error, 2), second_pass.best(record, gain_of)


def all_seen(grid: SceneGrid, sweeps: Sequence[Sweep], camera: LineCamera, *, part: bool) -> FinePlan:
    """Return the plan of a uniform scan, or of a raster without sweeps: the captured patches, and no second pass."""
    patch_index = grid.every_patch()
    if not sweeps:
        return FinePlan([], patch_index, 0.0, 0.0, "raster", "the pixels of the raster are used as they are")
    scan = format_scan(sweeps[0].step, exposing(camera, sweeps[0]).exposure_ms)
    if part:
        patch_index = np.flatnonzero(patches_shown(list(sweeps), grid, camera))
    what = "a part of the field was" if part else "the field was"
    return FinePlan([], patch_index, 0.0, 0.0, "scan", f"{what} scanned once: {scan}")


def load_plan(attention: Ref) -> FinePlan:
    """Read the plan of the second pass: sweeps, and the patches that they cover."""
    plan = read_table(attention.path / "plan.json")
    plan |= {name: np.array(plan[name], np.intp) for name in OF_PATCHES}
    return FinePlan([Sweep(**one) for one in plan.pop("sweeps")], **plan)


def read_in_full(attention: Ref, class_map: Ref) -> NDArray[np.intp]:
    """Return the patches (patch,) that the full network read, chosen before or during segmentation."""
    store = class_map.path / READING
    return chosen_patches(store if store.exists() else attention.path / SCORES)
