"""A crew: who makes blocks, how many at a time, and its workers for as long as it is open."""

from __future__ import annotations

import os
import pickle
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pipeline.errors import SettingsError

MOST_SENT = 2**18  # bytes that work or one of its items may take on its way to another process: paths, not arrays
_ADDRESS = re.compile(r"(tcp|tls)://[^\s/:]+:\d+|(tcp|tls)://\[[0-9a-fA-F:]+\]:\d+")


class Team(Protocol):
    """Workers on other processes that blocks can be sent to."""

    def run(self, make: Callable[[Any], Any], items: Sequence[Any], ended: Callable[[int, Any], None]) -> None:
        """Send blocks a few ahead of the oldest unfinished one, and give each result to ``ended``."""

    def check(self, paths: Sequence[Path]) -> None:
        """Refuse workers that see other files in these folders, or run other versions."""

    def close(self) -> None:
        """Let the workers go."""


@dataclass(frozen=True)
class Crew:
    """Who makes blocks: ``threads``, ``processes``, or the workers of a dask scheduler at ``tcp://host:port``."""

    scheduler: str = "threads"
    workers: int | None = None  # at a time; None is one a core. A scheduler elsewhere has workers of its own

    def __post_init__(self) -> None:
        if self.scheduler not in ("threads", "processes") and not _ADDRESS.fullmatch(self.scheduler):
            raise SettingsError(
                f"scheduler must be threads, processes, or the address of a dask scheduler such as "
                f"tcp://192.168.1.5:8786; got {self.scheduler!r}"
            )
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"workers must be at least 1, got {self.workers}")

    @property
    def elsewhere(self) -> bool:
        """Whether the workers belong to a scheduler that somebody else started."""
        return "://" in self.scheduler

    @property
    def shares_memory(self) -> bool:
        """Whether work may hold open files and arrays; otherwise it holds paths and is pickled."""
        return self.scheduler == "threads"

    @property
    def count(self) -> int:
        """Blocks at a time on this machine."""
        return count_cores() if self.workers is None else self.workers

    @contextmanager
    def open(self) -> Iterator[Crew]:
        """Keep this crew's workers from one `run_blocks` to the next until the block ends.

        Costs nothing by itself: they are started by the first `run_blocks` that needs them. May be nested.
        """
        with _guard:
            held = _open.setdefault(self, _Open())
            held.users += 1
        try:
            yield self
        finally:
            with _guard:
                held.users -= 1
                team = held.team if held.users == 0 else None
                if held.users == 0:
                    del _open[self]
            if team is not None:
                team.close()

    def team(self, start: Callable[[Crew], Team]) -> Team:
        """The workers of an open crew, started now where nobody needed them before."""
        with _guard:
            held = _open[self]
            held.team = held.team or start(self)
            return held.team

    def dismiss(self) -> None:
        """Let workers go that cannot be relied on any more: whoever needs the open crew next gets others."""
        with _guard:
            held = _open[self]
            team, held.team = held.team, None
        if team is not None:
            team.close()


THREADS = Crew()


@dataclass
class _Open:
    """A crew that is open, and its workers once they were needed."""

    users: int = 0
    team: Team | None = None


_guard = threading.RLock()
_open: dict[Crew, _Open] = {}


def count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_sendable(what: str, value: object) -> None:
    """Refuse what cannot travel to another process.

    Raises
    ------
    TypeError : it cannot be pickled, or is so large that it must hold arrays.
    """
    try:
        size = len(pickle.dumps(value))
    except Exception as error:
        raise TypeError(
            f"the {what} of blocks cannot be sent to other processes: expected a function of a module, or a dataclass "
            f"of paths and settings; got {type(value).__name__} ({error})"
        ) from None
    if size > MOST_SENT:
        raise TypeError(
            f"the {what} of blocks takes {size} bytes on its way to another process, at most {MOST_SENT} are allowed; "
            f"give {type(value).__name__} paths to open instead of arrays"
        )
