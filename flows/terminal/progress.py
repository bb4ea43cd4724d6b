"""The terminal: text without control characters, and the progress of long work, as bars or as lines of a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, Progress, Task, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from spectralzoom.flows.terminal.figures import format_seconds
from spectralzoom.pipeline.errors import visible
from spectralzoom.storage.whole_files import to_json

PIPED_WIDTH = 120  # of tables without a terminal


class Terminal(Console):
    """A console that prints control characters and marks of direction as escapes."""

    def render_str(self, text: str, **choices: Any) -> Text:
        return super().render_str(visible(text), **choices)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable; the console's own control codes stay."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)


def on_stderr() -> Terminal:
    """Return the console for progress and messages."""
    return Terminal(stderr=True, highlight=False)


stderr = on_stderr()


def show_warnings(texts: Iterable[str], console: Console) -> None:
    """Print warnings about a map, one a line."""
    for text in texts:
        console.print(f"[yellow]Warning: {escape(text)}[/]", soft_wrap=True)


def say(message: str) -> None:
    """Print an error on stderr, as one message."""
    stderr.print(f"[bold red]error[/]: {escape(message)}", highlight=False, soft_wrap=True)


def show_text(text: str, console: Console = stderr) -> None:
    """Print text without markup, and leave the folding of its line to the terminal."""
    console.print(escape(text), soft_wrap=True)


def on_stdout() -> Terminal:
    """Return the console for results."""
    return Terminal(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else PIPED_WIDTH)


def print_json(content: Mapping[str, object]) -> None:
    """Print one object on stdout; numbers that are not finite become null."""
    sys.stdout.write(to_json(content))


def put_out(content: dict[str, Any], show: Callable[[dict[str, Any], Console], None], *, as_json: bool) -> None:
    """Print an answer on stdout: as one JSON object, or by ``show``."""
    if as_json:
        print_json(content)
    else:
        show(content, on_stdout())


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    left: int = 1,
    title: str | None = None,
    whole: Sequence[str] = (),
) -> Table:
    """Return a table of rows of markup; the first ``left`` columns are left-aligned, those in ``whole`` never fold."""
    made = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        header_style="dim",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )
    for number, name in enumerate(columns):
        justify: Literal["left", "right"] = "left" if number < left else "right"
        made.add_column(name, justify=justify, overflow="fold", no_wrap=name in whole)
    for row in rows:
        made.add_row(*row)
    return made


Listener = Callable[[str, float, float], None]  # stage, work done, work in all
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def heard_by(listener: Listener | None) -> Iterator[None]:
    """Report the progress of the stages in the block also to ``listener``, unless it is None."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


LINE_EVERY_S = 30.0
TITLE, BAR, TIME = 30, 10, 12  # columns


class _TimeLeft(TimeRemainingColumn):
    """The time that is left, by its name."""

    def render(self, task: Task) -> Text:
        return Text("left ") + super().render(task)


class StageProgress:
    """One bar per stage; a context manager around the work."""

    def __init__(self, console: Console, titles: Mapping[str, str] | None = None) -> None:
        self.console = console
        self.titles = dict(titles or {})
        self._tasks: dict[str, TaskID] = {}
        self._printed: dict[str, float] = {}
        self._now: tuple[str, float] | None = None  # the stage that runs, and how far it is
        self._listener = _listener.get()
        cut: Any = {"no_wrap": True, "overflow": "ellipsis"}
        self._bars = Progress(
            TextColumn("{task.description}", markup=False, table_column=Column(width=TITLE, **cut)),
            BarColumn(BAR),
            TimeElapsedColumn(table_column=Column(width=7)),
            _TimeLeft(table_column=Column(width=TIME)),
            TextColumn(
                "{task.fields[text]}",
                markup=False,
                table_column=Column(max_width=max(console.width - TITLE - BAR - TIME - 11, 8), **cut),
            ),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> StageProgress:
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def show(self, stage: str, done: float, text: str = "", *, ended: bool = False) -> None:
        """Show the progress of a stage, 0..1, with a word or number; ``ended`` also where it failed."""
        self._now = None if ended else (stage, done)
        if self._listener is not None:
            self._listener(stage, done, 1.0)
        title = self.titles.get(stage, stage)
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(title, total=1.0, text="")
            self._printed[stage] = time.monotonic()
        self._bars.update(self._tasks[stage], completed=done, text=text)
        if not self.console.is_terminal and (ended or time.monotonic() - self._printed[stage] > LINE_EVERY_S):
            self._printed[stage] = time.monotonic()
            left = None if ended else self._bars.tasks[self._tasks[stage]].time_remaining
            time_left = "" if left is None else f", {format_seconds(left)} left"
            self.console.print(f"{title}: {done:.0%} {escape(text)}".rstrip() + time_left, soft_wrap=True)

    def watch(self, stage: str, title: str, state: str, done: float) -> None:
        """Show the progress of a running stage by its title, or its end: ran, cached, failed."""
        self.titles[stage] = title
        running = state == "running"
        self.show(stage, done, "" if running else state, ended=not running)

    def say(self, text: str) -> None:
        """Show text beside the running stage; do nothing where none runs."""
        if self._now is not None:
            self.show(*self._now, text)


@contextmanager
def one_after_the_other(console: Console) -> Iterator[Callable[[str, float, str], None]]:
    """Yield a function that shows bars of consecutive parts: title, progress (0..1) and a number as text.

    A part ends where the next begins, and the last with the block.
    """
    last = ""
    with StageProgress(console) as progress:

        def report(what: str, done: float, figure: str) -> None:
            nonlocal last
            if last not in ("", what):
                progress.show(last, 1.0, ended=True)
            last = what
            progress.show(what, done, figure)

        yield report
        progress.show(last, 1.0, ended=True)
