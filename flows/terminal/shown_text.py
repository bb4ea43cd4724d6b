"""The terminal: what is printed there cannot steer it, whatever names and devices' words are made of."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from pipeline.errors import visible

PIPED_WIDTH = 120  # of tables where no terminal says how wide it is


class Terminal(Console):
    """A console on which control characters and marks of direction stand as escapes."""

    def render_str(self, text: str, **choices: Any) -> Text:
        """Text of a string, before it is measured."""
        return super().render_str(visible(text), **choices)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Segments of anything that is printed; the console's own controls are its own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(visible(segment.text), segment.style)


def on_stderr() -> Terminal:
    """Where progress and messages go."""
    return Terminal(stderr=True)


def on_stdout() -> Terminal:
    """Where results go."""
    return Terminal(file=sys.stdout, width=None if sys.stdout.isatty() else PIPED_WIDTH)


def print_json(content: Mapping[str, object]) -> None:
    """Print one object on stdout; numbers that are not finite become null."""
    from storage.archive.whole_files import to_json  # a command line that only refuses loads no storage

    sys.stdout.write(to_json(content))
