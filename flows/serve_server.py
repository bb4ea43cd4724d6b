"""The Prefect server of a schedule: the one that PREFECT_API_URL names, or one of our own on this machine."""

from __future__ import annotations

import os
import socket
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPException
from pathlib import Path

from flows.cache_places import place_pages
from flows.engine import QUIET
from flows.process_guard import KeptProcess
from pipeline.errors import SettingsError

HOST = "127.0.0.1"
STARTED_WITHIN_S = 120.0
ENDS_WITHIN_S = 10.0
PATIENCE_S = 10.0  # with a server that is named
NO_ANSWER = (OSError, ValueError, HTTPException)  # also of what speaks another protocol
POLL_S = "2"  # how often Prefect looks for due runs; by its own default the next field waits up to 10 s


class LocalServer(KeptProcess):
    """A server process with its files in a folder; started again where it has died."""

    def __init__(self, home: Path, port: int) -> None:
        self.url = f"http://{HOST}:{port}/api"
        command = [sys.executable, "-m", "prefect", "server", "start", "--host", HOST, "--port", str(port)]
        super().__init__(command, home / "server.log", ENDS_WITHIN_S)

    def wait(self) -> bool:
        """Wait until it answers; False where it has not within two minutes, or has ended."""
        end = time.monotonic() + STARTED_WITHIN_S
        while time.monotonic() < end:
            with suppress(*NO_ANSWER), urllib.request.urlopen(f"{self.url}/health", timeout=2) as answer:
                if answer.status == 200:
                    return True
            if not self.runs():
                return False
            time.sleep(0.2)
        return False


def pages_of(server: LocalServer | None) -> str:
    """Where the pages of a server are to be seen: one of our own, or the one that PREFECT_API_URL names."""
    return (os.environ["PREFECT_API_URL"] if server is None else server.url).rstrip("/").removesuffix("/api")


@contextmanager
def server_for(home: Path, port: int) -> Iterator[LocalServer | None]:
    """Have a server while the block runs, and name it to Prefect, here and in processes started from here.

    None where PREFECT_API_URL names one, which is left as it is. Nothing outside this machine is asked.

    Raises
    ------
    SettingsError : the port is taken, the server did not start, or the one that is named does not answer.
    """
    if named := os.environ.get("PREFECT_API_URL"):
        _check_answers(named)
        yield None
        return
    server = LocalServer(home, port)
    _check_free(port)
    wanted = {
        **QUIET, "PREFECT_HOME": str(home), "PREFECT_API_URL": server.url, "PREFECT_SERVER_UI_V2_ENABLED": "false",
        **place_pages(),
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false", "PREFECT_RUNNER_POLL_FREQUENCY": POLL_S,
    }  # fmt: skip
    added = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(added)
    try:
        server.keep_up()
        if not server.wait():
            raise SettingsError(
                f"the Prefect server did not start; see {server.log}, or go without one: --engine plain"
            )
        yield server
    finally:
        server.stop()
        for name in added:
            os.environ.pop(name, None)


def _check_answers(url: str) -> None:
    try:
        with urllib.request.urlopen(f"{url.rstrip('/')}/health", timeout=PATIENCE_S):
            return
    except urllib.error.HTTPError:  # it is there, and wants to know who asks
        return
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
