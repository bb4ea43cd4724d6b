"""The mirror's vector memory: which held positions go into which load, and where in the memory, in half-open ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from pipeline.errors import SettingsError

Ends = Literal["exclusive", "inclusive"]


class Held(Protocol):
    """What takes room in the memory: lines that hold ``step`` positions each. A ``Sweep`` is one."""

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def lines(self) -> int:
        """Lines of the sweep."""

    @property
    def step(self) -> int:
        """Positions held during each line."""


@dataclass(frozen=True)
class MemoryPart:
    """Lines ``lines[0]`` to ``lines[1]`` of a sweep in the pairs ``pairs[0]`` to ``pairs[1]`` of a load, half open."""

    sweep: int  # place in the list of sweeps
    lines: tuple[int, int]
    pairs: tuple[int, int]


@dataclass(frozen=True)
class Load:
    """What the memory holds at one time. A pair is an X and a Y; both channels lie in one vector, Y behind X."""

    parts: tuple[MemoryPart, ...]

    @property
    def pairs(self) -> int:
        """Pairs in the memory."""
        return self.parts[-1].pairs[1]

    def channels(self, part: MemoryPart) -> tuple[tuple[int, int], tuple[int, int]]:
        """Give the cells (start, stop) of a part's X and of its Y in the one vector, half open."""
        start, stop = part.pairs
        return (start, stop), (self.pairs + start, self.pairs + stop)


def memory_loads(sweeps: Sequence[Held], vector_pairs: int) -> list[Load]:
    """Lay the positions of sweeps into the memory, in their order, each load as full as whole lines allow.

    A load takes what is left of one sweep and begins the next; a line's held positions are never parted.

    Parameters
    ----------
    vector_pairs
        Pairs of X and Y that the memory holds.

    Raises
    ------
    SettingsError : the positions of one line do not fit the memory.
    """
    loads: list[Load] = []
    parts: list[MemoryPart] = []
    used = 0
    for number, sweep in enumerate(sweeps):
        _check_line(sweep, vector_pairs)
        line = 0
        while line < sweep.lines:
            room = (vector_pairs - used) // sweep.step
            if room == 0:
                loads.append(Load(tuple(parts)))
                parts, used = [], 0
                continue
            taken = min(room, sweep.lines - line)
            parts.append(MemoryPart(number, (line, line + taken), (used, used + taken * sweep.step)))
            line, used = line + taken, used + taken * sweep.step
    return [*loads, Load(tuple(parts))] if parts else loads


def count_loads(sweeps: Sequence[Held], vector_pairs: int) -> int:
    """Count the loads of :func:`memory_loads`, without laying them out.

    Raises
    ------
    SettingsError : the positions of one line do not fit the memory.
    """
    loads, used = 0, vector_pairs
    for sweep in sweeps:
        _check_line(sweep, vector_pairs)
        rest = sweep.lines - min((vector_pairs - used) // sweep.step, sweep.lines)
        if rest == 0:
            used += sweep.lines * sweep.step
            continue
        most = vector_pairs // sweep.step
        more = -(-rest // most)
        loads, used = loads + more, (rest - (more - 1) * most) * sweep.step
    return loads


def _check_line(sweep: Held, vector_pairs: int) -> None:
    if sweep.step > vector_pairs:
        raise SettingsError(
            f"sweep {sweep.name} holds {sweep.step} positions in each line, the mirror's vector memory {vector_pairs} "
            f"pairs; take a smaller coarse factor"
        )


def device_range(cells: tuple[int, int], ends: Ends) -> tuple[int, int]:
    """Give a half-open range as the device counts it: the end is the cell after the last, or the last itself.

    Which of the two the device means is not settled (erratum E14), so it is a setting of the driver; everything else
    here is half open.

    Raises
    ------
    SettingsError : the range is empty or begins below 0.
    """
    start, stop = cells
    if start < 0 or stop <= start:
        raise SettingsError(f"a channel plays at least one cell from 0 on, got the half-open range {start}:{stop}")
    return start, stop if ends == "exclusive" else stop - 1
