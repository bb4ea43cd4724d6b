"""A stage of the survey as one record: its name, title and version, and what it stores.

A stage says which store it wants; the archive makes the key, finds the store, or has it built. Arrays stay inside the
stage. The record is made where the function is, in a module of `flows.tasks.stages`:

    @stage("rectify", "mosaic", MOSAIC)
    def rectify(raw, geolocation, *, frame, camera, resampling): ...

The function takes the stores that it is made of, and behind the star by name what it needs of the opened survey: an
attribute of the run, or a setting. The order of the stages stands in `flows.survey`, which calls them with the opened
survey and the stores.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flows.tasks.prefect_tasks import as_task
from models.network.machine import give_back_freed_memory
from pipeline.geometry.grid import SceneGrid
from pipeline.ground.georeference import georeference_record
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, array_digest, stage_key
from storage.arrays.layout import AngularGrid

if TYPE_CHECKING:
    from odc.geo.geobox import GeoBox

Report = Callable[[float], None]  # how far a stage is, 0..1
Build = Callable[[Path], None]


@dataclass(frozen=True)
class FieldFrame:
    """The frame of a survey's images: their pixels and bands, where they lie, and which pixels are no scene."""

    grid: SceneGrid
    ifov_rad: float
    wavelength_nm: NDArray[np.float64]  # (band,)
    fwhm_nm: NDArray[np.float64] | None
    missing: NDArray[np.bool_] | None  # (y, x) of which the scene has no value; None: of all it has
    geobox: GeoBox | None  # of the fine grid, where the scene's file says it

    @property
    def key(self) -> dict[str, Any]:
        """Return what images depend on beside what was seen: where they lie, and what is no scene."""
        gaps = {} if self.missing is None else {"missing": array_digest(self.missing)}
        return {**georeference_record(self.geobox), **gaps}

    def angular_grid(self, factor: int = 1) -> AngularGrid:
        """Return where pixels of ``factor`` fine px lie."""
        return AngularGrid(self.ifov_rad, (self.grid.height, self.grid.width), factor, self.geobox)


@dataclass(frozen=True)
class Product:
    """Product of a stage: the folder of such stores, and the version of what is written, raised when that changes."""

    name: str
    version: int
    files: tuple[str, ...] = ()  # in a store, that receipts name, by their stems
    by_weights: bool = False  # the weights are one of its parameters


@dataclass(frozen=True)
class Wanted:
    """A store that a stage wants: what it depends on, and what makes it where it is not there."""

    build: Build  # writes into the folder that it is given
    params: Mapping[str, Any]
    inputs: Sequence[StageRef] = ()
    then: Callable[[], object] = field(default=lambda: None)  # once the store is there


class Survey(Protocol):
    """An opened survey, which runs a stage of a name: in this process, or only to see what it would do."""

    def __call__(self, stage: str, /, *inputs: StageRef) -> StageRef:
        """Return the store of a stage that is made of these stores."""


@dataclass(frozen=True)
class Stage:
    """One stage. ``wants`` takes the run and the stores that it is made of, and returns what is to be stored.

    What the stage needs is taken from the run once the keys of all its stores are known.
    """

    name: str
    title: str  # on terminals and pages
    product: Product
    wants: Callable[..., Wanted]
    inputs: int | None  # of its stores, where another stage has the same product
    retries: int  # by Prefect, where a device or a disk failed
    named: str | None  # what receipts call its store, or the file in it, where another stage has the same product

    def __call__(self, survey: Survey, *inputs: StageRef | None) -> StageRef:
        """Return the stage's store, found or built; inside a Prefect flow as a task. Inputs that are None do not count.

        An OSError inside a flow is tried again ``retries`` times: a device or a disk may answer then.
        """
        run = as_task(run_stage, self.name, retries=self.retries)
        return run(survey, self.name, *(ref for ref in inputs if ref is not None))

    def addresses(self, ref: StageRef) -> dict[str, str]:
        """Return where its store lies, or the files in it, by the names in receipts: the stage's own by default."""
        if self.named is not None or not self.product.files:
            return {self.named or self.name: "/".join((ref.uri, *self.product.files))}
        return {Path(file).stem: f"{ref.uri}/{file}" for file in self.product.files}

    def key(self, wanted: Wanted) -> str:
        """The address of what is wanted: a hash of the version, the parameters and the inputs' keys."""
        return stage_key(self.product.name, self.product.version, wanted.params, [ref.key for ref in wanted.inputs])

    def find(self, archive: Archive, wanted: Wanted) -> StageRef | None:
        """The store, where the archive has it."""
        return archive.find(self.product.name, self.key(wanted))

    def produce(self, archive: Archive, wanted: Wanted) -> tuple[StageRef, bool]:
        """Find the store, or have it built; the second value says whether it was built."""
        ref, built = archive.produce(
            self.product.name,
            wanted.build,
            version=self.product.version,
            params=wanted.params,
            inputs=[ref.key for ref in wanted.inputs],
        )
        if built:
            give_back_freed_memory()
        wanted.then()
        return ref, built


def run_stage(survey: Survey, stage: str, *inputs: StageRef) -> StageRef:
    """Run a stage of a survey by its name."""
    return survey(stage, *inputs)


def stage(
    name: str, title: str, product: Product, *, inputs: int | None = None, retries: int = 0, named: str | None = None
) -> Callable[[Callable[..., Wanted]], Stage]:
    """Make a function a stage; see `Stage` for the parameters. Its module lies in `flows.tasks.stages`."""

    def record(function: Callable[..., Wanted]) -> Stage:
        """Make the record of one function."""
        needs = needs_of(function)

        @wraps(function)
        def wants(run: Any, *given: StageRef) -> Wanted:
            for ref in given:
                _ = ref.key  # where one is not known yet nothing is opened
            return function(*given, **{name: needed(run, name) for name in needs})

        return Stage(name, title, product, wants, inputs, retries, named)

    return record


def needs_of(function: Callable[..., Any]) -> list[str]:
    """Return the names behind the star of a stage's function."""
    return [one.name for one in inspect.signature(function).parameters.values() if one.kind is one.KEYWORD_ONLY]


def needed(run: Any, name: str) -> Any:
    """Return what a stage needs: the run's own attribute of that name, else the setting."""
    return getattr(run if hasattr(type(run), name) or name in vars(run) else run.settings, name)
