"""Observers of a survey: a terminal, the pages and logs of Prefect, or both."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from flows.tasks.prefect_tasks import inside_flow
from pipeline.lazy import deferred

if TYPE_CHECKING:
    import prefect
    import prefect.artifacts as prefect_artifacts
else:
    prefect = deferred("prefect")
    prefect_artifacts = deferred("prefect.artifacts")

PROGRESS_EVERY_S = 2.0


@dataclass(frozen=True)
class Observer:
    """Take what a survey says of itself."""

    watch: Callable[[str, str, float], None] = lambda stage, state, done: None  # how far (0..1) a stage is
    note: Callable[[str], None] = lambda words: None  # what was assumed, and what the user should know
    say: Callable[[str], None] = lambda words: None  # what a device is at, while no line comes
    log: Callable[[str], None] = lambda words: None  # one line for each stage that ended
    progress: Callable[[str, float], None] = lambda title, fraction: None  # how far (0..1) the survey is, and at what


_terminal: ContextVar[Observer | None] = ContextVar("observer", default=None)


@contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Have surveys of the block followed by ``observer``, beside Prefect's pages."""
    before = _terminal.set(observer)
    try:
        yield
    finally:
        _terminal.reset(before)


def current_observer() -> Observer:
    """Return who follows a survey that is opened now."""
    terminal = _terminal.get() or Observer()
    if not inside_flow():
        return terminal

    def note(words: str) -> None:
        terminal.note(words)
        log_to_run(words)

    return replace(terminal, note=note, log=log_to_run, progress=_ProgressPage().show)


def log_to_run(words: str) -> None:
    """Write a line into the log of the flow or task that runs; a server that is gone stops no survey."""
    with suppress(Exception):
        prefect.get_run_logger().info(words)


class _ProgressPage:
    """Show on Prefect's pages how far a survey is, every two seconds at most."""

    def __init__(self) -> None:
        self._artifact: Any = None
        self._last = -PROGRESS_EVERY_S

    def show(self, title: str, fraction: float) -> None:
        """Bring the run's progress artifact up to date, or create it; a server that is gone stops no survey."""
        now = time.monotonic()
        if now - self._last < PROGRESS_EVERY_S and fraction < 1:
            return
        self._last, percent = now, round(100 * fraction, 1)
        with suppress(Exception):
            if self._artifact is None:
                self._artifact = prefect_artifacts.create_progress_artifact(percent, description=title)
            else:
                prefect_artifacts.update_progress_artifact(self._artifact, progress=percent, description=title)
