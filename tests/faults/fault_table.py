"""The failure table: what was done to an archive, what was demanded and what came, in rows, and how they are set."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

HEADINGS = ("fault", "how it is injected", "times", "demanded", "found", "met", "s")
WIDTHS = (22, 36, 6, 40, 44, 3, 5)


@dataclass(frozen=True)
class Row:
    """One fault: ``count`` is how often it was injected, ``met`` whether what was found is what was demanded."""

    fault: str
    injected: str
    count: int
    demanded: str
    found: str
    met: bool
    seconds: float

    @property
    def cells(self) -> tuple[str, ...]:
        """The row in words, in the order of ``HEADINGS``."""
        *words, met, seconds = astuple(self)
        return (*map(str, words), "yes" if met else "NO", f"{seconds:.0f}")


class Clock:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Seconds by now."""
        return time.monotonic() - self._began


Rows = Callable[[bool], Sequence[Row]]  # quick or in full


def plain_table(rows: Sequence[Row], headings: Sequence[str] = HEADINGS) -> str:
    """Rows in aligned columns, long texts folded inside their own."""
    cells = [headings, *(row.cells for row in rows)]
    widths = [min(width, max(len(line[column]) for line in cells)) for column, width in enumerate(WIDTHS)]
    lines = [line for cell in cells for line in _folded(cell, widths)]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def markdown_table(rows: Sequence[Row], headings: Sequence[str] = HEADINGS) -> str:
    """Rows as a table of Markdown."""
    lines = [f"| {' | '.join(headings)} |", "|" + "---|" * len(headings)]
    lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row.cells)} |" for row in rows]
    return "\n".join([*lines, ""])


def _folded(cells: Sequence[str], widths: Sequence[int]) -> list[str]:
    """One row of cells as lines of text."""
    columns = [textwrap.wrap(text, width) or [""] for text, width in zip(cells, widths, strict=True)]
    return [
        "  ".join(
            (column[line] if line < len(column) else "").ljust(width)
            for column, width in zip(columns, widths, strict=True)
        )
        for line in range(max(map(len, columns)))
    ]
