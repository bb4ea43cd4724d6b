"""A planned survey: which lines are captured, what the network reads, and what both cost."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.field import Field
from spectralzoom.flows.planning.capture_plan import CapturePlan, ScanChoice
from spectralzoom.flows.planning.extent_choice import ExtentChoice
from spectralzoom.flows.planning.patch_budget import PatchBudget, ReadingCosts
from spectralzoom.flows.settings.settings import Settings
from spectralzoom.flows.stages.score import PatchGains
from spectralzoom.models.network.sizes import MultiplyAdds
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.placement import CascadeTable
from spectralzoom.models.weights.files import ReaderPart
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.planning.fine_pass import FinePlan, SecondPass
from spectralzoom.pipeline.planning.uniform_scans import ScanPerformance
from spectralzoom.storage.parallel.pool import WorkerPool


@dataclass(frozen=True, kw_only=True)
class SecondPassRequest:
    """Choice of the lines of a second pass by the scores of patches."""

    planner: SecondPass | None  # None of a uniform scan or a raster
    scan_record: ScanPerformance | None  # table by which it is chosen; None without one
    scanned: FinePlan  # plan of a uniform scan, or of a raster, which has no second pass
    overview_first: bool  # the overview is read before the map is drawn, to score patches


@dataclass(frozen=True, kw_only=True)
class ReadingPlan:
    """Reading of a field by the network, and its multiply-adds."""

    gains: PatchGains  # expected gain of patches by the policy of the settings
    costs: ReadingCosts
    kept: NDArray[np.intp]  # patches that zones leave
    seen: NDArray[np.intp]  # of them, those that lines of a partial scan show
    one_pass: bool  # a uniform scan, or a raster
    macs: str | None  # that the settings allow
    expected_loss: float | None  # that the settings accept [points]
    budget: PatchBudget | None  # None: no limit of multiply-adds
    cascade: CascadeTable | None  # losses; None without an accepted one, or where the weights have no table or network
    least_gain: float | None  # of patches that are read at full resolution; None where all are
    reader: ReaderPart | None  # of a prior map
    compared_px: int = 0  # that it reads

    @property
    def chooses(self) -> bool:
        """Return whether scores choose patches; not where all are captured and read at full resolution."""
        return not self.one_pass or self.budget is not None or self.least_gain is not None

    def with_components(self, count: int) -> ReadingPlan:
        """Return the same of a mosaic with this number of components, which a plan has to assume."""
        return replace(self, costs=replace(self.costs, bands=count))

    def of_whole_scan(self) -> ReadingPlan:
        """Return the same of one uniform scan of the whole field."""
        return replace(self, one_pass=True, seen=self.kept, compared_px=self.costs.grid.height * self.costs.grid.width)

    def work_done(self, patch_index: NDArray[np.integer], changed: NDArray[np.integer] | None = None) -> MultiplyAdds:
        """Count multiply-adds of the map with these patches at full resolution, and of the scores if used.

        ``changed`` (patch,) are those of which a second pass shows a part, by default all.
        """
        done = self.costs.of_map(patch_index)
        if self.least_gain is not None and self.one_pass:  # while drawn, which reads the overview once
            done = replace(done, score=self.costs.score(self.gains.policy))
        elif self.chooses:
            changed = None if self.one_pass else self.costs.grid.every_patch() if changed is None else changed
            done = self.costs.with_scores(patch_index, self.gains.policy, changed)
        if self.reader is None:
            return done
        return replace(done, detail=done.detail + self.reader.sizes.multiply_adds(self.compared_px))

    def figures(self, read: NDArray[np.intp], changed: NDArray[np.intp] | None = None) -> dict[str, Any]:
        """Return limits, patches and multiply-adds of the full network, for receipts."""
        return {
            "asked": {"macs": self.macs, "least_gain": self.least_gain, "expected_loss": self.expected_loss},
            "patches": len(read),
            "of_patches": len(self.kept),
            "multiply_adds": {
                "done": self.work_done(read, changed).total,
                "everything": self.costs.of_map(self.kept).total,
            },
        }

    def likely(self) -> tuple[NDArray[np.intp], ...]:
        """Return as many patches as are expected to be read at full resolution, or as the budget pays for.

        Those that other scenes need are followed by the fewest and the most that one of them needs.
        """
        if self.budget is not None:  # all gain the same
            return (self.budget.choose(np.full(self.costs.grid.patch_shape, np.inf).ravel()),)
        if self.cascade is None or self.least_gain is None:
            return (self.seen,)
        return tuple(self.seen[: round(one * len(self.seen))] for one in self.cascade.fractions_at(self.least_gain))


@dataclass(frozen=True, kw_only=True)
class SurveyPlan:
    """Planned survey of a field."""

    field: Field
    settings: Settings  # they request exactly these lines
    pool: WorkerPool
    passes: CapturePlan
    capture: LineSpec  # line spacing and light of the first pass or of the uniform scan
    step: int  # its line spacing [px]; 1 of a raster
    typical: tuple[Sweep, ...]  # of the passes, in exposures that a second one may have
    part: bool  # a partial scan
    registers: bool  # sweeps, to correct pointing errors
    request: SecondPassRequest
    reading: ReadingPlan
    scans: ScanChoice = dataclasses.field(default_factory=ScanChoice)
    extent: ExtentChoice | None = None  # of a partial scan
    control: SurveyPlan | None = None  # the best uniform scan of the same seconds, if it is asked for and another plan
    notes: tuple[str, ...] = ()
