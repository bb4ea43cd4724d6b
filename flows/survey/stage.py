"""A stage of the survey as one record: what the survey, plans, engines, histories and documents say of it stands here.

A stage tells what it wants stored; the archive makes the key of that, finds the store, or has it built. Arrays stay
inside the stage. Its record is made where its function is, in a module of `flows.survey.stages`:

    @stage("rectify", "mosaic", MOSAIC, of=("capture_coarse", "locate"), unit="mosaic values")
    def rectify(run, raw, lookup): ...
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Literal

from storage.archive.archive import Archive
from storage.archive.keys import StageRef, stage_key

Build = Callable[[Path], None]
Unit = Literal[
    "pixels",
    "coarse pixels",
    "scene values",
    "mosaic values",
    "coarse values",
    "fine values",
    "patch values",
    "operations of the map",
    "operations of a glance",
    "surveys",
]


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


@dataclass(frozen=True)
class Stage:
    """One stage. Called with the run and the stores of ``of``, it tells what it wants: None where there is nothing."""

    name: str
    title: str  # on terminals and pages
    product: Product
    wants: Callable[..., Wanted | None]
    of: tuple[str, ...]  # stages whose stores it is given; those that had nothing to do are left out
    unit: Unit  # of work: what its seconds grow with
    size: Unit | None  # what its bytes grow with, where that is another
    after: tuple[str, ...]  # stages that nobody is to wait for it before
    inputs: int | None  # of its stores, where another stage has the same product
    retries: int  # by Prefect, where a device or a disk failed
    judges: bool  # no part of the survey and of its cost: runs once the map is published
    named: str | None  # what receipts call its store, or the file in it, where another stage has the same product

    def __call__(self, *args: Any) -> Wanted | None:
        """What the stage wants stored, for a run and the stores that it is made of."""
        return self.wants(*args)

    def needed(self, *args: Any) -> Wanted:
        """What a stage wants that always has something to do."""
        wanted = self.wants(*args)
        assert wanted is not None, self.name
        return wanted

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


def stage(
    name: str,
    title: str,
    product: Product,
    *,
    unit: Unit,
    of: tuple[str, ...] = (),
    size: Unit | None = None,
    after: tuple[str, ...] = (),
    inputs: int | None = None,
    retries: int = 0,
    judges: bool = False,
    named: str | None = None,
) -> Callable[[Callable[..., Wanted | None]], Stage]:
    """Make a function a stage; see `Stage` for what is said of it. Its module lies in `flows.survey.stages`."""

    def record(wants: Callable[..., Wanted | None]) -> Stage:
        return Stage(name, title, product, wants, of, unit, size, after, inputs, retries, judges, named)

    return record


@cache
def all_stages() -> dict[str, Stage]:
    """Every stage by its name, each after those that it is made of: all that modules of `flows.survey.stages` hold."""
    folder = import_module("flows.survey.stages")
    modules = [import_module(f"{folder.__name__}.{found.name}") for found in iter_modules(folder.__path__)]
    found = {one.name: one for module in modules for one in vars(module).values() if isinstance(one, Stage)}
    order = TopologicalSorter({one.name: (*one.of, *one.after) for one in found.values()}).static_order()
    return {name: found[name] for name in order}


def versions() -> dict[str, int]:
    """The present version of every product."""
    return {one.product.name: one.product.version for one in all_stages().values()}


def versions_made_again() -> dict[str, int]:
    """The present version of every product whose files may be cleared away, since they are soon made again."""
    return {one.product.name: one.product.version for one in all_stages().values() if one.product.made_again}
