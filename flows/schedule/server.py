"""Schedules on Prefect: a server, its runner and a watcher, kept up until the schedule is stopped.

The server is the one that PREFECT_API_URL names, or one of our own on this machine. Prefect starts the runs and shows
them; what is due, and what became of it, the ledgers say.
"""

from __future__ import annotations

import os
import secrets
import socket
import stat
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPException
from pathlib import Path

from flows.schedule.due_runs import Tell
from flows.schedule.field_schedule import FieldSchedule
from flows.schedule.guarded_server import HOST, own_origins
from flows.schedule.served import NAMED_BY, ServeRequest, write_served
from flows.schedule.times import SystemWallClock
from flows.schedule.watcher import Watcher
from flows.tasks.prefect_engine import QUIET
from flows.terminal.processes import KeptProcess, place_pages
from pipeline.errors import PipelineError, SettingsError

STARTED_WITHIN_S = 600.0  # on a busy machine; one that has ended is not waited for
ENDS_WITHIN_S, RUNNER_ENDS_WITHIN_S = 10.0, 15.0
WATCH_S, SOON_S = 15.0, 2.0  # between looks; until Prefect knows of all fields
PATIENCE_S = 10.0  # with a server that is named
NO_ANSWER = (OSError, ValueError, HTTPException)  # also of what speaks another protocol
POLL_S = "2"  # how often Prefect looks for due runs; by its own default the next field waits up to 10 s


class LocalServer(KeptProcess):
    """A server process with its files in a folder; started again where it has died."""

    def __init__(self, home: Path, port: int) -> None:
        self.url, self.password_file = f"http://{HOST}:{port}/api", home / "password"
        super().__init__(
            [sys.executable, "-m", "flows.schedule.guarded_server", str(port)], home / "server.log", ENDS_WITHIN_S
        )

    def wait(self) -> bool:
        """Wait until it answers; False where it has not within ten minutes, or has ended."""
        end = time.monotonic() + STARTED_WITHIN_S
        while time.monotonic() < end:
            with suppress(*NO_ANSWER), urllib.request.urlopen(f"{self.url}/health", timeout=2) as answer:
                if answer.status == 200:
                    return True
            if not self.runs():
                return False
            time.sleep(0.2)
        return False


@contextmanager
def server_for(home: Path, port: int) -> Iterator[LocalServer | None]:
    """Have a server while the block runs, and name it to Prefect, here and in processes started from here.

    None where PREFECT_API_URL names one, which is left as it is. One of our own wants a password: what the variable
    PREFECT_SERVER_API_AUTH_STRING says, or one that is kept in ``home`` for this user. Nothing outside this machine is
    asked. Raises SettingsError: the port is taken, the server did not start, or the one that is named does not answer.
    """
    if named := os.environ.get("PREFECT_API_URL"):
        _check_answers(named)
        yield None
        return
    server = LocalServer(home, port)
    _check_free(port)
    password = os.environ.get("PREFECT_SERVER_API_AUTH_STRING") or _password_in(server.password_file)
    ours = {"PREFECT_SERVER_API_AUTH_STRING": password, "PREFECT_API_AUTH_STRING": password}
    wanted = {
        **QUIET,
        "PREFECT_HOME": str(home),
        "PREFECT_API_URL": server.url,
        "PREFECT_SERVER_UI_V2_ENABLED": "false",
        **place_pages(),
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
        "PREFECT_RUNNER_POLL_FREQUENCY": POLL_S,
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": ",".join(own_origins(port)),
    }
    before = {name: os.environ.get(name) for name in (*wanted, *ours)}
    os.environ.update({name: value for name, value in wanted.items() if name not in os.environ} | ours)
    try:
        server.keep_up()
        if not server.wait():
            raise SettingsError(
                f"the Prefect server did not start; see {server.log}, or go without one: --engine plain"
            )
        yield server
    finally:
        server.stop()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _password_in(path: Path) -> str:
    """The password that a file keeps, which nobody else can read or write; made where there is none (SettingsError)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with os.fdopen(number, "w", encoding="ascii") as file:
            file.write(f"spectralzoom:{secrets.token_urlsafe(24)}\n")
    except FileExistsError:
        pass
    except OSError as error:
        raise SettingsError(f"cannot keep the password of Prefect's pages in {path}: {error.strerror}") from error
    why = "is empty"
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), encoding="utf-8") as file:
            kept = os.fstat(file.fileno())
            if not stat.S_ISREG(kept.st_mode) or kept.st_mode & 0o077 or kept.st_uid not in (os.geteuid(), 0):
                why = "is not a plain file that only you can read"
            elif text := file.read(1000).strip():
                return text
    except (OSError, ValueError) as error:
        why = f"cannot be read ({error})"
    raise SettingsError(f"{path}, the password of Prefect's pages, {why}: remove it, a new one is made")


def _check_answers(url: str) -> None:
    try:
        with suppress(urllib.error.HTTPError):  # it is there, and wants to know who asks
            urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=PATIENCE_S).close()
    except NO_ANSWER as error:
        raise SettingsError(
            f"no Prefect server answers at {url}, which PREFECT_API_URL names ({error}): start it, or unset the "
            f"variable and have one started here"
        ) from error


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise SettingsError(
                f"--port {port} cannot be used ({error}): give another, or name the server there in PREFECT_API_URL"
            ) from error


def serve_prefect(request: ServeRequest, tell: Tell) -> None:
    """Serve until interrupted. PipelineError: no server, or a ledger cannot be written at the start; all is closed."""
    schedules, home = request.schedules(), request.fields[0].archive / ".prefect"
    log = home / "surveys.log"
    with server_for(home, request.port) as server:
        served = home / "served.json"
        write_served(request, served)
        watcher = Watcher(request, schedules, tell)
        # Of the runs that it starts the log has what they say; they go on by themselves when it ends, or are resumed.
        command = [sys.executable, "-c", "from flows.schedule.prefect_flows import serve_runs; serve_runs()"]
        runner = KeptProcess(command, log, RUNNER_ENDS_WITHIN_S, {NAMED_BY: str(served)})
        opened: list[FieldSchedule] = []
        try:
            for schedule in schedules.values():
                opened.append(schedule)
                schedule.open()
            tell(request.headline)
            pages = (os.environ["PREFECT_API_URL"] if server is None else server.url).rstrip("/").removesuffix("/api")
            known = "" if server is None else f", the password is in {server.password_file}"
            tell(f"Prefect's pages: {pages}{known}; what surveys say: {log}")
            watcher.prepare()
            runner.keep_up()
            while True:
                if server is not None and server.keep_up():
                    tell("the Prefect server had ended and is started again")
                    server.wait()
                    runner.restart()  # it does not find its server again by itself
                elif runner.keep_up():
                    tell(f"Prefect's runner had ended and is started again; {log} may say why")
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
