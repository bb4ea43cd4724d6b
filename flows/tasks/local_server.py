"""Run a Prefect server in a thread of this process, for this machine only, with its files in a folder.

A thread needs no second import of Prefect, and ends with the process. A password protects it against other origins.
"""

from __future__ import annotations

import os
import secrets
import shutil
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from contextvars import copy_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from spectralzoom.flows.terminal.processes import cache_folder, place_pages
from spectralzoom.pipeline.errors import SettingsError

HOST = "127.0.0.1"
STARTED_WITHIN_S, ENDED_WITHIN_S = 120.0, 10.0
PATIENCE_S = 10.0  # timeout of a named server
LEASES = "prefect.server.concurrency.lease_storage.filesystem"
RECORDED_WITHIN_S = 5.0  # timeout for the states of the last tasks
OF_SCHEDULES = (  # services that a single survey does not use
    *("CANCELLATION_CLEANUP", "CLEANUP_RECONCILER", "DB_VACUUM", "EVENT_LOGGER", "FOREMAN", "LATE_RUNS"),
    *("PAUSE_EXPIRATIONS", "SCHEDULER", "TRIGGERS"),
)
QUIET = {  # no requests to other machines, no output on the terminal; run logs go to the server
    "DO_NOT_SCAN_PATH": "1",
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_V2_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
    "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_WHEN_MISSING_FLOW": "ignore",
    "PREFECT_CLI_PROMPT": "false",
}


class ServerUnavailable(SettingsError):  # noqa: N818 - a survey runs without it
    """No Prefect server can be started or reached."""


def quiet_environment(home: Path) -> AbstractContextManager[None]:
    """Set Prefect's folder and quiet settings in the environment for a block; variables of the user are kept."""
    wanted = {**QUIET, "PREFECT_HOME": str(home)}
    return _environment({name: value for name, value in wanted.items() if name not in os.environ})


@contextmanager
def _environment(wanted: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextmanager
def local_server(home: Path, port: int = 0, *, schedules: bool = False) -> Iterator[str]:
    """Run a server for the block, yield the address of its API, and configure Prefect to use it.

    ``home`` is the folder of database and password; ``port`` 0 is any free port. With ``schedules``, the server
    schedules the runs of deployments and serves its pages. Raises ServerUnavailable: it does not start;
    SettingsError: the port is in use.
    """
    with socket.socket() as listening, ExitStack() as held:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise SettingsError(
                f"--port {port} cannot be used ({error}): give another, or name its server in PREFECT_API_URL"
            ) from error
        api = held.enter_context(_using(home, listening.getsockname()[1], schedules=schedules))
        import uvicorn
        from prefect.logging.handlers import APILogWorker
        from prefect.server.api.server import create_app

        made: Any = create_app(final=schedules, ephemeral=not schedules)
        server = uvicorn.Server(uvicorn.Config(made, log_level="critical", lifespan="on"))
        thread = threading.Thread(
            target=copy_context().run, args=(server.run, [listening]), name="prefect-server", daemon=True
        )
        thread.start()
        end = time.monotonic() + STARTED_WITHIN_S
        while not server.started:
            if not thread.is_alive() or time.monotonic() > end:
                raise ServerUnavailable("the Prefect server did not start")
            time.sleep(0.02)
        try:
            yield api
        finally:
            APILogWorker.drain_all(timeout=PATIENCE_S)
            server.should_exit = True
            thread.join(ENDED_WITHIN_S)


@contextmanager
def _using(home: Path, port: int, *, schedules: bool) -> Iterator[str]:
    """Configure clients and server of this process and its children for a server of this port."""
    password = password_in(home / "password") if schedules else f"spectralzoom:{secrets.token_urlsafe(24)}"
    try:
        create_database(home / "prefect.db")
    except (sqlite3.Error, OSError) as error:
        raise ServerUnavailable(f"the Prefect server has no database in {home} ({error})") from error
    file = str(home / "prefect.db")
    file = f"file:{quote(file)}?uri=true" if "?" in file else file  # the address would end at a question mark
    services = {} if schedules else {f"PREFECT_SERVER_SERVICES_{name}_ENABLED": "false" for name in OF_SCHEDULES}
    api = f"http://{HOST}:{port}/api"
    wanted = {
        **services,
        **(place_pages() if schedules else {"PREFECT_SERVER_UI_ENABLED": "false"}),
        "PREFECT_API_URL": api,
        "PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{file}",
        "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE": LEASES,  # they outlive a killed server, which frees the rig again
        "PREFECT_API_BLOCKS_REGISTER_ON_START": "true" if schedules else "false",
        "PREFECT_SERVER_API_AUTH_STRING": password,
        "PREFECT_API_AUTH_STRING": password,
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{HOST}:{port},http://localhost:{port}",
    }
    try:
        from prefect import settings
    except ImportError as error:
        raise ServerUnavailable(f"Prefect cannot be imported ({error})") from error
    known = {getattr(settings, name): value for name, value in wanted.items()}
    heartbeat = {settings.PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}
    with _environment(wanted), settings.temporary_settings(updates={**known, **heartbeat}):
        yield api


def create_database(path: Path) -> None:
    """Create the database of the server with Prefect's tables, unless it exists.

    Prefect's 90 migrations take 6 s of processor time. They run once for a version, in the user's cache folder, and
    each archive gets a copy. A user without such a folder waits for them in each new archive.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    cache = cache_folder()
    if path.exists() or cache is None:
        return
    import prefect

    migrated = cache / "spectralzoom" / f"prefect-{prefect.__version__}.db"
    if not migrated.exists():
        migrated.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=migrated.parent) as folder:
            _migrate(Path(folder)).replace(migrated)
    with TemporaryDirectory(dir=path.parent) as folder:
        shutil.copyfile(migrated, Path(folder) / "copy.db").replace(path)


def _migrate(folder: Path) -> Path:
    """Create an empty database with the tables of the installed Prefect, in a process with settings of its own."""
    full, small = folder / "full.db", folder / "small.db"
    own = {"PREFECT_HOME": str(folder), "PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{full}"}
    upgrade = [sys.executable, "-m", "prefect", "server", "database", "upgrade", "-y"]
    try:
        subprocess.run(upgrade, env={**os.environ, **QUIET, **own}, check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise ServerUnavailable(f"Prefect cannot create its database ({error.stderr.strip()[-300:]})") from error
    with closing(sqlite3.connect(full)) as made:
        made.execute("PRAGMA page_size = 1024")  # small pages for 229 almost empty tables and indices
        made.execute("VACUUM INTO ?", (str(small),))
    return small


def check_answers(url: str) -> None:
    """Check that a server answers. Raises ServerUnavailable."""
    import httpx

    try:
        httpx.get(f"{url.rstrip('/')}/health", timeout=PATIENCE_S)  # any answer, also that it requires a password
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise ServerUnavailable(
            f"no Prefect server answers at {url}, which PREFECT_API_URL names ({error}): start it, or unset that"
        ) from error


def wait_until_recorded(flow_run: Any) -> None:
    """Wait until the server has the final states of the tasks of a flow run, for 5 s at most.

    Tasks report in batches, which would be lost if the process ended before.
    """
    from prefect.client.orchestration import get_client
    from prefect.client.schemas import filters

    of_run = filters.FlowRunFilter(id=filters.FlowRunFilterId(any_=[flow_run]))
    end = time.monotonic() + RECORDED_WITHIN_S
    with suppress(Exception), get_client(sync_client=True) as client:  # the server may have stopped
        while time.monotonic() < end:
            states = [run.state for run in client.read_task_runs(flow_run_filter=of_run)]
            if all(state is not None and state.is_final() for state in states):
                return
            time.sleep(0.1)


def password_in(path: Path) -> str:
    """Return the password in a private file, which is created if needed. Raises SettingsError: it is not readable."""
    why = "is empty"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
                file.write(f"spectralzoom:{secrets.token_urlsafe(24)}\n")
        if text := path.read_text(encoding="utf-8").strip():
            return text
    except (OSError, ValueError) as error:
        why = f"cannot be read ({error})"
    raise SettingsError(f"{path}, the password of Prefect's pages, {why}: delete it to create a new one")
