"""A stage: a function that writes one store. Its input stores and its keyword arguments are the key of that store.

    @stage("mosaic", version=8)
    def rectify(out: Output, signal: Ref, *, frame: FieldFrame, kernel: Kernel, pool: Unkeyed[WorkerPool]) -> None: ...

    mosaic = rectify(stores, signal, frame=field.frame, kernel="catmull-rom", pool=plan.pool)  # -> Ref

In a flow each call is a Prefect task of the stage's name; elsewhere it is a plain call. Arguments that change no byte
are annotated `Unkeyed`. The stores of a dry run make nothing: they answer with the addresses that stores would have.

A stage that cannot serve every field says so by ``lacks``, a function of the same keywords. It returns why, or an empty
text. The stage is then left out with that reason, in plan and receipt, and so are stages that take its store.
"""

from __future__ import annotations

import inspect
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Concatenate, Generic, Literal, ParamSpec, TypeVar, get_args, get_type_hints

from spectralzoom.pipeline.errors import PipelineError
from spectralzoom.storage.store import Archive, Ref, is_cleared, listed_bytes, read_manifest, stage_key
from spectralzoom.storage.whole_files import bytes_in

T = TypeVar("T")
P = ParamSpec("P")
Report = Callable[[float], None]  # progress, 0..1
_NOT_IN_THE_KEY = "not in the key"
Unkeyed = Annotated[T, _NOT_IN_THE_KEY]
RETRY_DELAY_S = 2.0


@dataclass(frozen=True)
class Output:
    """Folder of a store that a stage writes, and the progress of the stage."""

    path: Path  # a folder to write into
    report: Report
    spool: Path  # a folder, not made yet, that outlives a killed process; removed once the store is published
    note: Callable[[str], None] = lambda text: None  # assumptions, for the terminal
    facts: dict[str, float] = field(default_factory=dict)  # about this run, for its receipt: not in the store


@dataclass(frozen=True)
class Stage(Generic[P]):
    """One stage. ``version`` is raised when the same arguments give other bytes."""

    build: Callable[Concatenate[Output, P], None]
    title: str  # for terminals and reports
    version: int
    product: str  # folder of its stores; two stages may share one
    retries: int  # by Prefect, after an OSError
    made_by: tuple[str, ...]  # folders and files whose code determines its bytes
    lacks: Callable[..., str] = lambda **facts: ""  # returns why these arguments allow no store

    @property
    def name(self) -> str:
        """Return the name of the function."""
        return self.build.__name__

    def __call__(self, stores: Stores, *args: P.args, **facts: P.kwargs) -> Ref:
        """Return the store of these arguments, found or made; a task inside a Prefect flow. Raises as `build`."""
        call = inspect.signature(self.build).bind(None, *args, **facts)
        call.apply_defaults()
        inputs = [ref for ref in call.args[1:] if ref is not None]
        if not all(isinstance(ref, Ref) for ref in inputs):
            raise TypeError(f"{self.name}: arguments that are no stores must be keywords, to be part of the key")
        hints = get_type_hints(self.build, include_extras=True)
        params = {
            name: one for name, one in call.kwargs.items() if _NOT_IN_THE_KEY not in get_args(hints.get(name))[1:]
        }
        request = Request(self, inputs, params, lambda out: self.build(out, *args, **facts), self.lacks(**call.kwargs))
        return task_in_flow(self.name, stores.name, partial(stores.get, request), *inputs, retries=self.retries)


def stage(
    title: str,
    *,
    version: int,
    product: str | None = None,
    retries: int = 0,
    made_by: Sequence[str] = (),
    lacks: Callable[..., str] = lambda **facts: "",
) -> Callable[[Callable[Concatenate[Output, P], None]], Stage[P]]:
    """Return a decorator that makes a function a `Stage`."""
    return lambda build: Stage(build, title, version, product or build.__name__, retries, tuple(made_by), lacks)


def inside_flow() -> bool:
    """Return whether a Prefect flow is running."""
    if "prefect.context" not in sys.modules:
        return False
    from prefect.context import FlowRunContext

    return FlowRunContext.get() is not None


def task_in_flow(name: str, of: str, work: Callable[..., T], *inputs: Ref, retries: int = 0) -> T:
    """Call ``work``; inside a flow as a task that is named ``name``-``of``, with the edges of its inputs."""
    if not inside_flow():
        return work(*inputs)
    from prefect.utilities.annotations import quote

    made: T = _task(name, of, retries)(quote(work), *inputs)
    return made


@cache
def _task(name: str, of: str, retries: int) -> Any:
    import prefect
    from prefect.cache_policies import NO_CACHE

    @prefect.task(
        name=name,
        task_run_name=f"{name}-{of}",
        cache_policy=NO_CACHE,  # the archive finds stores by their content
        persist_result=False,
        retries=retries,
        retry_delay_seconds=RETRY_DELAY_S,
        retry_condition_fn=lambda task, run, state: isinstance(state.result(raise_on_failure=False), OSError),
    )
    def run(work: Callable[..., Any], *inputs: Ref) -> Any:
        return work(*inputs)

    return run


@dataclass(frozen=True)
class Request:
    """A call of a stage: its input stores, its keyed arguments, and what writes the store."""

    stage: Stage[Any]
    inputs: Sequence[Ref]
    params: Mapping[str, Any]
    build: Callable[[Output], None]
    lack: str = ""  # why there can be no store


@dataclass(frozen=True)
class Row:
    """Outcome of one stage; figures of a store that was found are None."""

    name: str
    title: str
    ref: Ref  # in a dry run without a key where that depends on the content of a store that is missing
    state: Literal["ran", "cached", "to run", "blocked", "left out"]
    why: str = ""  # a stage is blocked or left out
    version: int = 0
    params: Mapping[str, Any] = field(default_factory=dict)
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_rss_bytes: int | None = None
    bytes_in: int | None = None
    bytes_out: int | None = None
    facts: Mapping[str, float] = field(default_factory=dict)  # of `Output`


class Stores:
    """The stores of one survey: each is found in the archive or made, and recorded. A dry run makes none.

    A store whose files were cleared away is made again only when something has to be made of it.
    """

    def __init__(
        self,
        archive: Archive,
        *,
        name: str = "",  # of the survey, for names of Prefect's tasks
        dry: bool = False,
        watch: Callable[[str, str, str, float], None] = lambda *_: None,  # name, title, state and progress (0..1)
        log: Callable[[str], None] = lambda text: None,
        note: Callable[[str], None] = lambda text: None,
        finish: Callable[[Path], None] = lambda folder: None,  # called with the folder of each store that was built
    ) -> None:
        self.archive = archive
        self.name = name
        self.dry = dry
        self.rows: dict[str, Row] = {}
        self.bytes_written = 0
        self._watch, self._log, self._note, self._finish = watch, log, note, finish
        self._cleared: dict[Ref, Callable[[], object]] = {}  # makes each again
        self._left_out: dict[Ref, str] = {}  # with titles of the stages

    @property
    def refs(self) -> list[Ref]:
        """Return the stores of all stages that have one."""
        return [row.ref for row in self.rows.values() if row.state != "left out"]

    def total(self, fact: str) -> float:
        """Return the sum of a fact of the stages that ran."""
        return sum(row.facts.get(fact, 0.0) for row in self.rows.values())

    def has(self, ref: Ref) -> bool:
        """Return whether a store has its files; in a dry run some have not been made."""
        return bool(ref.key) and self.archive.is_there(ref.uri)

    def get(self, request: Request, *_: Ref) -> Ref:
        """Return the store of a request, found or made. In a dry run its address; without a key where that is open.

        A stage that is left out has an address without a key too.
        """
        made = request.stage
        without = [self._left_out[ref] for ref in request.inputs if ref in self._left_out]
        if request.lack or without:
            return self._leave_out(made, request.lack or f"it needs what is left out: {without[0]}")
        if not all(ref.key for ref in request.inputs):
            return self._make(request, Ref(made.product, "", Path()))
        key = stage_key(made.product, made.version, request.params, request.inputs)
        ref = self.archive.ref(made.product, key)
        try:
            found = self.archive.find(ref.stage, ref.key) is not None
        except (PipelineError, OSError) as error:
            if not self.dry:
                raise
            return self._record(replace(self._row(request, replace(ref, key="")), state="blocked", why=str(error)))
        if not found and is_cleared(ref.path):
            self._cleared[ref] = partial(self._make, request, ref)
            found = True
        return self._record(self._row(request, ref)) if found else self._make(request, ref)

    def _leave_out(self, made: Stage[Any], why: str) -> Ref:
        """Record that a stage cannot serve this field."""
        ref = Ref(f"no {made.name}", "", Path())
        self._left_out[ref] = made.title
        self._note(f"{made.title} is left out: {why}")
        return self._record(Row(made.name, made.title, ref, "left out", why, made.version))

    def restore(self, ref: Ref) -> None:
        """Make a store again if its files were cleared away."""
        if ref in self._cleared:
            self._cleared[ref]()
            del self._cleared[ref]

    def _make(self, request: Request, ref: Ref) -> Ref:
        """Make a store, after those of its inputs that were cleared away; in a dry run record that it would be made."""
        for one in request.inputs:
            self.restore(one)
        if self.dry:
            return self._record(replace(self._row(request, ref), state="to run"))
        with suppress(OSError):  # Linux: reset the peak
            Path("/proc/self/clear_refs").write_text("5")
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        facts: dict[str, float] = {}
        try:
            built = self._build(request, ref, facts)
        except BaseException:
            self._watch(request.stage.name, request.stage.title, "failed", 0.0)
            raise
        row = self._row(request, ref)
        if built:  # else another process has made it meanwhile
            wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
            row = replace(row, state="ran", wall_s=wall_s, cpu_s=cpu_s, peak_rss_bytes=peak_bytes(), facts=facts)
        return self._record(row)

    def _build(self, request: Request, ref: Ref, facts: dict[str, float]) -> bool:
        made = request.stage
        spool = self.archive.root / "spool" / ref.key
        report = partial(self._watch, made.name, made.title, "running")
        report(0.0)

        def build(folder: Path) -> None:
            request.build(Output(folder, report, spool, self._note, facts))
            self._finish(folder)
            self.bytes_written += bytes_in(spool)

        _, built = self.archive.produce(
            made.product, build, version=made.version, params=request.params, inputs=request.inputs
        )
        self.bytes_written += self.archive.size_of(ref.uri) if built else 0
        return built

    def _row(self, request: Request, ref: Ref) -> Row:
        """Return the row of a store that was found."""
        made = request.stage
        row = Row(made.name, made.title, ref, "cached", version=made.version, params=request.params)
        if self.dry:
            return row
        sizes = [listed_bytes(read_manifest(one.path)) for one in (*request.inputs, ref)]
        return replace(row, bytes_in=sum(sizes[:-1]), bytes_out=sizes[-1])

    def _record(self, row: Row) -> Ref:
        """Record and report what became of a stage; a second store of one stage has a row of its own."""
        name, number = row.name, 1
        while name in self.rows and self.rows[name].ref != row.ref:
            number += 1
            name = f"{row.name}-{number}"
        self.rows[name] = replace(row, name=name)
        self._watch(row.name, row.title, row.state, 1.0)
        if row.state == "left out":
            return row.ref
        took = "found" if row.wall_s is None else f"{row.wall_s:.1f} s"
        self._log(f"{row.title}: {took}, {(row.bytes_out or 0) / 1e6:.1f} MB, {row.ref.uri}")
        return row.ref


def peak_bytes() -> int:
    """Return the peak resident memory of this process [bytes]."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
