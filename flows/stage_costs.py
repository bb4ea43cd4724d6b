"""What stages of a survey took before, and what they would take now: scaled by how much there is to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flows.run import SurveyRun
from flows.stages import captured
from pipeline.errors import PipelineError
from storage.lineage import Catalogue
from storage.records import Store


@dataclass(frozen=True)
class Part:
    """A stage's stores in the archive, and what their cost grows with: the first unit that is known of both."""

    stage: str
    units: tuple[str, ...]
    inputs: int | None = None  # tells apart stages of one name
    by_bands: bool = True


FINE = ("fine samples", "fine seconds")
PARTS = {
    "capture_coarse": Part("capture", ("coarse samples",), 0),
    "register_coarse": Part("register", ("coarse samples",), 1),
    "locate": Part("locate", ("coarse pixels",), by_bands=False),
    "rectify": Part("rectify", ("pixels",)),
    "attend": Part("attend", ("pixels",), by_bands=False),
    "capture_fine": Part("capture", FINE, 1),
    "register_fine": Part("register", FINE, 2),
    "cut_patches": Part("patches", FINE),
    "draw_map": Part("segment", ("pixels",), by_bands=False),
    "ground": Part("ground", ("pixels",), by_bands=False),
    "evaluate": Part("evaluate", ("pixels",)),
}


class PastCosts:
    """The stores of an archive as records of what a run of these settings would cost."""

    def __init__(self, catalogue: Catalogue, run: SurveyRun) -> None:
        self._catalogue, self._run = catalogue, run
        height, width = run.grid.coarse_shape
        self._work: dict[str, float] = {
            "pixels": run.grid.height * run.grid.width,
            "coarse pixels": height * width,
            "coarse samples": run.camera.samples * sum(sweep.lines for sweep in run.plan.coarse),
            "fine seconds": run.plan.fine_s,
            "bands": len(run.scene.wavelength_nm),
        }

    def plan_fine(self, lines: int) -> None:
        """Take note of how many lines the fine pass has; before that its seconds have to do."""
        self._work["fine samples"] = self._run.camera.samples * lines

    def stored(self, stage: str) -> list[Store]:
        """Whole stores of a stage, newest first."""
        part = PARTS[stage]
        found = [
            store
            for store in self._catalogue.stores.values()
            if store.ref.stage == part.stage and store.problem is None and part.inputs in (None, len(store.inputs))
        ]
        return sorted(found, key=lambda store: store.created, reverse=True)

    def of_scene(self, store: Store) -> bool:
        """Whether a store is of the run's scene, or of none: a lookup is of a path."""
        scenes = {str(one.params["scene"]) for one in self._below(store) if "scene" in one.params}
        return scenes <= {self._run.scene.key}

    def estimate(self, stage: str) -> tuple[float | None, int | None, str]:
        """Seconds and bytes by the newest record, of this scene if there is one, and what they come from.

        The record is scaled by the stage's unit of work, and by bands where the stage reads them all. None and None
        where there is no record, or it does not tell how much work it was.
        """
        part = PARTS[stage]
        records = [store for store in self.stored(stage) if store.cost is not None and self._alike(store)]
        record = next((store for store in records if self.of_scene(store)), next(iter(records), None))
        if record is None or record.cost is None:
            return None, None, "no such store has a record of what it took"
        then = self._work_then(record)
        unit = next((unit for unit in part.units if then.get(unit) and unit in self._work), None)
        if unit is None or (part.by_bands and not then.get("bands")):
            return None, None, f"{record.ref.uri} does not tell how much work it was"
        times = self._work[unit] / then[unit] * (self._work["bands"] / then["bands"] if part.by_bands else 1)
        basis = f"{record.ref.uri} times {times:.3g}, by {unit}{' and bands' if part.by_bands else ''}"
        return record.cost.wall_s * times, round(record.cost.size * times), basis

    def _alike(self, store: Store) -> bool:
        """Controls are many times the work of judging a map alone."""
        return store.ref.stage != "evaluate" or store.params.get("controls") == self._run.settings.controls

    def _work_then(self, record: Store) -> dict[str, float]:
        try:
            return _work_of(self._below(record))
        except (KeyError, TypeError, ValueError):  # of a version with other parameters
            return {}

    def _below(self, store: Store) -> list[Store]:
        """A store and all that it rests on."""
        stores = self._catalogue.stores
        below = self._catalogue.ancestors([store.ref.uri])
        return [store, *(stores[uri] for uri in sorted(below) if uri in stores)]


def _work_of(stores: Sequence[Store]) -> dict[str, float]:
    """How much work a survey was, by unit, as far as a store and those that it rests on tell by their parameters."""
    found: dict[str, float] = {}
    for store in stores:
        params: dict[str, Any] = store.params
        grid: Mapping[str, Any] = params.get("grid", {})
        if store.ref.stage == "capture":
            name = "fine samples" if store.inputs else "coarse samples"
            found[name] = params["camera"]["samples"] * sum(sweep["lines"] for sweep in params["sweeps"])
            found |= _bands_of(store)
        if "patch" in grid:
            found["pixels"] = grid["height"] * grid["width"]
        if store.ref.stage == "locate":
            found["coarse pixels"] = grid["shape"][0] * grid["shape"][1]
        if "fine_s" in params:
            found["fine seconds"] = params["fine_s"]
    return found


def _bands_of(capture: Store) -> dict[str, float]:
    """Bands of a stored capture, if it has a sweep that can be opened."""
    try:
        cubes = captured(capture.ref)
        return {"bands": len(cubes[0].wavelength_nm)} if cubes else {}
    except (PipelineError, OSError):
        return {}
