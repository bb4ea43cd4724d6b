"""Apply each seeded defect in a copy of this tree, and report the share that a test catches.

::

    python tests/defects [--only PATTERN] [--jobs 2] [--tests PATH ...]

A defect whose tests fail without it is not counted. ``--tests`` replaces those of the list, to look for any test that
catches a defect. The exit code is 1 if a defect no longer applies, or if its tests fail without it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder: its modules are imported by their full names

from tests.defects.seeded import ROOT, Defect, TreeCopy, read_defects  # noqa: E402


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="regular expression of the names of the defects that are applied")
    parser.add_argument("--jobs", type=int, default=2, help="copies of the tree that are tested at a time")
    parser.add_argument("--tests", nargs="*", default=[], help="tests to run for every defect")
    asked = parser.parse_args(arguments)
    defects = read_defects(asked.only)
    stale = {one.name: why for one in defects if (why := one.problem(ROOT)) is not None}
    for name, why in stale.items():
        print(f"{name} no longer applies: {why}")
    defects = [one for one in defects if one.name not in stale]
    with tempfile.TemporaryDirectory(prefix="defects-") as folder:
        copies = [TreeCopy.made(Path(folder) / str(number)) for number in range(max(asked.jobs, 1))]
        wrong = failing_without(copies, sorted({test for one in defects for test in asked.tests or one.tests}))
        for test in wrong:
            print(f"{test} fails without a defect: its file is not counted", flush=True)
        files = {test.partition("::")[0] for test in wrong}
        found = caught_by(copies, [one for one in defects if files.isdisjoint(asked.tests or one.tests)], asked.tests)
    report([one for one in defects if one.name in found], found)
    return 1 if stale or wrong else 0


def failing_without(copies: Sequence[TreeCopy], tests: Sequence[str]) -> list[str]:
    """Return tests that fail without any defect; each copy runs a part of them."""
    parts = [(copy, tests[at :: len(copies)]) for at, copy in enumerate(copies)]
    with ThreadPoolExecutor(len(copies)) as team:
        found = team.map(lambda part: part[0].failing(part[1]) if part[1] else [], parts)
        return [one for some in found for one in some]


def caught_by(copies: Sequence[TreeCopy], defects: Sequence[Defect], tests: Sequence[str]) -> dict[str, str | None]:
    """Return the test that catches each defect, by name; None where none does."""
    free: SimpleQueue[TreeCopy] = SimpleQueue()
    for copy in copies:
        free.put(copy)

    def judged(defect: Defect) -> tuple[str, str | None]:
        copy = free.get()
        try:
            test = copy.caught_by(defect, tests or defect.tests)
        finally:
            free.put(copy)
        print(f"{defect.name}: {test or 'NOT CAUGHT'}", flush=True)
        return defect.name, test

    with ThreadPoolExecutor(len(copies)) as team:
        return dict(team.map(judged, defects))


def report(defects: Sequence[Defect], found: dict[str, str | None]) -> None:
    """Print the share that is caught, by area, and a table of the others."""
    every = Counter(one.area for one in defects)
    caught = Counter(one.area for one in defects if found[one.name] is not None)
    print(f"\ncaught: {caught.total()} of {every.total()} defects")
    print(", ".join(f"{area} {caught[area]} of {number}" for area, number in every.items()))
    for one in defects:
        if found[one.name] is None:
            print(f"not caught: {one.name} | {one.file} | {one.old.strip()} -> {one.new.strip()}")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
