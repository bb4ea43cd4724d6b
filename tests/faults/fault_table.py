"""The failure table: rows with the injected fault, the requirement and the result, and their layout."""

from __future__ import annotations

import argparse
import importlib
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

from tests.benchmarks.measure import aligned, markdown_lines

HEADINGS = ("fault", "how it is injected", "times", "demanded", "found", "met", "s")
WIDTHS = (22, 36, 6, 40, 44, 3, 5)


@dataclass(frozen=True)
class Row:
    """One fault: ``count`` is the number of injections, ``met`` whether the requirement is met."""

    fault: str
    injected: str
    count: int
    demanded: str
    found: str
    met: bool
    seconds: float = 0.0  # since the row before; set by `run_table`

    @property
    def cells(self) -> tuple[str, ...]:
        """Return the row as text, in the order of ``HEADINGS``."""
        *words, met, seconds = astuple(self)
        return (*map(str, words), "yes" if met else "NO", f"{seconds:.0f}")


Rows = Callable[[bool], Iterable[Row]]  # quick or in full


def reported_wrong(wrong: Sequence[str]) -> str:
    """Return the number of unmet requirements, and the first three."""
    return f"{len(wrong)} wrong{': ' + '; '.join(wrong[:3]) if wrong else ''}"


def run_table(
    arguments: Sequence[str],
    prog: str,
    what: str,
    tables: Mapping[str, Rows],
    usual: Iterable[str],
    headings: Sequence[str],
) -> int:
    """Make the requested rows, or the usual ones; print the table, and write it as Markdown if a file is given.

    A requirement that is not met is printed in the table, the other rows follow, and the exit code is 1.
    """
    parser = argparse.ArgumentParser(prog=prog, description=f"One table of every {what} that is asked for.")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(tables)}; by default {', '.join(usual)}")
    parser.add_argument("--quick", action="store_true", help="a small part of each")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table as Markdown as well")
    asked = parser.parse_args(arguments)
    unknown = sorted(set(asked.names) - set(tables))
    if unknown:
        parser.error(f"no {what} {', '.join(unknown)}; there are: {', '.join(tables)}")
    found: list[Row] = []
    for name in asked.names or usual:
        for row in _tried(name, tables[name], asked.quick):
            found.append(row)
            print(f"{row.fault}: {row.found}", flush=True)
    cells = [headings, *(row.cells for row in found)]
    print(f"\n{aligned(cells, WIDTHS)}")
    missed = [row.fault for row in found if not row.met]
    print(f"\n{len(found) - len(missed)} of {len(found)} as demanded{': not ' + ', '.join(missed) if missed else ''}")
    if asked.markdown:
        asked.markdown.write_text("\n".join([*markdown_lines(cells), ""]), encoding="utf-8")
    return 1 if missed else 0


def _tried(name: str, rows: Rows, quick: bool) -> Iterator[Row]:
    """Yield the rows of one table with their seconds, and one more if it crashes; a row without a try is not met."""
    began = time.monotonic()
    try:
        for row in rows(quick):
            yield replace(row, met=row.met and row.count > 0, seconds=time.monotonic() - began)
            began = time.monotonic()
    except Exception:
        traceback.print_exc()
        spent = time.monotonic() - began
        yield Row(name, "", 0, "that it can be tried", "crashed; the others went on", False, spent)


def rows_of(place: str) -> Rows:
    """Return the rows of ``module`` or ``module:function``, which is imported at the first call."""
    module, _, name = place.partition(":")

    def rows(quick: bool) -> Iterable[Row]:
        found: Iterable[Row] = getattr(importlib.import_module(module), name or "rows")(quick)
        return found

    return rows
