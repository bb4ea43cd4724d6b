"""Read and check the settings of a survey: flags, then one TOML file, then defaults."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import MISSING
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pydantic import Field, PlainValidator, TypeAdapter, ValidationError

from spectralzoom.flows.settings.survey_settings import (
    ALWAYS,
    AUTO,
    BUILT_IN_SCENES,
    OF_A_CAMERA,
    OF_A_VIEW,
    OF_CHOOSING,
    OF_RECORDINGS,
    OF_TWO_PASSES,
    PATHS,
    RASTER,
    RECORDED,
    RIG,
    RIG_FIELD,
    UNIFORM,
    USUAL_BUDGET,
    Settings,
    source_of,
)
from spectralzoom.flows.settings.values import EXTENT_PART, EXTENT_WHOLE, parse_moment, parse_text
from spectralzoom.pipeline.errors import BudgetError, PoseError, SettingsError
from spectralzoom.pipeline.planning.fine_pass import FIRST_STEPS
from spectralzoom.pipeline.rig.device_settings import MOST_PAIRS
from spectralzoom.pipeline.setting_fields import format_number, span_of
from spectralzoom.pipeline.simulator.scenes.built_in import SCOUTING_NAMES
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import USUAL_DAY, USUAL_HOUR
from spectralzoom.storage.readers.recordings import find_recorded_run
from spectralzoom.storage.runs import Run, moment_of
from spectralzoom.storage.store import is_archive
from spectralzoom.storage.whole_files import read_toml


@dataclasses.dataclass(frozen=True)
class Declared:
    """One setting."""

    item: dataclasses.Field[Any]
    kind: Any  # its type, None left out

    @property
    def about(self) -> dict[str, Any]:
        """Return unit, source and example."""
        return cast(dict[str, Any], self.item.metadata["json_schema_extra"])

    @property
    def choices(self) -> tuple[str, ...]:
        """Return the allowed words of a setting with a fixed list."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def listed(self) -> str:
        """Return these words as text."""
        return ("  " if any("," in word for word in self.choices) else ", ").join(self.choices)

    @property
    def expected(self) -> str:
        """Return the allowed values, for "must be ..."; empty where the setting has its own parser."""
        if self.choices:
            return f"one of {self.listed}"
        low, high = span_of(self.item)
        if self.kind is float:
            return format_number(low, high, self.about["unit"], endless=self.item.default == math.inf)
        return {int: f"a whole number from {low} to {high}", bool: "true or false", str: "text that is not empty"}.get(
            self.kind, ""
        )

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        known = {name: value for name, value in self.item.metadata.items() if value is not None}
        if self.kind is float:
            known["allow_inf_nan"] = self.item.default == math.inf
        kind: Any = Annotated[self.kind, PlainValidator(parse_text) if self.kind is str else Field(**known)]
        return TypeAdapter(kind)

    def read(self, value: object, place: str) -> object:
        """Return the value, from text or TOML. Raises SettingsError, BudgetError: ``place`` has no such value."""
        if self.kind is str and value == self.item.default == "":
            return value
        try:
            return self._adapter.validate_python(value, strict=not isinstance(value, str))  # text may be a number
        except ValidationError as error:
            cause = error.errors()[0].get("ctx", {}).get("error")
        if isinstance(cause, ValueError):  # of its own parser
            joint = ": " if isinstance(cause, SettingsError) else " "
            raise (BudgetError if isinstance(cause, BudgetError) else SettingsError)(f"{place}{joint}{cause}")
        raise SettingsError(f"{place} must be {self.expected}{';' if self.choices else ','} got {value!r}")


def _declared(make: type[Any]) -> dict[str, Declared]:
    own = {datetime: Annotated[datetime, PlainValidator(parse_moment)]}
    hints = get_type_hints(make, include_extras=True)
    found = {}
    for item in dataclasses.fields(make):
        hint = hints[item.name]
        if get_origin(hint) in (types.UnionType, Union):
            (hint,) = (part for part in get_args(hint) if part is not types.NoneType)
        found[item.name] = Declared(item, own.get(hint, hint))
    return found


SURVEY = _declared(Settings)
TABLES = {
    name: _declared(one.kind)
    for name, one in SURVEY.items()
    if isinstance(one.kind, type) and dataclasses.is_dataclass(one.kind)
}

OF_THE_PLAN = ("zoom", *UNIFORM, *OF_TWO_PASSES, "macs", "scan_exposure_ms", "extent")
OF_THE_RUN = (
    *("camera", "cost", "rig", "pose", "zones", "resampling", "pointing_px", "seed", "sky", "weights"),
    *("expected_loss", "signal"),
)
BUILT_IN_WEIGHTS = "farm"
FLAGS = {  # of settings in tables; other keys of tables have none
    **{"camera.exposure_ms": "exposure_ms", "sky.light": "sky", "sky.light_fraction": "light_fraction"},
    **{f"zones.{name}": name for name in ("area", "plots", "plots_name")},
}


def usual_of_recording(table: Mapping[str, object]) -> dict[str, Any]:
    """Return the defaults of the settings beside ``sweeps``: those of the run that took them, where one is named.

    So `survey --sweeps ARCHIVE/runs/NAME` plans as that run did, and its visit is the time of that run.
    Raises SceneError, ArchiveError: there is no such recording or run.
    """
    if table.get("source", RECORDED) != RECORDED:
        return {}
    usual: dict[str, Any] = {"source": RECORDED, "scene": RIG_FIELD}
    requested = {name for name in OF_THE_PLAN if table.get(name) is not None}
    found = find_recorded_run(str(table["sweeps"]))
    if found is not None:
        run, shape, _ = found
        uniform = run.settings.get("zoom") != ALWAYS and any(run.settings.get(name) is not None for name in UNIFORM)
        another_plan = requested - {"macs"} if uniform else requested & {*UNIFORM, "macs"}
        names = OF_THE_RUN if another_plan else (*OF_THE_RUN, *OF_THE_PLAN)
        usual |= {name: run.settings[name] for name in names if run.settings.get(name) is not None}
        usual |= {"name": str(run.receipt.get("survey") or run.folder.name), "visit": time_of_visit(run)}
        usual |= {} if shape is None else {"size": shape[::-1]}
        if run.settings.get("weights") is None and run.settings.get("scene") in BUILT_IN_SCENES:
            usual["weights"] = BUILT_IN_WEIGHTS
    return usual


def load_settings(
    path: str | Path | None = None,
    flags: Mapping[str, object] | None = None,
    *,
    usual: Mapping[str, object] | None = None,
) -> Settings:
    """Return the checked settings of a TOML file (None: no file) and of flags, which override it.

    Relative paths in the file start at its folder, those of flags at the current one. Flags have the keys of the file,
    with ``camera.exposure_ms`` for a key in a table; a value None is ignored. ``usual`` overrides the defaults.
    Raises SettingsError, BudgetError: the first key that is not allowed, with its place and the allowed values.
    """
    table, origin = _read_table(path, flags or {})
    if table.get("source") == SURVEY["source"].item.default:
        del table["source"]
    stated = {key for key, value in table.items() if value is not None}
    listed = stated - {key for key, place in origin.items() if place == "flag"}  # a file may list defaults
    stated -= {key for key in listed & {*OF_TWO_PASSES} if table[key] == SURVEY[key].item.default}
    stated -= {*OF_CHOOSING} if "macs" in stated else set()
    if "sweeps" in stated and not isinstance(table["sweeps"], str | Path):
        raise SettingsError(f"{place_of('sweeps', origin.get('sweeps'))} must be a path, got {table['sweeps']!r}")
    recorded = usual_of_recording(table) if "sweeps" in stated else {}
    for name in TABLES:
        inner = table.get(name)
        if isinstance(inner, Mapping):
            table[name] = {**recorded.pop(name, {}), **inner}
    requested = {**(usual or {}), **recorded, **table}
    for wrong in _contradictions(stated, origin, zooms=requested.get("zoom") == ALWAYS):
        raise SettingsError(wrong)
    zooms = requested.get("zoom") == ALWAYS
    lasts = any(requested.get(name) is not None for name in ("seconds", "budget"))
    if (zooms or stated & {*OF_TWO_PASSES}) and not lasts and not _is_map(requested):
        requested["budget"] = USUAL_BUDGET
    others = ("sweeps", "pointing_px", "macs", "scan_step", "budget")
    planned = zooms or "extent" in stated or any(requested.get(name) is not None for name in others)
    revisits = requested.get("prior", AUTO) not in (AUTO, "none") and requested.get("seconds") is not None
    if revisits and not planned and not _is_map(requested):  # the prior map can choose the lines of a revisit
        requested["extent"] = EXTENT_PART
    return parse_settings(requested, origin)


def _read_table(path: str | Path | None, flags: Mapping[str, object]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the settings of a file and of flags, and the source of each: the file's name or ``flag``."""
    try:
        table: dict[str, Any] = {} if path is None else anchor_paths(read_toml(Path(path)), Path(path).parent)
    except FileNotFoundError:
        raise SettingsError(f"no settings file {path}; give the path of a survey's TOML file, or none") from None
    except ValueError as error:
        scene = f"; a scene is given as --scene {path}" if Path(str(path)).suffix != ".toml" else ""
        raise SettingsError(f"cannot read the settings file {path}: {error}; expected TOML in UTF-8{scene}") from None
    origin = dict.fromkeys(table, str(path))
    for name in TABLES:
        inner = table.get(name)
        origin |= {f"{name}.{key}": str(path) for key in inner} if isinstance(inner, Mapping) else {}
    for key, value in flags.items():
        if value is not None:
            head, _, tail = key.rpartition(".")
            inner = table.get(head, {})
            table[head or key] = {**inner, tail: value} if head and isinstance(inner, Mapping) else value
            origin[key] = "flag"
    return table, origin


def _is_map(table: Mapping[str, object]) -> bool:
    scene = table.get("scene") or SURVEY["scene"].item.default
    return (table.get("source") or source_of(str(scene))) == RASTER


def parse_settings(table: Mapping[str, object], origin: Mapping[str, str] | None = None) -> Settings:
    """Check a table of settings with tables in it, as in the file, and fill in the defaults; None is ignored.

    ``origin`` names the source of each (dotted) key for messages: a file or ``flag``. Raises SettingsError.
    """
    origin = origin or {}
    settings = Settings(**_check_table(table, SURVEY, "", origin))

    def at(name: str) -> str:
        return place_of(name, origin.get(name))

    for check in (_camera_errors, _scene_errors, _air_errors, _recorded_errors, _extent_errors, _limit_errors):
        for error in check(settings, at):
            raise SettingsError(error)
    return settings


def _check_table(
    table: Mapping[str, object], declared: Mapping[str, Declared], prefix: str, origin: Mapping[str, str]
) -> dict[str, Any]:
    checked: dict[str, Any] = {}
    for key, value in table.items():
        full = prefix + key
        place = place_of(full, origin.get(full))
        if value is None:
            continue
        if key not in declared:
            everywhere = [*SURVEY, *(f"{name}.{inner}" for name, keys in TABLES.items() for inner in keys)]
            near = [name for name in everywhere if name.split(".")[-1] == key]
            near = near or [prefix + name for name in difflib.get_close_matches(key, declared, n=1, cutoff=0.5)]
            every = f"known keys: {', '.join(prefix + name for name in declared)}"
            hint = f"did you mean '{near[0]}'?" if near else every
            raise SettingsError(f"unknown setting {place}; {hint}")
        if not prefix and key in TABLES:
            checked[key] = _parse_table(key, value, place, origin)
        else:
            checked[key] = declared[key].read(value, place)
    return checked


def _parse_table(key: str, value: object, place: str, origin: Mapping[str, str]) -> object:
    if not isinstance(value, Mapping):
        raise SettingsError(f"{place} must be a table, [{key}] with keys below it; got {value!r}")
    stated = _check_table(value, TABLES[key], f"{key}.", origin)
    missing = [name for name, one in TABLES[key].items() if one.item.default is MISSING and name not in stated]
    if missing:
        raise SettingsError(f"[{key}] lacks {', '.join(missing)}; give every one, or leave the table out")
    try:
        return SURVEY[key].kind(**stated)
    except PoseError as error:
        raise SettingsError(f"[{key}]: {error}") from None


def of_this_version(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a receipt that this version knows."""
    return {key: value for key, value in stored.items() if key in SURVEY}


def anchor_paths(table: dict[str, object], folder: Path) -> dict[str, object]:
    """Return the settings of a file with relative paths that start at its folder."""
    anchored = dict(table)
    for key in PATHS:
        head, _, tail = key.rpartition(".")
        inner = anchored.get(head) if head else anchored
        value = inner.get(tail) if isinstance(inner, Mapping) else None
        if isinstance(value, str) and value and value not in (*BUILT_IN_SCENES, RIG_FIELD) and "://" not in value:
            try:
                path = str(folder / Path(value).expanduser())
            except RuntimeError:
                raise SettingsError(f"{key!r}: there is no user of {value.partition('/')[0]!r}; give a path") from None
            anchored |= {head: {**inner, tail: path}} if head and isinstance(inner, Mapping) else {tail: path}
    return anchored


def _contradictions(stated: set[str], origin: Mapping[str, str], *, zooms: bool) -> Iterator[str]:
    """Yield errors: settings that choose different scans."""

    def named(names: Iterable[str]) -> list[str]:
        return [place_of(key, origin.get(key)) for key in names if key in stated]

    uniform = [] if zooms else named(UNIFORM)  # which a first pass has too
    passes = named(OF_TWO_PASSES)
    if uniform and passes:
        yield (
            f"{uniform[0]} asks for one uniform scan of the field, and {passes[0]} is for a survey that captures "
            "again; leave one of them out"
        )
    for exposure in named(("coarse_exposure_ms", "scan_exposure_ms")) if "sweeps" in stated else ():
        yield f"{exposure} is for a camera, and recorded lines have their own: leave it out"
    by_hand = named(("scan_step", "scan_exposure_ms"))
    if by_hand and not zooms and "seconds" in stated:
        yield f"{uniform[0]} leaves the choice of the scan to the weights' record, {by_hand[0]} makes it: leave one out"
    if "scan_exposure_ms" in stated and "scan_step" not in stated:
        yield f"{by_hand[0]} is for a uniform scan: give --scan-step too (1 for every line), or --coarse-exposure-ms"


def _camera_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings of a camera for a raster. The IFOV is that of its [pose]."""
    usual = Settings()
    changed: list[str] = []
    for name in OF_A_CAMERA:
        own, other = getattr(settings, name), getattr(usual, name)
        if name in TABLES:
            changed += [f"{name}.{key}" for key in TABLES[name] if getattr(own, key) != getattr(other, key)]
        elif own != other:
            changed.append(name)
    view = () if settings.pose is None else OF_A_VIEW
    for name in changed if settings.is_map else ():
        if name not in view:
            yield (
                f"{at(name)} is of a camera, and the scene {settings.scene} is a raster that no camera captures: leave "
                "it out, or give --source sim for a simulated capture of the file"
            )


def _scene_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings that the scene cannot have."""
    scene = settings.scene
    bands, wavelengths = settings.bands, settings.wavelengths
    if (settings.policy == "mask") != (settings.mask is not None):
        wants = "policy 'mask' needs a mask file" if settings.mask is None else "a mask is used by policy 'mask' only"
        yield f"{wants}: got policy = {settings.policy!r}, mask = {settings.mask!r}; give both or neither"
    if bands is not None and wavelengths is not None and len(bands) != len(wavelengths):
        yield f"{at('wavelengths')} must have one value for each of the {len(bands)} bands, got {len(wavelengths)}"
    if scene.partition("@")[0] in BUILT_IN_SCENES and scene not in BUILT_IN_SCENES and not Path(scene).exists():
        yield f"there is no scene {scene}: give one of {', '.join(BUILT_IN_SCENES)}, or a file; --seed has the seed"
    if scene == RIG_FIELD and settings.source not in (RIG, RECORDED):
        yield f"scene {RIG_FIELD!r} is what stands before a rig: give --source rig, or a file"
    if settings.source == RIG and settings.cost.vector_pairs > MOST_PAIRS:
        yield (
            f"cost.vector_pairs = {settings.cost.vector_pairs}: the mirror's vector memory takes at most {MOST_PAIRS} "
            "pairs; give its size"
        )
    if settings.is_map and scene in BUILT_IN_SCENES:
        yield f"source 'raster' takes the pixels of a file, and {scene} is built in: give --source sim, or a file"
    if settings.size is not None and scene not in (*BUILT_IN_SCENES, RIG_FIELD):
        yield f"size is for built-in scenes ({', '.join(BUILT_IN_SCENES)}); {scene} has its own"
    for name in ("day", "hour"):
        value = getattr(settings, name)
        if value is not None and scene not in BUILT_IN_SCENES:
            yield f"{at(name)} = {value:g} is for built-in scenes, whose crops grow; {scene} has fixed ones"
    if settings.interest is not None and scene not in SCOUTING_NAMES:
        yield (f"{at('interest')} = {settings.interest:g} is for the scene scouting, and the scene is {scene}")
    if settings.zones.plots_name is not None and settings.zones.plots is None:
        yield f"{at('zones.plots_name')} = {settings.zones.plots_name!r} names plots: give --plots FILE too"
    camera = settings.camera
    if camera.dark_dn >= camera.full_scale_dn:
        yield (
            f"camera.dark_dn = {camera.dark_dn:g} leaves no room below the {camera.full_scale_dn} DN of {camera.bits} "
            "bits; use a smaller dark level"
        )


def _air_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: distances of the air that contradict each other, or that a relief lacks."""
    air = settings.air
    if air.distance_m is None:
        if air.nearest_m is not None or air.farthest_m is not None:
            yield f"{at('air.nearest_m')} and air.farthest_m lie around air.distance_m: give it too, or leave them out"
        return
    near, far = air.nearest_m or air.distance_m, air.farthest_m or air.distance_m
    if not near <= air.distance_m <= far:
        yield (
            f"{at('air.nearest_m')} = {near:g}, air.distance_m = {air.distance_m:g} and air.farthest_m = {far:g}: the "
            "middle of the scene lies between its nearest and its farthest part"
        )
    if air.relief != "flat" and near == far:
        yield f"{at('air.relief')} = {air.relief!r} needs air.nearest_m or air.farthest_m: give one, or relief = 'flat'"


def _recorded_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings that a recording needs or cannot have."""
    if settings.source != RECORDED:
        for name in OF_RECORDINGS:
            if getattr(settings, name) is not None:
                yield (
                    f"{at(name)} is for recorded sweeps, and source = {settings.source!r}; give --source recorded with "
                    "--sweeps, or leave it out"
                )
        return
    if settings.sweeps is None:
        yield "source = 'recorded' reads sweeps that were taken before; give --sweeps, where they lie"
    else:
        sweeps, out = Path(settings.sweeps).resolve(), Path(settings.out).resolve()
        if out == (sweeps.parent if sweeps.is_file() else sweeps) and not is_archive(settings.out):
            yield f"{at('out')} = {settings.out!r} is the folder of the sweeps, and would hide them; choose another one"
    if settings.scene != RIG_FIELD:
        yield (
            f"{at('scene')} = {settings.scene!r}, and the field of recorded sweeps is what they show; leave it out, "
            "and give --labels FILE where there are some"
        )
    if settings.bands is not None:
        yield f"{at('bands')} is for scenes: all bands of a recording are read; leave it out"
    if settings.extent == EXTENT_PART:
        yield f"{at('extent')} = 'part' chooses lines to capture, and a recording has fixed lines; leave it out"


def _extent_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings of a partial scan without one, or that contradict it."""
    if settings.extent != EXTENT_WHOLE and settings.zooms:
        yield f"{at('extent')} is for one uniform scan; leave it out, or zoom and budget"
    if settings.extent == EXTENT_PART and settings.seconds is None:
        yield f"{at('extent')} = 'part' needs a time budget: give --seconds too"
    if settings.extent not in (EXTENT_WHOLE, EXTENT_PART) and settings.scan_step is None:
        yield f"{at('extent')} names lines of a uniform scan: give its --scan-step too"
    if settings.extent != EXTENT_WHOLE and settings.pointing_px:
        yield (
            f"{at('extent')} leaves sweeps out, and registration (pointing_px = {settings.pointing_px:g}) needs all "
            "of them; leave one of the two out"
        )
    if settings.max_age is not None and settings.extent == EXTENT_WHOLE:
        yield f"{at('max_age')} is for a partial scan: give --extent part too"


def _limit_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: a line spacing, or a limit of multiply-adds, that the survey cannot use."""
    if settings.zooms and settings.scan_step not in (None, *FIRST_STEPS):
        yield (
            f"{at('scan_step')} = {settings.scan_step}: the first of two passes takes every 4th or 8th line; give "
            f"{' or '.join(map(str, FIRST_STEPS))}, or leave it out"
        )
    if settings.zooms and settings.macs is not None:
        yield (
            f"{at('macs')} is for a uniform scan, and the survey takes two passes: leave it out, or --budget, "
            "--zoom always, --coarse-exposure-ms and --policy"
        )
    if settings.macs is not None and settings.extent != EXTENT_WHOLE:
        yield f"{at('macs')} chooses among the patches of a whole field, {at('extent')} covers a part: leave one out"


def place_of(key: str, origin: str | None) -> str:
    """Return how a message names a setting: as a flag, without its table, or with its file."""
    if origin == "flag" and "." not in (flag := FLAGS.get(key, key)):
        return "--" + flag.replace("_", "-")
    return f"'{key}'" + (f" in {origin}" if origin not in (None, "flag") else "")


def time_of_visit(run: Run) -> str | None:
    """Return the moment of a run's visit or file, else day and hour of a built-in scene, else when the run began.

    A day of a built-in scene counts in the year of the run. The moment is in ISO 8601 in UTC; None: nothing is known.
    """
    named = moment_of(run.acquired)
    began = moment_of(run.receipt.get("started")) or moment_of(run.created)
    found = named or began
    with suppress(TypeError, ValueError, OverflowError):
        if named is None and began is not None and run.settings.get("scene") in BUILT_IN_SCENES:
            day, hour = (run.settings.get(name) for name in ("day", "hour"))
            grown = timedelta(days=(USUAL_DAY if day is None else day) - 1, hours=USUAL_HOUR if hour is None else hour)
            found = datetime(began.astimezone(UTC).year, 1, 1, tzinfo=UTC) + grown
    with suppress(OverflowError):
        return None if found is None else found.astimezone(UTC).isoformat()
    return None
