"""The command line's one application, and how verbs speak and read lists."""

from __future__ import annotations

import importlib.metadata

from cyclopts import App
from rich.console import Console
from rich.markup import escape

from pipeline.errors import SettingsError


def _version() -> str:
    return importlib.metadata.version("spectralzoom")


app = App(
    name="spectralzoom",
    version=_version,
    help="Survey a field: look coarsely at everything, finely where it changes the map.",
    suppress_keyboard_interrupt=False,  # main says what an interrupted survey leaves
)
stderr = Console(stderr=True)
GOES_ON = ("survey", "train", "export", "reprocess")  # verbs that keep what they have done when they are interrupted


def say(message: str) -> None:
    """Print an error on stderr, as one message."""
    stderr.print(f"[bold red]error[/]: {escape(message)}", highlight=False, soft_wrap=True)


def split_list(text: str | None) -> tuple[str, ...]:
    """Parts of a list with commas; none without one."""
    return tuple(part.strip() for part in text.split(",") if part.strip()) if text else ()


def parse_numbers(text: str | None, flag: str) -> list[float] | None:
    """Numbers with commas; SettingsError naming the flag."""
    try:
        return None if text is None else [float(part) for part in split_list(text)]
    except ValueError:
        raise SettingsError(f"{flag} expects numbers with commas, got {text!r}") from None


def parse_wholes(text: str | None, flag: str) -> list[int] | None:
    """Whole numbers with commas; SettingsError naming the flag."""
    try:
        return None if text is None else [int(part) for part in split_list(text)]
    except ValueError:
        raise SettingsError(f"{flag} expects whole numbers with commas, got {text!r}") from None
