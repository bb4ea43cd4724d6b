"""The process that lets Prefect start a schedule's runs: `serve` keeps it up, and starts it anew with the server.

By itself Prefect's runner does not come back once its server has been away.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flows.engine import end_with_us

PATIENCE_S = 15.0
LARGEST_LOG = 10_000_000  # bytes; a larger one is begun anew


@dataclass
class RunnerProcess:
    """Prefect's runner, in a process of its own; ``words`` are what `main` reads."""

    words: dict[str, Any]
    log: Path  # what it and the surveys say
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def keep_up(self) -> bool:
        """Start it where it does not run; whether it was started."""
        if self._process is not None and self._process.poll() is None:
            return False
        command = [sys.executable, "-m", "flows.serve_runner", json.dumps(self.words)]
        self.log.parent.mkdir(parents=True, exist_ok=True)
        grown = self.log.exists() and self.log.stat().st_size > LARGEST_LOG
        with self.log.open("wb" if grown else "ab") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        end_with_us(self._process.pid)
        return True

    def restart(self) -> None:
        """End it and start it again; a survey that it has started goes on by itself, or is resumed."""
        self.stop()
        self.keep_up()

    def stop(self) -> None:
        """End it."""
        process, self._process = self._process, None
        if process is None or process.poll() is not None:
            return
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_S)
            return
        process.kill()
        process.wait()


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
    with suppress(KeyboardInterrupt):
        serve(*deployments(request), limit=request.limit, print_starting_message=False)


if __name__ == "__main__":
    main(sys.argv[1])
