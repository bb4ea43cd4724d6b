"""Define the flags that verbs share: of archives and files, of lists of numbers, and one for each setting."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from pydantic import BeforeValidator

from spectralzoom.flows.settings.documents import about, toml_value
from spectralzoom.flows.settings.load import FLAGS, SURVEY, TABLES
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


def split_list(text: str | None) -> tuple[str, ...]:
    """Return the parts of a list with commas."""
    return tuple(part.strip() for part in str(text).split(",") if part.strip()) if text else ()


Names = Annotated[  # with commas, one a flag, or both
    tuple[str, ...],
    Parameter(negative="", converter=lambda _, tokens: split_list(",".join(token.value for token in tokens))),
    BeforeValidator(split_list),
]
IN_TABLES = {flag: setting for setting, flag in FLAGS.items()}
_IN_TABLES = {name: place.partition(".") for name, place in IN_TABLES.items()}
_DECLARED = SURVEY | {name: TABLES[table][key] for name, (table, _, key) in _IN_TABLES.items()}


def _flags(names: Iterable[str]) -> Any:
    """Return a dataclass of flags for these settings; None stands for a flag that is not given."""
    made = []
    for name in names:
        one = _DECLARED[name]
        kind: Any = bool if one.kind is bool else str
        help_text = about(one) + ("" if one.item.default is None else f"; default: {toml_value(one).strip(chr(34))}")
        made.append((name, Annotated[kind | None, Parameter(help=help_text)], None))
    return make_dataclass("Flags", made, frozen=True, kw_only=True)


_RENDERING = ("effects", "seed", "day", "hour", "interest", "sky", "light_fraction", "bands", "wavelengths")


@Parameter(name="*")
class SurveyFlags(_flags(name for name in _DECLARED if name not in TABLES or name in IN_TABLES)):  # type: ignore[misc]
    """Flags of all settings of a survey."""


@Parameter(name="*")
class SimulationFlags(_flags((*_RENDERING, "tol", "size", "exposure_ms", "workers"))):  # type: ignore[misc]
    """Flags of a simulated scan."""


def by_setting(flags: Any) -> dict[str, object]:
    """Return the values of flags by setting, for `load_settings`."""
    return {IN_TABLES.get(name, name): value for name, value in asdict(flags).items()}


NO_FLAGS = SurveyFlags()
NO_SIMULATION_FLAGS = SimulationFlags()


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
