"""Run the benchmarks in this folder and print one table: python tests/benchmarks [name ...].

A name is the part of the file name after bench_. Missed goals are printed too. A benchmark that crashes is named, the
others still run, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

# One thread, set before numpy and torch are loaded, as all figures are for one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parents[1])]

from measure import Row, aligned  # noqa: E402

HEADINGS = ("what", "figure", "goal", "met", "peers")
WIDTHS = (58, 26, 24, 3, 60)
MET = {True: "yes", False: "NO", None: "-"}


def main(arguments: Sequence[str]) -> int:
    """Run the requested benchmarks, or all, and print the table."""
    parser = argparse.ArgumentParser(prog="python tests/benchmarks", description="Benchmarks with goals and peers.")
    parser.add_argument("names", nargs="*", help="benchmarks to run, as in bench_NAME.py; all where none is given")
    asked = parser.parse_args(arguments)
    there = sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))
    if unknown := sorted(set(asked.names) - set(there)):
        parser.error(f"no benchmark {', '.join(unknown)}; there are: {', '.join(there)}")
    tables: dict[str, Sequence[Row]] = {}
    failed = []
    print(_machine())
    for name in asked.names or there:
        began = time.perf_counter()
        try:
            tables[name] = importlib.import_module(f"bench_{name}").rows()
        except Exception:
            failed.append(name)
            traceback.print_exc()
            print(f"\n{name}: crashed; the others go on")
            continue
        print(f"\n{name} ({time.perf_counter() - began:.0f} s)")
        print(aligned(_cells_of(tables[name]), WIDTHS), flush=True)
    goals = [row for rows in tables.values() for row in rows if row.met is not None]
    missed = [row.what for row in goals if not row.met]
    print(f"\n{len(goals) - len(missed)} of {len(goals)} goals met", end="")
    print(f"; missed: {'; '.join(missed)}" if missed else "")
    if failed:
        print(f"crashed: {', '.join(failed)}")
    return 1 if failed else 0


def _cells_of(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    return [HEADINGS, *((row.what, row.figure, row.goal or "-", MET[row.met], row.peers or "-") for row in rows)]


def _machine() -> str:
    """Return processor, cores, load and versions in one line."""
    from spectralzoom.flows.tradeoff import describe_machine

    it = describe_machine()
    versions = ", ".join(f"{name} {version}" for name, version in it["versions"].items())
    return f"{it['processor']}, {it['cores']} cores, load {it['load']}, one thread; {versions}"


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
