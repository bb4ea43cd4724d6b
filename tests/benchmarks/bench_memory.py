"""What a field's memory is worth: maps of later visits beside those of anybody who remembers nothing, or looks no more.

A first visit takes every line with 25 ms, later ones every second line with 5 ms: a fifth of the seconds. Beside what
the memory makes of them stand the field scanned anew, the old map kept, the quick look alone, and the rule that anybody
would use: the old class, unless the new look is surer than .97 of another. A season is 30 visits six days apart; who
scans in full every k-th visit and holds the map between has the same seconds in all. Changes are planted into the scene
and looked for three days later. Farms that no training saw, each with noise of its own.

`python tests/benchmarks/bench_memory.py season` draws the season alone, `days` the visits after a few days, `changes`
what was planted, `light` fields that did not change under another sun.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence

from measure import Row
from visits.changes import other_light, planted_changes
from visits.seasons import after_days, revisits, season

PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "days": after_days,
    "revisits": revisits,
    "season": season,
    "changes": planted_changes,
    "light": other_light,
}


def rows() -> list[Row]:
    """All figures."""
    return [row for part in PARTS.values() for row in part()]


def main(arguments: Sequence[str]) -> int:
    """Print the rows of some parts."""
    parser = argparse.ArgumentParser(description="What a field's memory is worth.")
    parser.add_argument("parts", nargs="*", metavar="part", help=f"some of {', '.join(PARTS)}; all where none is given")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    for name in asked.parts or PARTS:
        for row in PARTS[name]():
            goal = "" if row.met is None else f", goal {row.goal}: {'met' if row.met else 'MISSED'}"
            print(f"{row.what}: {row.figure}{goal}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
