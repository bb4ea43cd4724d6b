"""How much there is to do in a survey, in the units of its stages' costs, and what stages took and would take."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import RASTER
from flows.tasks.open_survey import STAGES
from flows.tasks.reading_costs import SHARD, ReadingCosts
from flows.tasks.run import SurveyRun
from flows.tasks.stage import Unit
from models.network.sizes import MultiplyAdds, SegmenterConfig, multiply_adds
from models.reading.regions import plan_regions, whole_field
from pipeline.errors import PipelineError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel
from storage.archive.lineage import Catalogue
from storage.archive.manifests import Cost
from storage.archive.records import Store
from storage.arrays.cubes import open_raw_cube


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
    plain: bool = False  # the coarse lines are those of a plain scan, which shows everything

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
        """Give how much of a unit of work a survey of this size has; 0 of the fine pass where nothing of it is known.

        Pixels are px of the field, values px times bands, operations multiply-adds of the network.
        """
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
                return float(multiply_adds(self.config, whole_field(self.grid).grid, 0, self.bands).total)
            case "surveys":  # what is the same for every field
                return 1

    @property
    def _fine_pixels(self) -> int:
        """Pixels of the field under the fine lines: a line longer than the field shows no more of it."""
        if self.plain:
            return self.grid.height * self.grid.width
        across = self.grid.width if self.along == "x" else self.grid.height
        return (self.fine_lines or 0) * min(self.camera.samples, across)

    def _map_operations(self) -> float:
        if self.fine_lines is None and not self.plain:
            return 0.0
        pixels = self.grid.height * self.grid.width
        total = 0
        for region in plan_regions(self.grid, SHARD):
            read = region.grid
            seats = round(min(self._fine_pixels / pixels, 1.0) * read.height * read.width / read.patch**2)
            total += multiply_adds(self.config, read, seats, self.bands).total
        return float(total)


def work_done(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the scores of the field, and the map drawn with fine patches at these seats.

    Where everything is seen and read nothing is scored.
    """
    costs = reading_costs(run)
    done = costs.with_scores(seats, run.settings.policy) if run.chooses else costs.of_map(seats)
    if run.prior is not None and run.reader is not None:
        recalled = run.reader.sizes.multiply_adds(run.grid.height * run.grid.width)
        done = replace(done, decode=done.decode + recalled)
    return done


def work_of_map(run: SurveyRun, seats: NDArray[np.integer]) -> MultiplyAdds:
    """Count the map drawn with fine patches at these seats of the field."""
    return reading_costs(run).of_map(seats)


def reading_costs(run: SurveyRun) -> ReadingCosts:
    """What it takes to read the field of a survey."""
    channels = 3 if run.vgg is None else run.vgg.channels
    return ReadingCosts(run.described.config, run.grid, len(run.scene.wavelength_nm), channels)


MOST_RECORDS = 5  # of a stage that are looked into
APART = 2.0  # times the work of another: then the two tell what starting takes
CONTROLS_UNIT: Unit = "scene values"  # judging with controls scans the whole field


class PastCosts:
    """The stores of an archive as records of what a run of these settings would cost."""

    def __init__(self, catalogue: Catalogue, run: SurveyRun) -> None:
        self._catalogue, self._run = catalogue, run
        self._extent = Extent(
            run.described.config,
            run.grid,
            run.camera,
            run.settings.cost,
            run.plan.along,
            len(run.scene.wavelength_nm),
            sum(sweep.lines for sweep in run.plan.coarse),
            plain=run.plan.plain,
        )
        self._fine_lines: int | None = None

    def plan_fine(self, lines: int) -> None:
        """Take note of how many lines the fine pass has; before that they are what its seconds are likely to buy."""
        self._fine_lines = lines

    def stored(self, stage: str) -> list[Store]:
        asked = STAGES[stage]
        found = [
            store
            for store in self._by_stage.get(asked.product.name, [])
            if store.problem is None and asked.inputs in (None, len(store.inputs))
        ]
        return sorted(found, key=lambda store: store.created, reverse=True)

    @cached_property
    def _by_stage(self) -> dict[str, list[Store]]:
        found: dict[str, list[Store]] = {}
        for store in self._catalogue.stores.values():
            found.setdefault(store.ref.stage, []).append(store)
        return found

    def of_scene(self, store: Store) -> bool:
        """Whether a store is of the run's scene, or of none: a lookup is of a path."""
        scenes = {str(one.params["scene"]) for one in self._below(store) if "scene" in one.params}
        return scenes <= {self._run.scene.key}

    def estimate(self, stage: str) -> tuple[float | None, int | None, str]:
        """Seconds and bytes by the newest record, of this scene if there is one, and what they come from.

        The record is scaled by the stage's unit of work; where there is a second one of a much larger or smaller
        survey, what both spent on starting is told apart first. None and None where there is no record, or none that
        tells how much work it was.
        """
        records = [store for store in self.stored(stage) if store.cost is not None]
        if stage == "evaluate":  # controls are many times the work of judging a map alone
            records = [store for store in records if store.params.get("controls") == self._run.controls]
        if not records:
            return None, None, "no such store has a record of what it took"
        unit = CONTROLS_UNIT if stage == "evaluate" and self._run.controls else STAGES[stage].unit
        known = self._known(sorted(records, key=lambda store: not self.of_scene(store)), unit)
        if not known:
            return None, None, f"{records[0].ref.uri} does not tell how much work it was"
        here = self._extent_like(known[0][2])

        def scaled(by: Unit, took: Sequence[float]) -> float:
            return scaled_cost([then.work(by) for _, _, then in known], took, here.work(by))

        seconds = scaled(unit, [cost.wall_s for _, cost, _ in known])
        size = scaled(STAGES[stage].size or unit, [cost.size for _, cost, _ in known])
        address, first, _ = known[0]
        rest = "" if len(known) == 1 else f", and {known[1][0]}"
        times = seconds / first.wall_s if first.wall_s else 0.0
        return seconds, round(size), f"{address} times {times:.3g}, by {unit}{rest}"

    def _known(self, records: Sequence[Store], unit: Unit) -> list[tuple[str, Cost, Extent]]:
        known: list[tuple[str, Cost, Extent]] = []
        for record in records[:MOST_RECORDS]:
            try:
                then = self._extent_then(record)
                work, first = then.work(unit), known[0][2].work(unit) if known else 0.0
            except (LookupError, TypeError, ValueError, OSError, PipelineError):  # of a version with other parameters
                continue
            if record.cost is not None and work and (not known or not 1 / APART < work / first < APART):
                known.append((record.ref.uri, record.cost, then))
            if len(known) == 2:
                break
        return known

    def _extent_like(self, then: Extent) -> Extent:
        """This run, with the fine pass's lines as planned, else as many as its seconds buy in runs as long as then."""
        if self._fine_lines is not None and not self._extent.plain:
            return replace(self._extent, fine_lines=self._fine_lines)
        plan = self._run.plan
        most = sum(sweep.lines for sweep in plan.full)
        return self._extent.buying(plan.fine_s, run_lines=then.run_lines, most=most)

    def _extent_then(self, record: Store) -> Extent:
        """How much a survey was, as far as a store and those that it rests on tell by their parameters."""
        below = self._below(record)
        own = self._extent
        rasters = [store.params for store in below if store.params.get("source") == RASTER]
        if rasters:  # nothing was captured
            grid = SceneGrid(**rasters[0]["grid"])
            return replace(own, grid=grid, bands=rasters[0]["bands"], coarse_lines=0, plain=True)
        captures = {_is_fine(store): store for store in below if store.ref.stage == _stored_by("capture_coarse")}
        passes = [store for store in below if store.ref.stage == _stored_by("capture_fine") and _is_fine(store)]
        if record.ref.stage == _stored_by("choose_effects"):  # looks at a few places of a scene, whatever its size
            return own
        if record.ref.stage == _stored_by(
            "locate"
        ):  # is of a path, and of no field: its own grid is that of coarse pixels
            height, width = record.params["grid"]["shape"]
            factor = own.grid.factor
            return replace(own, grid=SceneGrid(height * factor, width * factor, own.grid.patch, factor))
        grids = [store.params["grid"] for store in below if "patch" in store.params.get("grid", {})]
        coarse = captures[False].params["sweeps"]
        fine = [sweep for store in passes for sweep in store.params["sweeps"]] if passes else None
        return replace(
            own,
            grid=SceneGrid(**grids[0]) if grids else own.grid,
            camera=replace(own.camera, samples=captures[False].params["camera"]["samples"]),
            along=coarse[0]["along"],
            bands=len(open_raw_cube(min(captures[False].ref.path.glob("*.zarr"))).wavelength_nm),
            coarse_lines=_lines(coarse),
            fine_lines=None if fine is None else _lines(fine),
            fine_runs=None if fine is None else len(fine),
            plain=any(sweep["binning"] == 1 for sweep in coarse),
        )

    def _below(self, store: Store) -> list[Store]:
        stores = self._catalogue.stores
        below = self._catalogue.ancestors([store.ref.uri])
        return [store, *(stores[uri] for uri in sorted(below) if uri in stores)]


def scaled_cost(works: Sequence[float], took: Sequence[float], wanted: float) -> float:
    """What ``wanted`` takes by what one or two amounts of work took: in proportion to the first, but for the start.

    The start is where the line through both meets no work: none below 0, and at most half of what the larger one took,
    for two noisy records say little of it.
    """
    start = 0.0
    if len(works) == 2 and works[0] != works[1]:
        slope = (took[1] - took[0]) / (works[1] - works[0])
        start = min(max(took[0] - slope * works[0], 0.0), max(took) / 2)
        start = start if start < took[0] else 0.0
    return start + (took[0] - start) * wanted / works[0]


def _stored_by(stage: str) -> str:
    return STAGES[stage].product.name


def _is_fine(capture: Store) -> bool:
    """Whether a stored capture is of a fine pass, which may have no sweep at all."""
    return not any(sweep["kind"] == "coarse" for sweep in capture.params.get("sweeps", []))


def _lines(sweeps: Sequence[dict[str, Any]]) -> int:
    return sum(int(sweep["lines"]) for sweep in sweeps)
