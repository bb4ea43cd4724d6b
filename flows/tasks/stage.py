"""Define a survey stage: name, inputs, outputs, store key and description.

A stage function returns the store that it wants; the archive computes its key, finds it, or has it built. Arrays stay
inside the stage. The decorator of the function, in a module of `flows.tasks.stages`, holds name, title and product:

    @stage("rectify", "mosaic", MOSAIC)
    def rectify(raw, geolocation, *, frame, camera, resampling): ...

Positional arguments are its input stores. Keyword arguments are attributes of the opened survey, or settings.
`flows.survey` calls the stages in order, with the opened survey and the stores.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from spectralzoom.flows.tasks.prefect_tasks import as_task
from spectralzoom.models.network.machine import give_back_freed_memory
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.ground.georeference import georeference_record
from spectralzoom.storage.arrays.georeference import AngularGrid
from spectralzoom.storage.arrays.layout import consolidate_stores
from spectralzoom.storage.store import Archive, Ref, array_digest, stage_key

Report = Callable[[float], None]  # progress of a stage, 0..1


@dataclass(frozen=True)
class FieldFrame:
    """Frame of the images of a survey: pixels, bands, georeference and nodata."""

    grid: SceneGrid
    ifov_rad: float
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None
    missing: NDArray[np.bool_] | None  # (y, x) nodata; None: no pixel
    geobox: GeoBox | None  # of the fine grid; None: no georeference

    @property
    def key(self) -> dict[str, Any]:
        """Return the parameters of images besides their inputs: georeference and nodata."""
        gaps = {} if self.missing is None else {"missing": array_digest(self.missing)}
        return {**georeference_record(self.geobox), **gaps}

    def angular_grid(self) -> AngularGrid:
        """Return the grid of the scene's pixels."""
        return AngularGrid(self.ifov_rad, (self.grid.height, self.grid.width), geobox=self.geobox)


@dataclass(frozen=True)
class Product:
    """Product of a stage: the folder of its stores, and a version that is raised when their content changes."""

    name: str
    version: int
    files: tuple[str, ...] = ()  # of a store, named in receipts by their stems
    by_weights: bool = False  # whether it depends on the weights


@dataclass(frozen=True)
class Wanted:
    """Request for a store: its parameters and inputs, and the function that builds it."""

    build: Callable[[Path], None]  # writes into a given folder
    params: Mapping[str, Any]
    inputs: Sequence[Ref] = ()
    then: Callable[[], object] = field(default=lambda: None)  # called once the store exists
    shown: bool = True  # on terminals; False if there is nothing to decide or compute


@dataclass(frozen=True)
class Stage:
    """One stage; ``wants`` takes the run and the input stores, and returns the request for its store."""

    name: str
    title: str  # for terminals and reports
    product: Product
    wants: Callable[..., Wanted]
    inputs: int | None  # number of inputs, where another stage has the same product
    retries: int  # by Prefect, after an OSError
    named: str | None  # name in receipts, where another stage has the same product

    def __call__(self, survey: Callable[..., Ref], *inputs: Ref | None) -> Ref:
        """Return the store of the stage, from the archive or built; a task inside a Prefect flow.

        Inputs that are None are ignored. Inside a flow, an OSError is retried ``retries`` times.
        """
        run = as_task(run_stage, self.name, retries=self.retries)
        return run(survey, self.name, *(ref for ref in inputs if ref is not None))

    def addresses(self, ref: Ref) -> dict[str, str]:
        """Return the addresses of its store, or of the files in it, by their names in receipts."""
        if self.named is not None or not self.product.files:
            return {self.named or self.name: "/".join((ref.uri, *self.product.files))}
        return {Path(file).stem: f"{ref.uri}/{file}" for file in self.product.files}

    def key(self, wanted: Wanted) -> str:
        """Return the key of a request: a hash of version, parameters and the keys of the inputs."""
        return stage_key(self.product.name, self.product.version, wanted.params, wanted.inputs)

    def find(self, archive: Archive, wanted: Wanted) -> Ref | None:
        """Return the requested store; None where the archive lacks it."""
        return archive.find(self.product.name, self.key(wanted))

    def produce(self, archive: Archive, wanted: Wanted) -> tuple[Ref, bool]:
        """Find or build the requested store; return it, and whether it was built.

        Raises ArchiveError: another survey has cleared an input meanwhile.
        """

        def build(folder: Path) -> None:
            wanted.build(folder)
            consolidate_stores(folder)

        ref, built = archive.produce(
            self.product.name, build, version=self.product.version, params=wanted.params, inputs=wanted.inputs
        )
        if built:
            give_back_freed_memory()
        wanted.then()
        return ref, built


def run_stage(survey: Callable[..., Ref], stage: str, *inputs: Ref) -> Ref:
    """Run a stage of a survey by name."""
    return survey(stage, *inputs)


def stage(
    name: str, title: str, product: Product, *, inputs: int | None = None, retries: int = 0, named: str | None = None
) -> Callable[[Callable[..., Wanted]], Stage]:
    """Return a decorator that makes a function of `flows.tasks.stages` a stage; see `Stage` for the parameters."""

    def record(function: Callable[..., Wanted]) -> Stage:
        """Return the stage of a function."""
        needs = inspect.getfullargspec(function).kwonlyargs

        @wraps(function)
        def wants(run: Any, *stores: Ref) -> Wanted:
            for ref in stores:
                _ = ref.key  # raises an error in a plan, where inputs are not known yet
            return function(*stores, **{name: needed(run, name) for name in needs})

        return Stage(name, title, product, wants, inputs, retries, named)

    return record


def needed(run: Any, name: str) -> Any:
    """Return the attribute of the run, else the setting, with this name."""
    return getattr(run if hasattr(type(run), name) or name in vars(run) else run.settings, name)
