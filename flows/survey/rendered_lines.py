"""Lines of a simulated sweep, rendered a few blocks ahead by threads of this process, and taken in their order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from threading import Semaphore

from pipeline.geometry.scan import Sweep
from pipeline.simulator.simulated import BLOCK_LINES, SimulatedSource
from pipeline.source import Line, Source
from storage.parallel.crew import Crew, run_blocks

Take = Callable[[Line], None]


def take_lines(
    source: Source, sweep: Sweep, take: Take, crew: Crew, *, first: int = 0, at_once: int = BLOCK_LINES
) -> None:
    """Give ``take`` the sweep's lines one by one, in order, from line ``first`` on.

    ``take`` is called in this thread while others render. Beside one block of ``at_once`` lines for each worker there
    is one more, so that nobody waits while lines are taken. Where ``take`` raises, what was rendered ahead is lost.
    A source that is no simulation gives its lines when it has them.
    Neither the number of workers nor the size of blocks changes a line.

    Raises
    ------
    What ``take`` raises; what the first block that cannot be rendered does, once the lines before it are taken.
    """
    workers = rendering_crew(crew)
    if workers.count == 1 or not isinstance(source, SimulatedSource):
        for line in source.lines(sweep, first):
            take(line)
        return
    blocks = [range(start, min(start + at_once, sweep.lines)) for start in range(first, sweep.lines, at_once)]
    make = partial(_rendered, source, sweep, Semaphore(workers.count))
    run_blocks(make, blocks, replace(workers, workers=workers.count + 1), keep=False, each=_InOrder(take, first))


def rendering_crew(crew: Crew) -> Crew:
    """Who renders: threads of this process, whoever else makes blocks, for the scene lies in its memory."""
    return Crew("threads", crew.workers)


def _rendered(source: SimulatedSource, sweep: Sweep, free: Semaphore, numbers: range) -> list[Line] | Exception:
    """Lines of one block once a worker is free, or why there are none: to be raised in their turn, not before."""
    with free:
        try:
            return source.lines_of(sweep, numbers)
        except Exception as error:
            return error


class _InOrder:
    """Takes blocks as they end, and holds back those that wait for an earlier one."""

    def __init__(self, take: Take, first: int) -> None:
        self._take, self._next = take, first
        self._waiting: dict[int, list[Line] | Exception] = {}

    def __call__(self, numbers: range, made: list[Line] | Exception) -> None:
        self._waiting[numbers.start] = made
        while self._next in self._waiting:
            lines = self._waiting.pop(self._next)
            if isinstance(lines, Exception):
                raise lines
            for line in lines:
                self._take(line)
            self._next += len(lines)
