"""Run a Prefect server in a thread of this process, for this machine and this user only.

A thread needs no second import of Prefect, and ends with the process.
"""

from __future__ import annotations

import os
import secrets
import socket
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from contextvars import copy_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast
from urllib.parse import quote

from spectralzoom.flows.terminal.processes import cache_folder, place_pages
from spectralzoom.pipeline.errors import ArchiveError, SettingsError
from spectralzoom.storage.whole_files import aside, check_no_link, files_in, remove, write_new

HOST = "127.0.0.1"
STARTED_WITHIN_S, ENDED_WITHIN_S, SENT_WITHIN_S, ANSWERED_WITHIN_S = 120.0, 10.0, 10.0, 5.0
LATER = (429, 503)  # statuses
CONSOLE = "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL"
QUIET = {  # no requests to other machines, no output on the terminal
    "server.analytics_enabled": False,
    "server.ui.v2_enabled": False,
    "server.ui.show_promotional_content": False,
    "server.logging_level": "CRITICAL",
    "internal.logging_level": "CRITICAL",
    "logging.to_api.when_missing_flow": "ignore",
}


BOUNDED = {"client.max_retries": 1, "api.request_timeout": ANSWERED_WITHIN_S}  # of a survey that can do without


class ServerUnavailable(SettingsError):  # noqa: N818 - a survey runs without it
    """No Prefect server can be started or reached."""


@contextmanager
def configured(home: Path, own: Mapping[str, Any] | None = None, usual: Mapping[str, Any] = QUIET) -> Iterator[None]:
    """Configure Prefect for a block, which passes it on to its processes: ``usual``, with ``home`` for its files.

    Settings of the user are kept, but for ``own``. Raises as `close_folder`.
    """
    is_chosen = CONSOLE in os.environ
    os.environ.setdefault(CONSOLE, "CRITICAL")  # Prefect reads this one from the environment alone, at its import
    from prefect.settings import temporary_settings

    close_folder(home)
    try:
        with temporary_settings({**(own or {}), "flows.heartbeat_frequency": None}, {**usual, "home": home}):
            yield
    finally:
        if not is_chosen:
            del os.environ[CONSOLE]


@contextmanager
def local_server(home: Path, port: int = 0, *, schedules: bool = False) -> Iterator[str]:
    """Run a server for the block, yield the address of its API, and configure Prefect to use it.

    ``home`` is the folder of its files, closed to other users; ``port`` 0 is any free port. With ``schedules``, the
    server schedules the runs of deployments and serves its pages. Raises ServerUnavailable: it does not start;
    SettingsError: the port is in use.
    """
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
        except (OSError, OverflowError) as error:
            raise SettingsError(
                f"--port {port} cannot be used ({error}): give another, or name its server in PREFECT_API_URL"
            ) from error
        pages = f"http://{HOST}:{listening.getsockname()[1]}"
        try:
            password = private_files(home)
        except (OSError, ValueError, sqlite3.Error, subprocess.CalledProcessError) as error:
            raise ServerUnavailable(f"the Prefect server cannot use its folder {home} ({error})") from error
        own = {
            "api.url": f"{pages}/api",
            "api.auth_string": password,
            "server.api.auth_string": password,
            "server.api.cors_allowed_origins": f"{pages},{pages.replace(HOST, 'localhost')}",
            "server.database.connection_url": f"sqlite+aiosqlite:///file:{quote(str(home))}/prefect.db?uri=true",
            "server.register_blocks_on_start": schedules,
            # leases that outlive a killed server: the next one frees the rig
            "server.concurrency.lease_storage": "prefect.server.concurrency.lease_storage.filesystem",
            **(place_pages() if schedules else {"server.ui.enabled": False}),
        }
        with configured(home, own), _running(listening, schedules=schedules):
            yield f"{pages}/api"


@contextmanager
def _running(listening: socket.socket, *, schedules: bool) -> Iterator[None]:
    """Run the configured server for the block on a socket; it refuses other names of this machine in requests."""
    import uvicorn
    from fastapi.middleware.trustedhost import TrustedHostMiddleware
    from prefect.server.api.server import create_app

    app = TrustedHostMiddleware(create_app(final=schedules, ephemeral=not schedules), [HOST, "localhost"])
    server = uvicorn.Server(uvicorn.Config(app, log_level="critical", lifespan="on"))
    run = copy_context().run
    thread = threading.Thread(target=run, args=(server.run, [listening]), name="prefect-server", daemon=True)
    thread.start()
    end = time.monotonic() + STARTED_WITHIN_S
    while not server.started:
        if not thread.is_alive() or time.monotonic() > end:
            raise ServerUnavailable("the Prefect server did not start")
        time.sleep(0.02)
    try:
        yield
    finally:
        sent(SENT_WITHIN_S)
        server.should_exit = True
        thread.join(ENDED_WITHIN_S)


def sent(within_s: float) -> bool:
    """End Prefect's workers, and return whether each has sent its events and logs within so many seconds."""
    from prefect.events.worker import EventsWorker
    from prefect.logging.handlers import APILogWorker

    ends = [cast(Any, worker.drain_all(timeout=within_s)) for worker in (EventsWorker, APILogWorker)]
    return not any(end.not_done for end in ends)


def silence_of(address: str, within_s: float = ANSWERED_WITHIN_S) -> str | None:
    """Return why the Prefect server at an address does not answer; None where it does, with a refusal too.

    A server that asks to come back later is silent: Prefect would wait as long as it asks, at each request.
    """
    import httpx

    end = time.monotonic() + within_s
    try:
        with httpx.stream("GET", f"{address.rstrip('/')}/health", timeout=within_s) as answer:
            if answer.status_code in LATER:
                return f"it answers {answer.status_code} {answer.reason_phrase}"
            if any(time.monotonic() > end for _ in answer.iter_raw()):
                return f"its answer takes more than {within_s:g} s"
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        return str(error) or type(error).__name__
    return None


def server_answers() -> bool:
    """Return whether the configured Prefect server answers within seconds; also where none is named."""
    from prefect.settings import PREFECT_API_URL

    address = PREFECT_API_URL.value()
    return address is None or silence_of(address) is None


def private_files(home: Path) -> str:
    """Create a folder closed to other users, with a password and a database; return the password.

    Others may know or have written the password of a folder that was open to them: it gets another one. Raises as
    `close_folder`.
    """
    was_closed = close_folder(home)
    password = home / "password"
    if not was_closed or not password.exists() or not password.read_text(encoding="utf-8").strip():
        remove(password)
        write_new(password, f"spectralzoom:{secrets.token_urlsafe(24)}\n")
    if not (home / "prefect.db").exists():
        copy_tables(home / "prefect.db")
    check_tables(home / "prefect.db")
    return password.read_text(encoding="utf-8").strip()


def check_tables(database: Path) -> None:
    """Raise sqlite3.Error for a database that is damaged, or that another process keeps locked."""
    with closing(sqlite3.connect(database, timeout=ANSWERED_WITHIN_S)) as tables:
        if (found := tables.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
            raise sqlite3.DatabaseError(f"prefect.db is damaged: {found}; remove it")
        tables.execute("BEGIN IMMEDIATE")
        tables.rollback()


def close_folder(home: Path) -> bool:
    """Make a folder that only this user may open, or close it; return whether it was closed before.

    Raises ArchiveError: it or a file in it is a link, or belongs to another user.
    """
    check_no_link(home, home.parent)
    home.mkdir(mode=0o700, exist_ok=True)
    descriptor = os.open(home, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        before, user = os.fstat(descriptor), os.geteuid()
        if before.st_uid == user:
            os.fchmod(descriptor, 0o700)
        for name, about in {"": before, **files_in(home)}.items():
            if stat.S_ISLNK(about.st_mode) or about.st_uid != user:
                raise ArchiveError(f"{home / name} is a link or belongs to another user; move {home} elsewhere")
        return stat.S_IMODE(before.st_mode) & 0o077 == 0
    finally:
        os.close(descriptor)


def copy_tables(database: Path) -> None:
    """Copy an empty database with Prefect's tables from the user's cache folder, which is filled once for a version.

    The 90 migrations take 6 s. Another process runs them, since Prefect leaves a second database of a process empty.
    """
    import prefect

    tables = (cache_folder() or database.parent) / "spectralzoom" / f"prefect-{prefect.__version__}.db"
    if not tables.exists():
        tables.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=tables.parent) as folder:
            full, one_file = f"{folder}/full.db", Path(folder, "one.db")
            own = {"PREFECT_HOME": folder, "PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{full}"}
            upgrade = [sys.executable, "-m", "prefect", "server", "database", "upgrade", "-y"]
            subprocess.run(upgrade, env={**os.environ, **own}, check=True, capture_output=True)
            with closing(sqlite3.connect(full)) as made:
                made.execute("VACUUM INTO ?", (str(one_file),))
            one_file.replace(tables)
    part = aside(database)
    write_new(part, tables.read_bytes())
    part.replace(database)
