"""Progress of long work: bars on a terminal, a line now and then where the output is a log."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, Task, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

LINE_EVERY_S = 30.0
TITLE, NARROW = 34, 110  # columns of a title; a console of fewer is narrow
BARS = (8, 24)  # columns of a bar: narrow, wide
TIME = 7


class _WordsOrLeft(TimeRemainingColumn):
    """Words where there are some, else how long it will take still: they never share a narrow line."""

    def render(self, task: Task) -> Text:
        words = task.fields["words"]
        return Text(words) if words else Text("left ") + super().render(task)


class StageProgress:
    """One bar a stage; use as a context manager around the work."""

    def __init__(self, console: Console, titles: Mapping[str, str] | None = None) -> None:
        self.console, self.titles = console, titles or {}
        self._tasks: dict[str, TaskID] = {}
        self._said: dict[str, float] = {}
        self._now: tuple[str, float] | None = None  # the stage that runs, and how far it is
        bar = BARS[console.width >= NARROW]
        room = max(console.width - TITLE - bar - TIME - 3, TIME)
        self._bars = Progress(
            TextColumn(
                "{task.description}", markup=False, table_column=Column(width=TITLE, no_wrap=True, overflow="ellipsis")
            ),
            BarColumn(bar, table_column=Column(width=bar)),
            TimeElapsedColumn(table_column=Column(width=TIME)),
            _WordsOrLeft(table_column=Column(max_width=room, no_wrap=True, overflow="ellipsis")),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> StageProgress:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def show(self, stage: str, done: float, words: str = "", *, ended: bool = False) -> None:
        """Say how far a stage is, 0..1, with a word or figure beside it; ``ended`` also where it failed half-way."""
        self._now = None if ended else (stage, done)
        title = self.titles.get(stage, stage)
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(title, total=1.0, words="")
            self._said[stage] = time.monotonic()
        self._bars.update(self._tasks[stage], completed=done, words=words)
        due = time.monotonic() - self._said[stage] > LINE_EVERY_S
        if not self.console.is_terminal and (ended or due):
            self._said[stage] = time.monotonic()
            self.console.print(f"{title}: {done:.0%} {escape(words)}".rstrip(), highlight=False, soft_wrap=True)

    def say(self, words: str) -> None:
        """Put words beside the stage that runs, as far as it is; nothing where none runs."""
        if self._now is not None:
            self.show(*self._now, words)
