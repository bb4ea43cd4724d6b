"""Report what a survey does to the terminal and to Prefect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from spectralzoom.flows.stage import inside_flow
from spectralzoom.flows.terminal.figures import format_seconds
from spectralzoom.flows.terminal.progress import show_text
from spectralzoom.models.network.machine import give_back_freed_memory
from spectralzoom.storage.arrays.layout import consolidate_stores


def tidy_up(folder: Path) -> None:
    """Consolidate the metadata of a store that was built, and give the memory of its making back."""
    consolidate_stores(folder)
    give_back_freed_memory()


@dataclass(frozen=True)
class Observer:
    """Callbacks that report what a survey does."""

    watch: Callable[[str, str, str, float], None] = lambda *_: None  # name, title, state and progress (0..1) of a stage
    note: Callable[[str], None] = lambda text: None  # assumptions
    warn: Callable[[str], None] = lambda text: None  # warnings about the map, before it is drawn
    say: Callable[[str], None] = lambda text: None  # state of a device before its first line
    log: Callable[[str], None] = lambda text: None  # one line for each finished stage
    carry: Callable[[Callable[[], Any]], Any] = lambda work: work()  # calls the work of a flow


_terminal: ContextVar[Observer | None] = ContextVar("observer", default=None)


@contextmanager
def observed_by(observer: Observer) -> Iterator[None]:
    """Report the surveys of the block to ``observer`` as well as to Prefect."""
    before = _terminal.set(observer)
    try:
        yield
    finally:
        _terminal.reset(before)


def current_observer() -> Observer:
    """Return the observer of a survey that is opened now."""
    terminal = _terminal.get() or Observer()
    if not inside_flow():
        return terminal

    def note(text: str) -> None:
        terminal.note(text)
        log_to_run(text)

    def warn(text: str) -> None:
        terminal.warn(text)
        log_to_run(f"Warning: {text}")

    return replace(terminal, note=note, warn=warn, log=log_to_run)


def say_state(flow: Any, flow_run: Any, state: Any) -> None:
    """Print a line where a run of a deployment starts, ends, fails or crashes, with its message and seconds."""
    if flow_run.deployment_id is None:  # a survey by hand prints its own progress
        return
    if state.is_running():
        show_text(f"{flow_run.name}: started")
        return
    began = flow_run.start_time or state.timestamp
    seconds = format_seconds((state.timestamp - began).total_seconds())
    show_text(f"{flow_run.name}: {state.name.lower()} after {seconds}. {state.message or ''}".rstrip())


def log_to_run(text: str) -> None:
    """Write a line into the log of the Prefect run; errors of the server are ignored."""
    with suppress(Exception):
        from prefect import get_run_logger

        get_run_logger().info(text)
