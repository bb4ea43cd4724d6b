"""Surveys in processes of their own that start in no time: one process imports everything and forks a child for each.

A child can be given a fault, a function of `tests.faults.injection` that is called before it begins. What it prints is
kept, and where an error comes from: a fault that is not met where it was meant shows.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
ADVICE = ("run again", "--out", "another folder", "free space", "ulimit")


@dataclass(frozen=True)
class Ended:
    """How a child ended. ``text`` is what it printed, ``place`` where its error was raised in our own code."""

    code: int
    seconds: float
    text: str
    place: str

    @property
    def told(self) -> bool:
        """Whether it failed with one message that says what to do, and nothing else that is meant for developers."""
        errors = [line for line in self.text.splitlines() if line.startswith("error: ")]
        return (
            self.code == 1
            and len(errors) == 1
            and any(word in errors[0] for word in ADVICE)
            and "defect" not in errors[0]
            and "Traceback" not in self.text
        )

    @property
    def message(self) -> str:
        """The error that the user reads, or all that was printed."""
        errors = [line for line in self.text.splitlines() if line.startswith("error: ")]
        return errors[-1] if errors else self.text.strip()


class Child:
    """A command under way."""

    def __init__(self, nursery: Nursery, pid: int, log: Path) -> None:
        self.pid = pid
        self._nursery, self._log, self._began = nursery, log, time.monotonic()

    def kill(self) -> None:
        """End it with SIGKILL; a child that ended by itself is not harmed, it is not yet waited for."""
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> Ended:
        """How it ended, once it has."""
        code, place = int(self._nursery.ask({"wait": self.pid})), self._log.with_suffix(".place")
        ended = Ended(
            code,
            time.monotonic() - self._began,
            self._log.read_text(errors="replace"),
            place.read_text() if place.exists() else "",
        )
        self._log.unlink()
        place.unlink(missing_ok=True)
        return ended


class Nursery:
    """Starts commands; use as a context manager. ``folder`` is where commands run and where their words are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._number = 0
        command = [sys.executable, "-m", "tests.faults.nursery", str(folder / "choices")]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Nursery:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def start(self, words: Iterable[str], fault: str | None = None, **arguments: Any) -> Child:
        """Begin a command of the command line, with a fault and what that is told."""
        self._number += 1
        log = self.folder / f"child-{self._number}.log"
        request = {"words": list(words), "fault": fault, "arguments": arguments, "log": str(log)}
        return Child(self, int(self.ask(request | {"folder": str(self.folder)})), log)

    def run(self, words: Iterable[str], fault: str | None = None, **arguments: Any) -> Ended:
        """Begin a command and wait for its end."""
        return self.start(words, fault, **arguments).wait()

    def ask(self, request: dict[str, Any]) -> str:
        """Send one request and give its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        assert answer, "the nursery has died"
        return answer


# --- in the nursery's own process -------------------------------------------------------------------------------------


def serve(choices: Path) -> None:
    """Fork a child for each request on stdin, or wait for one; what effects they choose is remembered in a folder."""
    for name in (
        *("flows.cli.main", "flows.publish.run_folder", "flows.publish.survey_command", "flows.survey"),
        *("flows.cli.survey_verbs", "flows.archive.commands", "matplotlib.backends.backend_agg"),
        *("models.network.segmenter", "rich.status", "safetensors.torch", "scipy.optimize", "tests.faults.injection"),
        *("pipeline.signal.compiled_loops", "pipeline.simulator.compiled_loops", "rasterio", "skimage.color"),
    ):
        importlib.import_module(name)
    importlib.import_module("PIL.Image").init()  # reads its formats
    importlib.import_module("tests.prior_work").remember(choices)
    gc.freeze()  # else each child looks through all of it for what may go, and copies it from its parent by that
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            print(os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1]), flush=True)
            continue
        child = os.fork()
        if child == 0:
            _live(request)
        print(child, flush=True)


def _live(request: dict[str, Any]) -> None:
    """Run one command to its end, and never come back."""
    code = 70
    try:
        log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(log, 1), os.dup2(log, 2)
        os.chdir(request["folder"])
        _keep_place(Path(request["log"]).with_suffix(".place"))
        if request["fault"] is not None:
            injection = importlib.import_module("tests.faults.injection")
            getattr(injection, request["fault"])(**request["arguments"])
        importlib.import_module("flows.cli.main").main(request["words"])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


def _keep_place(path: Path) -> None:
    """When the command line tells of an error, note the functions of ours that it came through."""
    cli = importlib.import_module("flows.cli.main")
    say, descriptor = cli.say, os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)

    def noting(message: str) -> None:
        error, frames = sys.exc_info()[1], list[traceback.FrameSummary]()
        while error is not None:
            frames += traceback.extract_tb(error.__traceback__)
            error = error.__cause__
        ours = [frame for frame in frames if Path(frame.filename).is_relative_to(ROOT)]
        names = [f"{Path(frame.filename).stem}.{frame.name}" for frame in ours]
        os.write(descriptor, " ".join(dict.fromkeys(names)).encode())
        say(message)

    cli.__dict__["say"] = noting


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
