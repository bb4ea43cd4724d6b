"""A stage: a function that writes one store. Its input stores and its keyword arguments are the key of that store.

    @stage("mosaic", version=8)
    def rectify(out: Output, signal: Ref, *, frame: FieldFrame, kernel: Kernel, pool: Unkeyed[WorkerPool]) -> None: ...

    mosaic = rectify(stores, signal, frame=field.frame, kernel="catmull-rom", pool=settings.pool)  # -> Ref

In a flow each call is a Prefect task of the stage's name; elsewhere it is a plain call. Arguments that change no byte
are annotated `Unkeyed`. The stores of a dry run make nothing: they answer with the addresses that stores would have.
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
from spectralzoom.storage.store import Archive, Ref
from spectralzoom.storage.whole_files import bytes_in

T = TypeVar("T")
P = ParamSpec("P")
Report = Callable[[float], None]  # progress, 0..1
_NOT_IN_THE_KEY = "not in the key"
Unkeyed = Annotated[T, _NOT_IN_THE_KEY]
RETRY_DELAY_S = 2.0


@dataclass(frozen=True)
class Output:
    """What a stage writes: the folder of its store, and its progress."""

    path: Path  # a folder to write into
    report: Report
    spool: Path  # a folder, not made yet, that outlives a killed process; removed once the store is published


@dataclass(frozen=True)
class Stage(Generic[P]):
    """One stage. ``version`` is raised when the same arguments give other bytes."""

    build: Callable[Concatenate[Output, P], None]
    title: str  # for terminals and reports
    version: int
    product: str  # folder of its stores; two stages may share one
    retries: int  # by Prefect, after an OSError
    made_by: tuple[str, ...]  # folders and files whose code determines its bytes

    @property
    def name(self) -> str:
        """Return the name of the function."""
        return self.build.__name__

    def __call__(self, stores: Stores, *args: P.args, **facts: P.kwargs) -> Ref:
        """Return the store of these arguments, found or made; a task inside a Prefect flow. Raises as `build`."""
        call = inspect.signature(self.build).bind(None, *args, **facts)
        call.apply_defaults()
        every = dict(list(call.arguments.items())[1:])
        given = [ref for value in every.values() for ref in (value if isinstance(value, tuple) else (value,))]
        inputs = [ref for ref in given if isinstance(ref, Ref)]
        left_out = unkeyed_names(self.build)
        named = (name for name, one in call.signature.parameters.items() if one.kind is one.KEYWORD_ONLY)
        params = {name: every[name] for name in named if name not in left_out}
        request = Request(self, inputs, params, lambda out: self.build(out, *args, **facts))
        return task_in_flow(self.name, stores.name, partial(stores.get, request), *inputs, retries=self.retries)


@cache
def unkeyed_names(build: Callable[..., None]) -> frozenset[str]:
    """Return the arguments of a stage's function that are annotated `Unkeyed`."""
    hints = get_type_hints(build, include_extras=True)
    return frozenset(name for name, hint in hints.items() if _NOT_IN_THE_KEY in get_args(hint)[1:])


def stage(
    title: str, *, version: int, product: str | None = None, retries: int = 0, made_by: Sequence[str] = ()
) -> Callable[[Callable[Concatenate[Output, P], None]], Stage[P]]:
    """Return a decorator that makes a function a `Stage`."""
    return lambda build: Stage(build, title, version, product or build.__name__, retries, tuple(made_by))


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


@dataclass(frozen=True)
class Row:
    """What became of one stage; figures of a store that was found are None."""

    name: str
    ref: Ref  # in a dry run without a key where an input is missing
    state: Literal["ran", "cached", "to run", "blocked"]
    why: str = ""  # a stage is blocked
    version: int = 0
    params: Mapping[str, Any] = field(default_factory=dict)  # of a dry run
    wall_s: float | None = None
    cpu_s: float | None = None
    peak_rss_bytes: int | None = None
    bytes_in: int | None = None
    bytes_out: int | None = None


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
        finish: Callable[[Path], None] = lambda folder: None,  # called with the folder of each store that was built
    ) -> None:
        self.archive = archive
        self.name = name
        self.dry = dry
        self.rows: dict[str, Row] = {}
        self.bytes_written = 0
        self._watch, self._log, self._finish = watch, log, finish
        self._cleared: dict[Ref, Callable[[], object]] = {}  # makes each again

    @property
    def refs(self) -> list[Ref]:
        """Return the stores of all stages."""
        return [row.ref for row in self.rows.values()]

    def has(self, ref: Ref) -> bool:
        """Return whether a store has its files; in a dry run some have not been made."""
        return bool(ref.key) and self.archive.is_there(ref.uri)

    def get(self, request: Request, *_: Ref) -> Ref:
        """Return the store of a request, found or made."""
        return self._foreseen(request) if self.dry else self._recorded(request, self._found_or_made)

    def restore(self, ref: Ref) -> None:
        """Make a store again if its files were cleared away."""
        again = self._cleared.pop(ref, None)
        if again is not None:
            again()

    def _key(self, request: Request) -> str:
        made = request.stage
        return self.archive.key(made.product, made.version, request.params, request.inputs)

    def _found_or_made(self, request: Request) -> tuple[Ref, bool]:
        key = self._key(request)
        ref = self.archive.ref(request.stage.product, key)
        if self.archive.find(ref.stage, key) is not None:
            return ref, False
        if self.archive.is_known(ref):
            self._cleared[ref] = partial(self._recorded, request, self._made)
            return ref, False
        return self._made(request)

    def _made(self, request: Request) -> tuple[Ref, bool]:
        made = request.stage
        spool = self.archive.root / "spool" / self._key(request)
        for ref in request.inputs:
            self.restore(ref)

        def build(folder: Path) -> None:
            request.build(Output(folder, partial(self._watch, made.name, made.title, "running"), spool))
            self._finish(folder)
            self.bytes_written += bytes_in(spool)

        ref, built = self.archive.produce(
            made.product, build, version=made.version, params=request.params, inputs=request.inputs
        )
        self.bytes_written += self.archive.size_of(ref.uri) if built else 0
        return ref, built

    def _recorded(self, request: Request, get: Callable[[Request], tuple[Ref, bool]]) -> Ref:
        """Return the store that ``get`` finds or makes, and record time and memory of its making."""
        name, title = request.stage.name, request.stage.title
        with suppress(OSError):  # Linux: reset the peak
            Path("/proc/self/clear_refs").write_text("5")
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        self._watch(name, title, "running", 0.0)
        try:
            ref, built = get(request)
        except BaseException:
            self._watch(name, title, "failed", 0.0)
            raise
        spent_s = time.perf_counter() - wall_s
        size = self.archive.stored_bytes(ref)
        row = Row(name, ref, "cached")
        row = replace(row, bytes_in=sum(map(self.archive.stored_bytes, request.inputs)), bytes_out=size)
        if built:
            cpu_s = time.process_time() - cpu_s
            row = replace(row, state="ran", wall_s=spent_s, cpu_s=cpu_s, peak_rss_bytes=peak_bytes())
        self.rows[row.name] = row
        self._watch(name, title, row.state, 1.0)
        self._log(f"{title}: {f'{spent_s:.1f} s' if built else 'found'}, {size / 1e6:.1f} MB, {ref.uri}")
        return ref

    def _foreseen(self, request: Request) -> Ref:
        """Return the address that a store would have, without a key where one of its inputs is missing."""
        made = request.stage
        row = Row(made.name, Ref(made.product, "", Path()), "to run", version=made.version, params=request.params)
        if all(ref.key and self.archive.is_known(ref) for ref in request.inputs):
            try:
                ref = self.archive.ref(made.product, self._key(request))
                there = self.archive.find(ref.stage, ref.key) is not None
                if not there and self.archive.is_known(ref):
                    self._cleared[ref] = partial(self._would_run, replace(row, ref=ref), request)
                    there = True
                row = replace(row, ref=ref, state="cached" if there else "to run")
            except (PipelineError, OSError) as error:  # the survey would stop here
                row = replace(row, state="blocked", why=str(error))
        if row.state == "to run":
            self._would_run(row, request)
        else:
            self.rows[made.name] = row
        return row.ref

    def _would_run(self, row: Row, request: Request) -> None:
        """Record in a dry run that a store would be made, and so its inputs that were cleared away."""
        for ref in request.inputs:
            self.restore(ref)
        self.rows[row.name] = row


def peak_bytes() -> int:
    """Return the peak resident memory of this process [bytes]."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
