"""Run the parts beside this file and print one table: python tests/soak [part ...] [--quick] [--markdown FILE].

A demand that is not met is printed like one that is, the others go on, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

# Before numpy and torch are loaded: one thread, as the figures are meant.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path[0] = str(ROOT)  # not this folder: its modules go by their full names
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))

from tests.faults.fault_table import Clock, Row, markdown_table, plain_table  # noqa: E402

PARTS = {
    "survey-rig": "rig_beside_simulation",
    "day": "day_of_surveys",
    "scheduler": "prefect_schedule",
    "loaded": "loaded_schedule",
}
SOAK = ("day", "scheduler", "loaded")  # where no part is named
HEADINGS = ("what", "how", "times", "demanded", "found", "met", "s")


def main(arguments: Sequence[str]) -> int:
    """Run the parts asked for; print the table, and write it as Markdown where asked."""
    parser = argparse.ArgumentParser(prog="python tests/soak", description="Surveys for hours, and through the rig.")
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; by default {' and '.join(SOAK)}")
    parser.add_argument("--quick", action="store_true", help="a small part of each")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table as Markdown as well")
    asked = parser.parse_args(arguments)
    unknown = sorted(set(asked.parts) - set(PARTS))
    if unknown:
        parser.error(f"no part {', '.join(unknown)}; there are: {', '.join(PARTS)}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that processes and disks are cleared up then, too
    found: list[Row] = []
    for name in asked.parts or SOAK:
        clock = Clock()
        print(f"{name}:", file=sys.stderr, flush=True)
        try:
            found += importlib.import_module(f"tests.soak.{PARTS[name]}").rows(asked.quick)
        except Exception:
            traceback.print_exc()
            found.append(Row(name, "", 0, "that it can be tried", "crashed; see above", False, clock.seconds))
    print(f"\n{plain_table(found, HEADINGS)}")
    missed = [row.fault for row in found if not row.met]
    print(f"\n{len(found) - len(missed)} of {len(found)} as demanded{': not ' + ', '.join(missed) if missed else ''}")
    if asked.markdown:
        asked.markdown.write_text(markdown_table(found, HEADINGS), encoding="utf-8")
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
