"""Settings of a survey: one TOML file and flags, every key checked. Flags win over the file, it over the defaults."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, cast

from flows.settings.keys import BUILT_IN_SCENES, REPLACED, RIG_FIELD, SURVEY, TABLES, MapChoice, Parser
from flows.settings.rules import check_together, place_of
from flows.settings.values import Tolerance
from pipeline.errors import PoseError, SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.ground.view import RigPose
from pipeline.rig.survey_rig import SurveyRig
from pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from pipeline.simulator.scenes.farm.farm_scene import REMOVED_LAW, USUAL_DAY, USUAL_HOUR
from storage.archive.toml_files import read_toml
from storage.parallel.crew import Crew

OF_THE_MACHINE = ("scheduler", "workers")  # no byte depends on them; a cluster of that day need not be there today
_PATHS = ("scene", "labels", "out", "mask", "vgg", "weights")


@dataclass(frozen=True)
class Settings:
    """All that one survey needs to know. Make it by `load_settings` or `parse_settings`: they check; this does not."""

    name: str | None = None  # what the field is called; by default as its scene
    visit: str | None = None  # which look at it: another one is captured anew, the same one is gone on with
    scene: str = "farm"  # built-in name or a file
    labels: str | None = None
    bands: tuple[int, ...] | None = None  # of the file, counted from 0
    wavelengths: tuple[float, ...] | None = None  # [nm]
    source: str = "sim"
    out: str = "archive"
    budget: float = 0.5  # seconds of coarse and fine capture over those of the full scan, 0 < b <= 1
    policy: str = "gain"
    mask: str | None = None
    vgg: str | None = None  # VGG19's weights, for policies vgg-static and vgg-trained
    weights: str | None = None
    threshold: float | None = None  # least expected gain per second of fine capture [nat per px, summed over seats]
    seed: int = 0
    effects: str = "auto"  # of the simulated rig: auto, all, none, or names with commas
    tol: Tolerance = field(default_factory=Tolerance)  # what leaving effects out may change any number by
    accuracy: bool = True  # whether a map with labels is judged by them
    controls: bool = True
    engine: Literal["prefect", "plain"] = "prefect"
    memory: int = 4 * 1024**3  # [bytes]
    scheduler: str = "threads"  # who makes blocks: threads, processes, or tcp://host:port of a dask scheduler
    workers: int | None = None  # blocks at a time; None is one a core. A scheduler elsewhere has its own
    kernel: Literal["catmull-rom", "bilinear", "nearest"] = "catmull-rom"
    pointing_px: float = 0.0  # how far off the mirror may point; above 0 sweeps overlap and their seams are registered
    size: tuple[int, int] | None = None  # (width, height) of the built-in scene [px]
    day: int | None = None  # of the year, for the farm: 172 unless given
    hour: float | None = None  # true solar time, for the farm: 11 unless given [h]
    camera: LineCamera = field(default_factory=LineCamera)
    optics: Optics = field(default_factory=Optics)
    mirror: MirrorMotion = field(default_factory=MirrorMotion)
    detector: Detector = field(default_factory=Detector)
    air: Air = field(default_factory=Air)
    sky: Sky = field(default_factory=Sky)
    cost: CostModel = field(default_factory=CostModel)
    rig: SurveyRig = field(default_factory=SurveyRig)  # for source "rig"
    pose: RigPose | None = None  # without one nothing is put on the ground
    map: MapChoice = field(default_factory=MapChoice)

    @property
    def crew(self) -> Crew:
        """Who does the work that is cut into blocks."""
        return Crew(self.scheduler, self.workers)

    @property
    def shape(self) -> tuple[int, int] | None:
        """(y, x) of the built-in scene [px], None for its default."""
        return None if self.size is None else (self.size[1], self.size[0])

    @property
    def moment(self) -> tuple[int, float] | None:
        """Day of the year and true solar time [h] of the built-in scene; None of a scene that has none."""
        if self.scene not in BUILT_IN_SCENES:
            return None
        return USUAL_DAY if self.day is None else self.day, USUAL_HOUR if self.hour is None else self.hour

    @property
    def simulated_rig(self) -> Rig:
        """All that the simulator knows of the rig; SettingsError where its parts do not go together."""
        return Rig(self.camera, self.optics, self.mirror, self.detector, self.air, self.sky)

    def to_dict(self) -> dict[str, object]:
        """Plain values for the receipt, no password; `parse_settings` reads them back to the same settings."""
        plain = {key: plain_value(value) for key, value in (asdict(self) | {"tol": str(self.tol)}).items()}
        cast("dict[str, object]", plain["rig"]).pop("password")  # receipts are passed on
        return plain


def plain_value(value: object) -> object:
    """A value of the settings as JSON knows it: lists, and text for a moment."""
    if isinstance(value, Mapping):
        return {key: plain_value(item) for key, item in value.items()}
    if isinstance(value, datetime):
        return value.isoformat()
    return list(value) if isinstance(value, tuple) else value


def load_settings(path: str | Path | None = None, flags: Mapping[str, object] | None = None) -> Settings:
    """Read the file, lay the flags over it and check the whole.

    Parameters
    ----------
    path
        TOML file; None for defaults and flags alone. Relative paths in it start at its folder, those of flags at the
        current folder.
    flags
        Keys as in the file, ``camera.exposure_ms`` for one in a table; None means not given.

    Raises
    ------
    SettingsError, BudgetError : the first key that cannot be used, with its place and what it should be.
    """
    table = {} if path is None else anchor_paths(_read_toml(Path(path)), Path(path).parent)
    origin = dict.fromkeys(_flatten(table), str(path))
    for key, value in _flatten(flags or {}).items():
        if value is not None:
            _put(table, key, value)
            origin[key] = "flag"
    return parse_settings(table, origin)


def parse_settings(table: Mapping[str, object], origin: Mapping[str, str] | None = None) -> Settings:
    """Check a table of settings and fill in the defaults.

    Parameters
    ----------
    table
        Keys and values as in the file, ``camera``, ``cost``, ``pose`` and the like being tables themselves; None in
        them means not given.
    origin
        Where each (dotted) key came from, for the messages: a file's name or ``flag``.
    """
    origin = origin or {}
    checked = _check_table({k: v for k, v in table.items() if v is not None}, SURVEY, "", origin)
    settings = Settings(**checked)  # type: ignore[arg-type]
    check_together(settings, origin)
    return settings


def _check_table(
    table: Mapping[str, object], parsers: Mapping[str, Parser], prefix: str, origin: Mapping[str, str]
) -> dict[str, object]:
    """Every key of one table through its parser; an unknown one is refused with the nearest that exists."""
    checked: dict[str, object] = {}
    for key, value in table.items():
        full = prefix + key
        if key not in parsers:
            _refuse_key(full, parsers, prefix, origin.get(full))
        if prefix == "" and key in TABLES:
            checked[key] = _parse_table(key, value, origin)
        else:
            checked[key] = parsers[key](value, place_of(full, origin.get(full)))
    return checked


def _parse_table(key: str, value: object, origin: Mapping[str, str]) -> object:
    """One of the tables that stand for a dataclass of the pipeline."""
    if not isinstance(value, Mapping):
        place = place_of(key, origin.get(key))
        raise SettingsError(f"{place} must be a table, [{key}] with keys below it; got {value!r}")
    make, spans = TABLES[key]
    given = _check_table({k: v for k, v in value.items() if v is not None}, spans, f"{key}.", origin)
    missing = [item.name for item in fields(make) if _is_required(item) and item.name not in given]
    if missing:
        raise SettingsError(f"[{key}] lacks {', '.join(missing)}; give every one, or leave the table out")
    try:
        return make(**given)
    except PoseError as error:
        raise SettingsError(f"[{key}]: {error}") from None


def _is_required(item: Field[Any]) -> bool:
    return item.default is MISSING and item.default_factory is MISSING


def _refuse_key(full: str, known: Mapping[str, Parser], prefix: str, origin: str | None) -> None:
    """Raise for an unknown key, naming the nearest of its table, or of another table."""
    everywhere = [*SURVEY, *(f"{name}.{key}" for name, (_, spans) in TABLES.items() for key in spans)]
    short = full.removeprefix(prefix)
    near = [name for name in everywhere if name.split(".")[-1] == short]
    near = near or [prefix + key for key in difflib.get_close_matches(short, known, n=1, cutoff=0.5)]
    hint = f"; did you mean '{near[0]}'?" if near else f"; known keys: {', '.join(prefix + key for key in known)}"
    hint = f"; {REPLACED[full]}" if full in REPLACED else hint
    raise SettingsError(f"unknown setting {place_of(full, origin)}{hint}")


def of_this_version(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Give what a receipt says of settings that there are: keys of before are left out, in tables too.

    Raises
    ------
    SettingsError : the survey had two rounds of detail, of which this version would make but one.
    """
    if stored.get("rounds", 1) != 1:
        raise SettingsError(
            f"its survey had {stored['rounds']} rounds of detail, which never paid and were removed: survey the "
            "field by hand, without 'rounds'; what both share is in the archive; take what is damaged out first"
        )
    known = {key: value for key, value in stored.items() if key in SURVEY}
    return {
        key: {name: item for name, item in value.items() if name in TABLES[key][1]}
        if key in TABLES and isinstance(value, Mapping)
        else value
        for key, value in known.items()
    }


def _read_toml(path: Path) -> dict[str, object]:
    """The file's tables; a file that is not there or not TOML is an error with its place."""
    try:
        return read_toml(path)
    except FileNotFoundError:
        raise SettingsError(f"no settings file {path}; give the path of a survey's TOML file, or none") from None
    except ValueError as error:
        raise SettingsError(f"cannot read the settings file {path}: {error}; expected TOML in UTF-8") from None


def anchor_paths(table: dict[str, object], folder: Path) -> dict[str, object]:
    """Relative paths of a file's settings, made to start at the file's folder."""
    named = {*BUILT_IN_SCENES, REMOVED_LAW, RIG_FIELD}
    anchored = dict(table)
    for key in _PATHS:
        value = table.get(key)
        if isinstance(value, str) and value and value not in named and "://" not in value:
            anchored[key] = str(folder / Path(value).expanduser())
    return anchored


def _flatten(table: Mapping[str, object]) -> dict[str, object]:
    """Nested tables as dotted keys; what is no table stays."""
    flat: dict[str, object] = {}
    for key, value in table.items():
        if key in TABLES and isinstance(value, Mapping):
            flat.update({f"{key}.{inner}": item for inner, item in value.items()})
        else:
            flat[key] = value
    return flat


def _put(table: dict[str, object], key: str, value: object) -> None:
    """Set a dotted key, without changing the inner table that came in."""
    head, _, tail = key.partition(".")
    inner = table.get(head, {})
    table[head] = {**cast("Mapping[str, object]", inner), tail: value} if tail and isinstance(inner, Mapping) else value
