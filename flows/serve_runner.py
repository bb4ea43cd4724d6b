"""The process that lets Prefect start a schedule's runs: `serve` keeps it up, and starts it anew with the server.

By itself Prefect's runner does not come back once its server has been away.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from flows.process_guard import KeptProcess

PATIENCE_S = 15.0


class RunnerProcess(KeptProcess):
    """Prefect's runner, in a process of its own; ``words`` are what `main` reads, ``log`` has what it and surveys say.

    A survey that it has started goes on by itself when it ends, or is resumed.
    """

    def __init__(self, words: Mapping[str, Any], log: Path) -> None:
        super().__init__([sys.executable, "-m", "flows.serve_runner", json.dumps(words)], log, PATIENCE_S)


@contextmanager
def own_temporary_folder() -> Iterator[None]:
    """Let this process have its temporary files in a folder that is this user's alone.

    Prefect's runner keeps what it starts in /tmp/runner_storage, which belongs to the first user who ever ran one: that
    one could exchange it, and no other can run one.
    """
    usual = tempfile.tempdir
    with tempfile.TemporaryDirectory(prefix="spectralzoom-runner-", ignore_cleanup_errors=True) as own:
        tempfile.tempdir = own
        try:
            yield
        finally:
            tempfile.tempdir = usual


def main(text: str) -> None:
    """Serve the deployments of a request until told to stop."""
    from prefect import serve

    from flows.schedule_times import parse_timetable
    from flows.serve_fields import load_field
    from flows.serve_request import ServeRequest, deployments

    words = json.loads(text)
    request = ServeRequest(
        fields=[load_field(Path(file), words["out"]) for file in words["files"]],
        timetable=parse_timetable(words["cron"], words["every"], words["timezone"]),
        late=words["late"], limit=words["limit"], out=words["out"],
    )  # fmt: skip
    with suppress(KeyboardInterrupt), own_temporary_folder():
        serve(*deployments(request), limit=request.limit, print_starting_message=False)


if __name__ == "__main__":
    main(sys.argv[1])
