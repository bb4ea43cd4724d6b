"""Run the faults beside this file and print one table: python tests/faults [name ...] [--quick] [--markdown FILE].

A demand that is not met is printed like one that is, the others go on, and the exit code is 1.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

# Before numpy and torch are loaded: one thread, as the figures are meant.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[0] = str(ROOT)  # not this folder: its modules go by their full names

from tests.faults.fault_table import HEADINGS, Clock, Row, Rows, rows_of, run_table  # noqa: E402

SURVEY = ("survey", "--scene", "farm", "--size", "256x256", "--no-controls", "--engine", "plain", "--out")


def main(arguments: Sequence[str]) -> int:
    logging.disable(logging.WARNING)  # what is put right stands in the table
    return run_table(arguments, "python tests/faults", "fault", FAULTS, FAULTS, HEADINGS)


def _script(name: str, words: tuple[str, str, str], counts: tuple[int, int]) -> Rows:
    """The one row of a script that is told how often and ends with 1 where a demand is not met.

    ``words`` are fault, how it is injected and what is demanded; ``counts`` are how often in full and quickly.
    """

    def rows(quick: bool) -> Sequence[Row]:
        return [_run_script(name, words, counts[quick], [])]

    return rows


def _run_script(name: str, words: tuple[str, str, str], count: int, before: Sequence[str]) -> Row:
    clock = Clock()
    command = [sys.executable, str(HERE / f"{name}.py"), *before, str(count)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    said = "; ".join(" ".join(line.split()) for line in done.stdout.splitlines() if line.strip())
    if done.returncode not in (0, 1) or done.stderr.strip():
        said = f"{said} {done.stderr.strip()[-300:]}".strip()
    return Row(words[0], words[1], count, words[2], said, done.returncode == 0, clock.seconds)


def _flips(quick: bool) -> Sequence[Row]:
    words = ("a bit flips", "one bit of a random file of an archive", "each found by verify, and named")
    with tempfile.TemporaryDirectory(prefix="flips-") as name:
        command = [sys.executable, "-m", "flows.cli.main", *SURVEY, name]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        return [_run_script("flips", words, 20 if quick else 200, [name])]


FAULTS: dict[str, Callable[[bool], Sequence[Row]]] = {
    "kills": _script(
        "kills",
        (
            "survey killed",
            "SIGKILL at random moments of a survey of 256 x 256 px and 32 bands",
            "archive verifies, nothing published is lost, rerun bit-identical",
        ),
        (100, 3),
    ),
    "terminations": rows_of("tests.faults.terminations"),
    "flips": _flips,
    "headers": _script(
        "mutated_headers",
        (
            "mutated headers",
            "random changes in ENVI headers, real and made",
            "a cube or one clear error, soon, in no more memory than the file's size",
        ),
        (10_000, 500),
    ),
    "files": _script(
        "mutated_files",
        (
            "mutated files",
            "random changes in files of every kind that is ingested",
            "a cube or one clear error, soon, in bounded memory",
        ),
        (5000, 100),
    ),
    "disk_full": rows_of("tests.faults.disk_full"),
    "refused_writes": rows_of("tests.faults.refused_writes"),
    "many_writers": rows_of("tests.faults.many_writers"),
    "clocks": rows_of("tests.faults.clocks"),
    "lost_lines": rows_of("tests.faults.lost_lines"),
    "growing_files": rows_of("tests.faults.growing_files"),
    "spool_rate": rows_of("tests.faults.spool_rate"),
    "hostile_rig": rows_of("tests.faults.hostile_rig"),
    "sealed_flips": rows_of("tests.faults.sealed_flips"),
}

if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
