"""A stage of the survey as one record: its name, title and version, and what it stores.

A stage says which store it wants; the archive makes the key, finds the store, or has it built. Arrays stay inside the
stage. The record is made where the function is, in a module of `flows.tasks.stages`:

    @stage("rectify", "mosaic", MOSAIC)
    def rectify(run, raw, geolocation grid): ...

The order of the stages stands in `flows.survey`, which calls them with the opened survey and with the stores that
they are made of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from flows.tasks.prefect_tasks import as_task
from storage.archive.archive import Archive
from storage.archive.keys import StageRef, stage_key

Build = Callable[[Path], None]


@dataclass(frozen=True)
class Product:
    """What a stage stores: the folder of such stores, and the version of what is written, raised when that changes."""

    name: str
    version: int
    files: tuple[str, ...] = ()  # in a store, that receipts name, by their stems
    by_weights: bool = False  # the weights are one of its parameters
    made_again: bool = False  # large, and soon made of what stays: `gc` may clear its files away


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
    """One stage. ``wants`` takes the run and the stores that it is made of, and returns what is to be stored."""

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
        """Where its store lies, or the files in it, by the names in receipts: the stage's own by default."""
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
        wanted.then()
        return ref, built


def run_stage(survey: Survey, stage: str, *inputs: StageRef) -> StageRef:
    """Run a stage of a survey by its name."""
    return survey(stage, *inputs)


def stage(
    name: str, title: str, product: Product, *, inputs: int | None = None, retries: int = 0, named: str | None = None
) -> Callable[[Callable[..., Wanted]], Stage]:
    """Make a function a stage; see `Stage` for the parameters. Its module lies in `flows.tasks.stages`."""

    def record(wants: Callable[..., Wanted]) -> Stage:
        return Stage(name, title, product, wants, inputs, retries, named)

    return record
