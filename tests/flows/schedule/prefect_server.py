"""A Prefect server in another process, which a test can kill."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[3]
SERVES = """
import sys, time
from pathlib import Path
from flows.tasks.local_server import local_server
with local_server(Path(sys.argv[1]), int(sys.argv[2]), schedules=True):
    print("started", flush=True)
    time.sleep(86_400)
"""


def free_port() -> int:
    """Return a port of this machine that is free."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@contextmanager
def server_process(home: Path, port: int) -> Iterator[subprocess.Popen[str]]:
    """Yield the process of a Prefect server on a port; it is killed at the end."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    words = [sys.executable, "-c", SERVES, str(home), str(port)]
    environment |= {
        "PREFECT_HOME": str(home),
        "PYTHONPATH": str(ROOT),
        "DO_NOT_SCAN_PATH": "1",
        "PREFECT_SERVER_LOGGING_LEVEL": "CRITICAL",
    }
    with subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout.readline().strip() != "started":
                raise RuntimeError(f"no Prefect server on port {port}")
            yield process
        finally:
            process.kill()
