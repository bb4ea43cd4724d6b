"""The command line's one application, what its verbs have in common, and how they speak and read lists."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.markup import escape

from flows.terminal.shown_text import on_stderr
from pipeline.errors import SettingsError


def _version() -> str:
    return importlib.metadata.version("spectralzoom")


app = App(
    name="spectralzoom",
    version=_version,
    help="Survey a field: look coarsely at everything, finely where it changes the map.",
    suppress_keyboard_interrupt=False,  # main says what an interrupted survey leaves
)
stderr = on_stderr()
ArchiveName = Annotated[str, Parameter(help="The archive's folder, or s3://bucket/prefix.")]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print one JSON object on stdout.")]
Switch = Annotated[bool, Parameter(negative="")]  # off unless given
OutFile = Annotated[Path, Parameter(name=("--out", "-o"))]
OutFolder = Annotated[Path | None, Parameter(name=("--out", "-o"))]
Scheduler = Annotated[
    str, Parameter(help="Who works: `threads`, `processes`, or a dask scheduler elsewhere, tcp://host:port")
]
Workers = Annotated[int | None, Parameter(help="Blocks of the field at a time; one a core by default.")]
GOES_ON = (
    "survey",
    "train",
    "evaluate",
    "export",
    "reprocess",
    "simulate",
    "serve",
)  # verbs that keep what they have done when they are interrupted


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
