"""The application of the command line: where each verb stands, what they share, how they read lists; completion."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.markup import escape

from flows.terminal.progress import on_stderr
from pipeline.errors import SettingsError
from pipeline.setting_fields import numbers_of

VERBS = {  # by what is typed: the module of the function, loaded once it is asked for
    "survey": "flows.cli.survey_verbs",
    "simulate": "flows.cli.survey_verbs",
    "rig check": "flows.cli.survey_verbs",
    "rig emulate": "flows.cli.survey_verbs",
    "plan": "flows.archive.plan_command",
    "ls": "flows.archive.commands",
    "explain": "flows.archive.commands",
    "verify": "flows.archive.commands",
    "gc": "flows.archive.commands",
    "compare": "flows.archive.compare_command",
    "export": "flows.archive.export_command",
    "ingest": "flows.archive.ingest_command",
    "reprocess": "flows.archive.reprocess_command",
    "serve": "flows.schedule.serve_command",
    "report": "flows.archive.history",
    "init": "flows.training.init_command",
    "train": "flows.cli.model_verbs",
    "evaluate": "flows.cli.model_verbs",
    "tradeoff": "flows.cli.model_verbs",
    "completion": "flows.cli.app",
}
GOES_ON = ("survey", "train", "evaluate", "export", "reprocess", "simulate", "serve")  # verbs that keep what is done
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


def build_app(*, listed: bool) -> App:
    """The application; with ``listed`` its help has a line for each verb, read without loading what the verb needs."""
    app = App(
        name="spectralzoom",
        version=lambda: importlib.metadata.version("spectralzoom"),
        help="Survey a field: the best map for the seconds, by one scan or by a second pass where it changes the map.",
        suppress_keyboard_interrupt=False,  # main says what an interrupted survey leaves
    )
    rig = App(name="rig", help="Check a rig before a survey, or emulate one to try surveys on.")
    app.command(rig)
    for words, module in VERBS.items():
        group, name = (rig if words.startswith("rig ") else app), words.split()[-1]
        summary = {"help": _summary(module, name)} if listed else {}  # given here, it is all that the verb's help says
        group.command(f"{module}:{name}", name=name, **summary)
    return app


def _summary(module: str, function: str) -> str:
    """The first paragraph of a function's docstring, from the source."""
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
    """The folder ``out`` whole, if it does not lie in the archive at ``root`` (SettingsError)."""
    folder = out.resolve()
    if folder.is_relative_to(root.resolve()):
        raise SettingsError(f"--out {folder} lies in the archive, where nothing else belongs; choose another folder")
    return folder


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
    """Whole numbers with commas, of which 4-7 is a run; SettingsError naming the flag."""
    try:
        return None if text is None else [int(str(one)) for part in split_list(text) for one in numbers_of(part)]
    except ValueError:
        raise SettingsError(f"{flag} expects whole numbers with commas, got {text!r}") from None


def completion(shell: Literal["bash", "zsh", "fish"]) -> int:
    """Print a script by which SHELL completes verbs, flags and choices of spectralzoom.

    For bash: spectralzoom completion bash > ~/.local/share/bash-completion/completions/spectralzoom

    Parameters
    ----------
    shell
        bash, zsh (as _spectralzoom in a folder of its fpath) or fish (in ~/.config/fish/completions).
    """
    sys.stdout.write(build_app(listed=False).generate_completion(prog_name="spectralzoom", shell=shell))
    return 0
