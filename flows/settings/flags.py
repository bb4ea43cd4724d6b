"""Define the flags that verbs share: of archives and files, of lists of numbers, and one for each setting."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter
from pydantic import BeforeValidator

from spectralzoom.flows.settings.documents import about
from spectralzoom.flows.settings.load import declared, flag_of
from spectralzoom.flows.settings.settings import MACHINE, OUTPUT, SCENE, TIME, Settings
from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.setting_fields import numbers_of

ArchiveName = Annotated[str, Parameter(help="The archive's folder.")]
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print one JSON object on stdout.")]
Switch = Annotated[bool, Parameter(negative="")]  # without a --no- form
OutFile = Annotated[Path, Parameter(name=("--out", "-o"))]
OutFolder = Annotated[Path | None, Parameter(name=("--out", "-o"))]
Scheduler = Annotated[
    str, Parameter(help="Worker pool: `threads`, `processes`, or the address of a dask scheduler, tcp://host:port.")
]
Workers = Annotated[int | None, Parameter(help="Number of workers; default: one per core.")]
WorkersBucket = Annotated[
    str | None,
    Parameter(name="--bucket", help="Bucket by which workers of a dask scheduler get stores that they lack."),
]


def split_list(text: str | None) -> tuple[str, ...]:
    """Return the parts of a list with commas."""
    return tuple(part.strip() for part in str(text).split(",") if part.strip()) if text else ()


Names = Annotated[  # with commas, one a flag, or both
    tuple[str, ...],
    Parameter(negative="", converter=lambda _, tokens: split_list(",".join(token.value for token in tokens))),
    BeforeValidator(split_list),
]
HelpAll = Annotated[bool, Parameter(negative="", help="Print the flags of every setting, and exit.")]
GROUPS = {name: Group(name, sort_key=number) for number, name in enumerate((SCENE, TIME, OUTPUT, MACHINE))}
KEYS = tuple(  # of settings that may stand on a command line
    f"{table}.{key}".lstrip(".")
    for table, keys in declared(Settings).items()
    for key, one in keys.items()
    if not one.get("writeOnly")
)


def _flags(keys: Iterable[str], *, all_shown: bool) -> Any:
    """Return a dataclass of flags for settings such as ``camera.samples``; None stands for a flag that is not given.

    The first page of the help has the settings of a group, and the others if ``all_shown``.
    """
    made = []
    for full in keys:
        table, _, key = full.rpartition(".")
        one = declared(Settings)[table][key]
        kind: Any = bool if one.get("type") == "boolean" else str
        page: Any = {"group": GROUPS[one["group"]]} if one["group"] else {"show": all_shown}
        flag = Parameter(name=flag_of(full), help=about(one, usual=True), **page)
        made.append((full.replace(".", "__"), Annotated[kind | None, flag], None))
    return make_dataclass("Flags", made, frozen=True, kw_only=True)


RENDERING = ("effects", "seed", "day", "hour", "interest", "bands", "wavelengths", "tol", "size", "workers")
SIMULATED = ("camera.", "optics.", "mirror.", "detector.", "air.", "sky.")
OF_A_SIMULATION = tuple(key for key in KEYS if key in RENDERING or key.startswith(SIMULATED))


@Parameter(name="*")
class SurveyFlags(_flags(KEYS, all_shown=False)):  # type: ignore[misc]
    """Flags of all settings of a survey."""


@Parameter(name="*")
class SimulationFlags(_flags(OF_A_SIMULATION, all_shown=True)):  # type: ignore[misc]
    """Flags of a simulated scan."""


def by_setting(flags: Any) -> dict[str, object]:
    """Return the values of flags by setting, for `load_settings`."""
    return {name.replace("__", "."): value for name, value in asdict(flags).items()}


NO_FLAGS = SurveyFlags()
NO_SIMULATION_FLAGS = SimulationFlags()


def print_every_flag() -> int:
    """Print every setting with its flag, table by table; return the exit code."""
    for title, keys in declared(Settings).items():
        print(f"\n[{title}]  {Settings.model_fields[title].description}" if title else "")
        for key, one in keys.items():
            if one.get("writeOnly"):
                continue
            flag = flag_of(f"{title}.{key}".lstrip("."), off=one.get("usual") is True)
            print(textwrap.fill(f"{flag:28} {about(one, usual=True)}", 120, subsequent_indent=" " * 29))
    return 0


def check_outside(out: Path, root: Path) -> Path:
    """Return the absolute folder ``out``. Raises SettingsError: it lies in the archive at ``root``."""
    folder = out.resolve()
    if folder.is_relative_to(root.resolve()):
        raise SettingsError(f"--out {folder} lies in the archive, where nothing else belongs; choose another folder")
    return folder


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
