"""What Prefect adds to a survey: a flow run of one task over the same stage on the plain engine, both in turn."""

from __future__ import annotations

import os
import socket
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bench_tiles import alone
from measure import Row

from flows.schedule.server import LocalServer
from flows.settings.survey_settings import Settings
from flows.tasks import prefect_engine as engine
from flows.tasks.prefect_engine import QUIET
from flows.tasks.run import open_run
from flows.tasks.survey import STAGES, StageRunner

ROUNDS = 11
GOAL_S = 0.3
STAGE = "choose_effects"


@dataclass(frozen=True)
class Spent:
    """Seconds of each round, and what came before the first."""

    plain_s: tuple[float, ...]
    flow_s: tuple[float, ...]
    first_s: float  # imports and a server's start until the first flow run has ended
    heartbeat: str

    @property
    def overhead_s(self) -> float:
        """Median over the rounds of what the flow run took longer. [s]"""
        return statistics.median(flow - plain for flow, plain in zip(self.flow_s, self.plain_s, strict=True))


def rows() -> list[Row]:
    """On the server of the tests, on a server that runs, and there with the heartbeat that a served run has."""
    with tempfile.TemporaryDirectory() as name:
        tested = alone(_in_harness, Path(name))
        port = _free_port()
        server = LocalServer(Path(name) / "server", port)
        before = dict(os.environ)
        os.environ.update(_settings(Path(name) / "server") | {"PREFECT_API_URL": server.url})
        try:
            server.keep_up()
            if not server.wait():
                raise RuntimeError(f"no Prefect server on port {port}")
            surveyed = alone(_on_server, Path(name), server.url)
            served = alone(_on_server, Path(name), server.url, True)
        finally:
            server.stop()
            os.environ.clear()
            os.environ.update(before)
    load = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    return [
        _row("one-task flow run over plain, tests' server", tested, load, GOAL_S),
        _row("the same by a running server, as `survey` does it", surveyed, load),
        _row("the same by a running server, as a deployment's run", served, load),
    ]


def _row(what: str, it: Spent, load: str, goal_s: float | None = None) -> Row:
    counted = (
        f"flow run from its call to its return, with its one task, less the same stored stage called plainly: median "
        f"of {len(it.flow_s)} rounds in turn, {min(it.flow_s):.2f} to {max(it.flow_s):.2f} s, plain "
        f"{statistics.median(it.plain_s):.3f} s; heartbeat {it.heartbeat}; not counted, once a process: "
        f"{it.first_s:.1f} s until the first had ended; {load}"
    )
    goal = "" if goal_s is None else f"<= {goal_s} s"
    met = None if goal_s is None else it.overhead_s <= goal_s
    return Row(what, f"{it.overhead_s:.2f} s", goal, met, counted)


def _in_harness(folder: Path) -> Spent:
    """Everything in one process, as the tests have it: the harness, no heartbeat."""
    os.environ.update(_settings(folder / "harness"))
    begun = time.perf_counter()
    from prefect.testing.utilities import prefect_test_harness

    return _in_turn(folder / "tested", begun, partial(prefect_test_harness, server_startup_timeout=120))


def _on_server(folder: Path, url: str, heartbeat: bool = False) -> Spent:
    """A client of a server that runs; with the heartbeat, as Prefect's runner starts a deployment's flow."""
    os.environ.update(_settings(folder / "client") | {"PREFECT_API_URL": url})
    return _in_turn(folder / f"{heartbeat}", time.perf_counter(), nullcontext, heartbeat=heartbeat)


def _in_turn(
    archive: Path, begun: float, harness: Callable[[], AbstractContextManager[Any]], *, heartbeat: bool = False
) -> Spent:
    """The flow of our engine with a survey of one stage that is stored, and the same stage called plainly."""
    runner = StageRunner(open_run(Settings(scene="farm", size=(64, 64), out=str(archive))))
    _one_stage(runner)  # stored from here on: what is timed is the way to it
    setattr(engine, "survey", _one_stage)  # noqa: B010 - of another signature than a whole survey
    run_flow = engine._run_flow if heartbeat else engine.survey_with_prefect
    plain, flow = [], []
    with harness():
        run_flow(runner)
        first = time.perf_counter() - begun
        from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY

        often = f"every {PREFECT_FLOWS_HEARTBEAT_FREQUENCY.value()} s" if heartbeat else "off"
        for _ in range(ROUNDS):
            plain.append(_seconds(lambda: _one_stage(runner)))
            flow.append(_seconds(lambda: run_flow(runner)))
    return Spent(tuple(plain), tuple(flow), first, often)


def _one_stage(step: Callable[[str], object], rounds: int = 1) -> object:
    assert STAGE in STAGES
    return step(STAGE)


def _seconds(call: Callable[[], object]) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


def _settings(home: Path) -> dict[str, str]:
    return {**QUIET, "PREFECT_HOME": str(home)}


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
