"""Build the command line: its verbs, shared parameters and parsers of lists."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from rich.markup import escape

from flows.terminal.progress import on_stderr
from pipeline.errors import SettingsError
from pipeline.setting_fields import numbers_of

VERBS = {  # verb: module of its function, loaded on demand
    "survey": "flows.cli.survey_verbs",
    "simulate": "flows.cli.simulate_command",
    "rig check": "flows.cli.rig_commands",
    "rig emulate": "flows.cli.rig_commands",
    "plan": "flows.archive.plan_command",
    "ls": "flows.archive.commands",
    "explain": "flows.archive.commands",
    "verify": "flows.archive.commands",
    "gc": "flows.archive.commands",
    "export": "flows.archive.export_command",
    "ingest": "flows.archive.ingest_command",
    "reprocess": "flows.archive.reprocess_command",
    "serve": "flows.cli.serve_command",
    "report": "flows.archive.history",
    "init": "flows.training.init_command",
    "train": "flows.cli.model_verbs",
    "evaluate": "flows.cli.model_verbs",
    "tradeoff": "flows.tradeoff.command",
}
GOES_ON = ("survey", "train", "export", "reprocess", "simulate", "serve")  # verbs that resume
stderr = on_stderr()

ArchiveName = Annotated[str, Parameter(help="The archive's folder, or s3://bucket/prefix.")]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print one JSON object on stdout.")]
Switch = Annotated[bool, Parameter(negative="")]  # without a --no- form
OutFile = Annotated[Path, Parameter(name=("--out", "-o"))]
OutFolder = Annotated[Path | None, Parameter(name=("--out", "-o"))]
Scheduler = Annotated[
    str, Parameter(help="Worker pool: `threads`, `processes`, or the address of a dask scheduler, tcp://host:port.")
]
Workers = Annotated[int | None, Parameter(help="Number of workers; default: one per core.")]


def build_app(*, listed: bool) -> App:
    """Return the application; with ``listed`` its help has a line for each verb, read without importing the verb."""
    app = App(
        name="spectralzoom",
        version=lambda: importlib.metadata.version("spectralzoom"),
        help="Survey a field with a hyperspectral line scanner: class map, receipt and report.",
        suppress_keyboard_interrupt=False,  # main reports it
    )
    rig = App(name="rig", help="Check the hardware, or emulate it.")
    app.command(rig)
    for verb, module in VERBS.items():
        group = rig if verb.startswith("rig ") else app
        name = verb.split()[-1]
        summary = {"help": _summary(module, name)} if listed else {}  # replaces all of the verb's own help
        group.command(f"{module}:{name}", name=name, **summary)
    app.register_install_completion_command(name="completion", add_to_startup=False)
    return app


def _summary(module: str, function: str) -> str:
    """Return the first paragraph of a function's docstring, from the source."""
    found = importlib.util.find_spec(module)
    assert found is not None
    assert found.origin is not None
    parts = ast.parse(Path(found.origin).read_bytes()).body
    own = next(part for part in parts if isinstance(part, ast.FunctionDef) and part.name == function)
    return (ast.get_docstring(own) or "").partition("\n\n")[0]


def say(message: str) -> None:
    """Print an error on stderr, as one message."""
    stderr.print(f"[bold red]error[/]: {escape(message)}", highlight=False, soft_wrap=True)


def check_outside(out: Path, root: Path) -> Path:
    """Return the absolute folder ``out``. Raises SettingsError: it lies in the archive at ``root``."""
    folder = out.resolve()
    if folder.is_relative_to(root.resolve()):
        raise SettingsError(f"--out {folder} lies in the archive, where nothing else belongs; choose another folder")
    return folder


def split_list(text: str | None) -> tuple[str, ...]:
    """Return the parts of a list with commas."""
    return tuple(part.strip() for part in str(text).split(",") if part.strip()) if text else ()


def parse_numbers(text: str | None, flag: str) -> list[float] | None:
    """Return numbers with commas. Raises SettingsError: names the flag."""
    try:
        return None if text is None else [float(part) for part in split_list(text)]
    except ValueError:
        raise SettingsError(f"{flag} expects numbers with commas, got {text!r}") from None


def parse_wholes(text: str | None, flag: str) -> list[int] | None:
    """Return whole numbers with commas; 4-7 is a range. Raises SettingsError: names the flag."""
    try:
        return None if text is None else [int(str(one)) for part in split_list(text) for one in numbers_of(part)]
    except ValueError:
        raise SettingsError(f"{flag} expects whole numbers with commas, got {text!r}") from None
