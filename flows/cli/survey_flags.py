"""The flags that name a survey's settings: each is text, which the settings check, and its help is their own."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, make_dataclass
from typing import Annotated, Any

from cyclopts import Parameter

from flows.settings.declared import SURVEY, TABLES
from flows.settings.documents import flag_help

IN_TABLES = {"exposure_ms": "camera.exposure_ms"}  # flags of what a settings file has in a table
_DECLARED = SURVEY | {name: TABLES["camera"][name] for name in IN_TABLES}


def _flags(names: Iterable[str]) -> Any:
    """A dataclass of such flags, all of them None where nothing was given."""
    given = []
    for name in names:
        one = _DECLARED[name]
        kind: Any = bool if one.kind is bool else str
        given.append((name, Annotated[kind | None, Parameter(help=flag_help(one))], None))
    return make_dataclass("Flags", given, frozen=True, kw_only=True)


_Every: Any = _flags(name for name in _DECLARED if name not in TABLES)
_RENDERING = ("effects", "seed", "day", "hour", "bands", "wavelengths")
_OfRendering: Any = _flags(_RENDERING)
_OfSimulation: Any = _flags((*_RENDERING, "tol", "size", "exposure_ms", "workers"))


@Parameter(name="*")
class SurveyFlags(_Every):  # type: ignore[misc]
    """What was given of a survey's settings; None where nothing was."""


@Parameter(name="*")
class RenderingFlags(_OfRendering):  # type: ignore[misc]
    """What was given of how a simulated rig sees its scene."""


@Parameter(name="*")
class SimulationFlags(_OfSimulation):  # type: ignore[misc]
    """The same, and how it is computed."""


def by_setting(flags: Any) -> dict[str, object]:
    """Values of flags by the settings that they are of, as `load_settings` takes them."""
    return {IN_TABLES.get(name, name): value for name, value in asdict(flags).items()}
