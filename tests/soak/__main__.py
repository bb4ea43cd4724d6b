"""Run the parts in this folder and print one table: python tests/soak [part ...] [--quick] [--markdown FILE].

A demand that is not met is printed in the table, the other parts still run, and the exit code is 1.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

# One thread, set before numpy and torch are loaded, as all figures are for one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path[0] = str(ROOT)  # not this folder: its modules are imported by their full names
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))

from tests.faults.fault_table import rows_of, run_table  # noqa: E402

PARTS = {"survey-rig": rows_of("tests.soak.rig_beside_simulation")}
HEADINGS = ("what", "how", "times", "demanded", "found", "met", "s")


def main(arguments: Sequence[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that SIGTERM cleans up processes and disks, too
    return run_table(arguments, "python tests/soak", "part", PARTS, ["survey-rig"], HEADINGS)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
