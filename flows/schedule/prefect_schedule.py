"""Schedules on Prefect: a server, its runner and a watcher, kept up until the schedule is stopped.

Prefect starts the runs and shows them; what is due, and what became of it, the ledgers say.
"""

from __future__ import annotations

import time
from contextlib import suppress

from flows.schedule.due_runs import Tell
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.runner import RunnerProcess
from flows.schedule.served import ServeRequest, write_served
from flows.schedule.server import LocalServer, pages_of, server_for
from flows.schedule.times import SystemWallClock
from flows.schedule.watcher import Watcher
from pipeline.errors import PipelineError

WATCH_S, SOON_S = 15.0, 2.0


def serve_prefect(request: ServeRequest, tell: Tell) -> None:
    """Serve until interrupted.

    Raises
    ------
    PipelineError : no server, or a ledger cannot be written at the start; what was opened until then is closed.
    """
    schedules, home = request.schedules(), request.fields[0].archive / ".prefect"
    log = home / "surveys.log"
    with server_for(home, request.port) as server:
        served = home / "served.json"
        write_served(request, served)
        watcher, runner = Watcher(request, schedules, tell), RunnerProcess(served, log)
        opened: list[FieldSchedule] = []
        try:
            for schedule in schedules.values():
                opened.append(schedule)
                schedule.open()
            tell(request.headline)
            tell(f"Prefect's pages: {pages_of(server)}; what surveys say: {log}")
            watcher.prepare()
            runner.keep_up()
            while True:
                _keep_up(server, runner, tell)
                ready = watcher.look()
                watcher.tell_news()
                if watcher.unheard():
                    tell("runs that were asked for do not begin: Prefect's runner is started again")
                    runner.restart()
                time.sleep(WATCH_S if ready else SOON_S)
        finally:
            stopped = SystemWallClock().now()
            tell("stopping; what is under way is interrupted, and resumed when it is served again")
            runner.stop()
            watcher.stop()
            for schedule in opened:
                with suppress(PipelineError):
                    schedule.close(stopped)
            watcher.tell_news()


def _keep_up(server: LocalServer | None, runner: RunnerProcess, tell: Tell) -> None:
    """Start again what has ended; a runner whose server was away does not find it again by itself."""
    if server is not None and server.keep_up():
        tell("the Prefect server had ended and is started again")
        server.wait()
        runner.restart()
    elif runner.keep_up():
        tell(f"Prefect's runner had ended and is started again; {runner.log} may say why")
