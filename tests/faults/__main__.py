"""Run the faults in this folder and print one table: python tests/faults [name ...] [--quick] [--markdown FILE].

A requirement that is not met is printed in the table, the other faults still run, and the exit code is 1.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

# One thread, set before numpy and torch are loaded, as all figures are for one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder: its modules are imported by their full names

from tests.faults.fault_table import HEADINGS, rows_of, run_table  # noqa: E402

PLACES = {
    "headers": "mutated_files:header_rows",
    "files": "mutated_files:file_rows",
    "disk_full": "disk_full:full_rows",
    "refused_writes": "disk_full:refused_rows",
    "many_writers": "many_writers:rows",
    "lost_lines": "lost_lines:rows",
    "growing_files": "growing_files:rows",
    "metadata_flips": "metadata_flips:rows",
    "hostile_archives": "hostile_archives:rows",
    "vanishing_stores": "vanishing_stores:rows",
}
FAULTS = {name: rows_of(f"tests.faults.{place}") for name, place in PLACES.items()}


def main(arguments: Sequence[str]) -> int:
    logging.disable(logging.WARNING)  # the table lists what is repaired
    return run_table(arguments, "python tests/faults", "fault", FAULTS, FAULTS, HEADINGS)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
