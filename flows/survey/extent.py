"""How much there is to do in a survey: in the units that its stages' costs grow with, and in multiply-adds."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import astuple, dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from flows.survey.field_work import SHARD
from flows.survey.run import SurveyRun
from flows.survey.stage import Unit
from models.network.cost import MultiplyAdds, multiply_adds
from models.network.sizes import SegmenterConfig
from models.policies.policies import IMAGE_POLICIES, NETWORK_POLICIES, SEEING_POLICIES
from models.reading.regions import Region, plan_regions, whole_field
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel


@dataclass(frozen=True)
class Extent:
    """A survey by its sizes. The fine pass is None where nothing of it is known."""

    config: SegmenterConfig
    grid: SceneGrid
    camera: LineCamera
    cost: CostModel
    along: Axis
    bands: int
    coarse_lines: int
    fine_lines: int | None = None
    fine_runs: int | None = None

    @property
    def run_lines(self) -> float:
        """Lines of a fine run, on average; the widest strip of seats where there was none."""
        if not self.fine_lines or not self.fine_runs:
            return float(self.grid.width if self.along == "y" else self.grid.height)
        return self.fine_lines / self.fine_runs

    def buying(self, seconds: float, *, run_lines: float, most: int) -> Extent:
        """The same with as many fine lines as ``seconds`` buy in runs of ``run_lines``, but no more than ``most``.

        Which lines those are is known once the coarse pass has been looked at; how many hardly depends on it.
        """

        def price(lines: int) -> float:
            runs, loads = ceil(lines / run_lines), ceil(lines / self.cost.vector_pairs)
            return (
                self.camera.scan_seconds(lines)
                + runs * self.cost.setup_seconds(self.camera)
                + loads * self.cost.reload_s
            )

        lines = bisect_right(range(1, most + 1), seconds, key=price)
        return replace(self, fine_lines=lines, fine_runs=ceil(lines / run_lines))

    def work(self, unit: Unit) -> float:
        height, width = self.grid.coarse_shape
        coarse, fine = self.coarse_lines * self.camera.samples, (self.fine_lines or 0) * self.camera.samples
        match unit:
            case "pixels":
                return self.grid.height * self.grid.width
            case "coarse pixels":
                return height * width
            case "scene values":
                return self.grid.height * self.grid.width * self.bands
            case "mosaic values":
                return height * width * self.bands
            case "coarse values":
                return coarse * self.bands
            case "fine values":
                return fine * self.bands
            case "patch values":
                return self._fine_pixels * self.bands
            case "operations of the map":
                return self._map_operations()
            case "operations of a glance":  # of reading the coarse patches of the whole field alone
                return float(multiply_adds(self.config, whole_field(self.grid).grid, 0, self.bands, None).total)
            case "surveys":  # what is the same for every field
                return 1

    @property
    def _fine_pixels(self) -> int:
        """Pixels of the field under the fine lines: a line longer than the field shows no more of it."""
        across = self.grid.width if self.along == "x" else self.grid.height
        return (self.fine_lines or 0) * min(self.camera.samples, across)

    def _map_operations(self) -> float:
        if self.fine_lines is None:
            return 0.0
        pixels = self.grid.height * self.grid.width
        total = 0
        for region in plan_regions(self.grid, SHARD):
            read = region.grid
            seats = round(min(self._fine_pixels / pixels, 1.0) * read.height * read.width / read.patch**2)
            total += multiply_adds(self.config, read, seats, self.bands, None).total
        return float(total)


def work_done(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the scores of the field, and the map drawn with fine patches at these seats.

    Stages keep nothing of the model for each other, so that each reads the coarse look anew: ``glance`` holds what map
    and scores took for it.
    """
    policy, regions = run.settings.policy, plan_regions(run.grid, SHARD)
    drawn = work_of_map(run, seats)
    looks = 2 if policy in SEEING_POLICIES and policy not in NETWORK_POLICIES else 1
    scored = [whole_field(run.grid)] if policy in IMAGE_POLICIES else regions
    score = sum(_of_region(run, region, 0, policy).score for region in scored)
    return replace(drawn, glance=looks * drawn.glance, score=score)


def work_of_map(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the map drawn with fine patches at these seats of the field."""
    regions = plan_regions(run.grid, SHARD)
    counts = [int(np.count_nonzero(region.numbers_here(seats) >= 0)) for region in regions]
    parts = [astuple(_of_region(run, region, count, None)) for region, count in zip(regions, counts, strict=True)]
    return MultiplyAdds(*(sum(part) for part in zip(*parts, strict=True)))


def _of_region(run: SurveyRun, region: Region, seats: int, policy: str | None) -> MultiplyAdds:
    channels = 3 if run.vgg is None else run.vgg.channels
    bands = len(run.scene.wavelength_nm)
    return multiply_adds(run.described.config, region.grid, seats, bands, policy, channels=channels)
