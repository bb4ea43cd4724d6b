"""What a field's memory is worth: maps of later visits beside those of anybody who remembers nothing, or looks no more.

A first visit takes every line with 25 ms, later ones every second line with 5 ms: a fifth of the seconds. Beside what
the memory makes of them stand the field scanned anew, the old map kept, the quick look alone, and the rule that anybody
would use: the old class, unless the new look is surer than .97 of another. A season is 30 visits six days apart; who
scans in full every k-th visit and holds the map between has the same seconds in all. Changes are planted into the scene
and looked for three days later. Farms that no training saw, each with noise of its own.

`python tests/benchmarks/bench_memory.py season` draws the season alone, `days` the visits after a few days, `changes`
what was planted, `light` fields that did not change under another sun, `wrong` memories that are none of the field,
`parts` visits that look at a part: fields as wide as four strips of a narrower camera, `strips` a season of them,
`doubts` what a memory expects of itself that nobody looks after.
`storage --size 128x96 --visits 3` says what so many visits to so small a farm store; alone it takes 640x512 px, ten.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from measure import Row
from visits.changes import other_light, planted_changes
from visits.farm_visits import QUICK, REFERENCE, SEASON, SHAPE
from visits.parts import parts, season_of_parts, unwatched
from visits.seasons import after_days, season
from visits.stored_season import stored_rows
from visits.wrong_memories import wrong_memories

VISITS = 10  # of which it is measured what they store


def storage(size_px: tuple[int, int] = SHAPE, visits: int = VISITS) -> Iterator[Row]:
    """What the first visits of a season store, beside as many full scans."""
    return stored_rows(size_px, SEASON[:visits], QUICK, REFERENCE)


PARTS: dict[str, Callable[[], Iterator[Row]]] = {
    "days": after_days,
    "season": season,
    "changes": planted_changes,
    "light": other_light,
    "wrong": wrong_memories,
    "parts": parts,
    "strips": season_of_parts,
    "doubts": unwatched,
    "storage": storage,
}


def rows() -> list[Row]:
    """All figures."""
    return [row for part in PARTS.values() for row in part()]


def main(arguments: Sequence[str]) -> int:
    """Print the rows of some parts."""
    parser = argparse.ArgumentParser(description="What a field's memory is worth, and what it stores.")
    parser.add_argument("parts", nargs="*", metavar="part", help=f"some of {', '.join(PARTS)}; all where none is given")
    parser.add_argument("--size", default=f"{SHAPE[1]}x{SHAPE[0]}", help="of the farm of the part storage [px]")
    parser.add_argument("--visits", type=int, default=VISITS, help="of the part storage")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    columns, rows = map(int, asked.size.split("x"))
    parts = PARTS | {"storage": partial(storage, (rows, columns), asked.visits)}
    for name in asked.parts or parts:
        for row in parts[name]():
            goal = "" if row.met is None else f", goal {row.goal}: {'met' if row.met else 'MISSED'}"
            print(f"{row.what}: {row.figure}{goal}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
