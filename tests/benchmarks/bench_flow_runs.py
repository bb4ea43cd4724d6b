"""Processor time that Prefect adds to a survey: the whole command with and without it, in turn."""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from measure import Row

ROUNDS = 5
NEW_GOAL_S, USED_GOAL_S = 5.0, 3.0
WITHOUT = "class flow:\n    def __init__(self, **_): pass\n    def __call__(self, fn): self.fn = fn; return self\n"
SURVEY = ("survey", "--scene", "farm", "--size", "64x64", "--scan-step", "1", "--effects", "none", "--no-accuracy")


def rows() -> list[Row]:
    """Measure an archive without a server's files, and one with them; stages are stored, so that they cost the same."""
    with tempfile.TemporaryDirectory() as name:
        archive = Path(name) / "archive"
        (Path(name) / "prefect").mkdir()
        (Path(name) / "prefect" / "__init__.py").write_text(WITHOUT)  # instead of Prefect for --engine plain: no import
        for engine in ("plain", "prefect"):  # make stores, compiled loops and bytecode before the timing
            _processor_s(archive, engine)
        new: list[float] = []
        used: list[float] = []
        for _ in range(ROUNDS):
            shutil.rmtree(archive / ".prefect", ignore_errors=True)
            plain = _processor_s(archive, "plain")
            new.append(_processor_s(archive, "prefect") - plain)
            used.append(_processor_s(archive, "prefect") - plain)
    return [_row("a new archive", new, NEW_GOAL_S), _row("a used archive", used, USED_GOAL_S)]


def _row(what: str, spent: list[float], goal_s: float) -> Row:
    median = statistics.median(spent)
    load = f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    spread = f"{len(spent)} rounds in turn: {min(spent):.1f} to {max(spent):.1f} s"
    counted = f"`--engine prefect` less `--engine plain` that cannot import prefect, {spread}; {load}"
    return Row(f"Prefect's processor time, {what}", f"{median:.1f} s", f"<= {goal_s:g} s", median <= goal_s, counted)


def _processor_s(archive: Path, engine: str) -> float:
    """Return the user and system seconds of one command and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "flows.cli.main", *SURVEY, "--engine", engine, "--out", str(archive)]
    found_first = {"PYTHONPATH": str(archive.parent)} if engine == "plain" else {}
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", **found_first}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
