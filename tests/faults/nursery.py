"""Run surveys in separate processes that start fast: one process imports all modules and forks a child for each.

A child can get a fault, a function of `tests.faults.injection` that is called before the command. The child's output is
kept with the functions that its error passed, so a fault at a wrong place is noticed.
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
from typing import Any

from tests.source_paths import PYTHON_PATH

ROOT = Path(__file__).resolve().parents[2]
ADVICE = ("run again", "--out", "another folder", "free space", "ulimit")


@dataclass(frozen=True)
class Ended:
    """The result of a child. ``text`` is its output, ``place`` the functions of this project that its error passed."""

    code: int
    seconds: float
    text: str
    place: str

    @property
    def told(self) -> bool:
        """Return whether it failed with exactly one message that advises the user, without a traceback."""
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
        """Return the error message for the user, or the whole output."""
        errors = [line for line in self.text.splitlines() if line.startswith("error: ")]
        return errors[-1] if errors else self.text.strip()


class Child:
    """A running command."""

    def __init__(self, nursery: Nursery, pid: int, log: Path) -> None:
        self.pid = pid
        self._nursery = nursery
        self._log = log
        self._began = time.monotonic()

    def kill(self) -> None:
        """Send SIGKILL; it does not harm a child that has ended already, as it is still to be waited for."""
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> Ended:
        """Wait for the end and return the result."""
        code = int(self._nursery.ask({"wait": self.pid}))
        place = self._log.with_suffix(".place")
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
    """Start commands; use as a context manager. ``folder`` is their working directory and holds their output."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._number = 0
        command = [sys.executable, "-m", "tests.faults.nursery", str(folder / "choices")]
        environment = {**os.environ, "PYTHONPATH": PYTHON_PATH, "OMP_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, text=True)

    def __enter__(self) -> Nursery:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def start(self, words: Iterable[str], fault: str | None = None, **arguments: Any) -> Child:
        """Start a command of the command line, with a fault and its arguments."""
        self._number += 1
        log = self.folder / f"child-{self._number}.log"
        request = {"words": list(words), "fault": fault, "arguments": arguments, "log": str(log)}
        return Child(self, int(self.ask(request | {"folder": str(self.folder)})), log)

    def run(self, words: Iterable[str], fault: str | None = None, **arguments: Any) -> Ended:
        """Start a command and wait for its end."""
        return self.start(words, fault, **arguments).wait()

    def ask(self, request: dict[str, Any]) -> str:
        """Send one request and return its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        assert answer, "the nursery has died"
        return answer


# --- in the nursery's own process -------------------------------------------------------------------------------------


def serve(choices: Path) -> None:
    """Fork a child for each request on stdin, or wait for one; a folder keeps the children's choices of effects."""
    for name in (
        *(
            "spectralzoom.flows.cli.main",
            "spectralzoom.flows.publish.run_folder",
            "spectralzoom.flows.survey_command",
            "spectralzoom.flows.survey",
            "spectralzoom.flows.prefect_flow",
        ),
        *(
            "spectralzoom.flows.cli.survey_verbs",
            "spectralzoom.flows.archive.commands",
            "matplotlib.backends.backend_agg",
        ),
        *(
            "spectralzoom.models.network.segmenter",
            "rich.status",
            "safetensors.torch",
            "scipy.optimize",
            "tests.faults.injection",
        ),
        *(
            "spectralzoom.pipeline.signal.compiled_loops",
            "spectralzoom.pipeline.simulator.compiled_loops",
            "rasterio",
            "skimage.color",
        ),
    ):
        importlib.import_module(name)
    importlib.import_module("PIL.Image").init()  # loads its formats
    importlib.import_module("tests.prior_work").remember(choices)
    gc.freeze()  # else each child's garbage collection copies all of it from its parent
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
    """Run one command to its end, and exit the process."""
    code = 70
    try:
        log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(log, 1), os.dup2(log, 2)
        os.chdir(request["folder"])
        _keep_place(Path(request["log"]).with_suffix(".place"))
        if request["fault"] is not None:
            injection = importlib.import_module("tests.faults.injection")
            getattr(injection, request["fault"])(**request["arguments"])
        importlib.import_module("spectralzoom.flows.cli.main").main(request["words"])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


def _keep_place(path: Path) -> None:
    """Record the functions of this project that an error passed when the command line reports it."""
    cli = importlib.import_module("spectralzoom.flows.cli.main")
    say = cli.say
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)

    def noting(message: str) -> None:
        error = sys.exc_info()[1]
        frames: list[traceback.FrameSummary] = []
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
