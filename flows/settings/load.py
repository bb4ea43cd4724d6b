"""Read a survey's settings, each key checked as `Settings` declares it: flags over one TOML file over defaults."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from collections.abc import Iterator, Mapping
from dataclasses import MISSING
from datetime import datetime
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import Field, PlainValidator, TypeAdapter, ValidationError

from flows.settings import renamed
from flows.settings.survey_settings import (
    ALWAYS,
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
    SPARING,
    UNIFORM,
    USUAL_BUDGET,
    MapChoice,
    Settings,
    source_of,
)
from flows.settings.values import EXTENT_PART, EXTENT_WHOLE, parse_moment, parse_text, to_whole, unit_guess
from pipeline.errors import BudgetError, PoseError, SettingsError
from pipeline.rig.device_settings import MOST_PAIRS
from pipeline.setting_fields import format_number, span_of
from pipeline.simulator.scenes.built_in import SCOUTING_NAMES
from storage.archive.staging import read_toml
from storage.readers.recordings import find_recorded_run


@dataclasses.dataclass(frozen=True)
class Declared:
    """One setting."""

    item: dataclasses.Field[Any]
    kind: Any  # its type, None left out

    @property
    def about(self) -> dict[str, Any]:
        about: dict[str, Any] = self.item.metadata["json_schema_extra"]
        return about

    @property
    def choices(self) -> tuple[str, ...]:
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()

    @property
    def listed(self) -> str:
        return ("  " if any("," in word for word in self.choices) else ", ").join(self.choices)

    @property
    def expected(self) -> str:
        """Return what it may be, as the end of "must be"; '' where only its own parser knows."""
        if self.choices:
            return f"one of {self.listed}"
        low, high = span_of(self.item)
        if self.kind is float:
            return format_number(low, high, self.about["unit"], endless=self.item.default == math.inf)
        words = {int: f"a whole number from {low} to {high}", bool: "true or false", str: "text that is not empty"}
        return words.get(self.kind, "")

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        known = {name: value for name, value in self.item.metadata.items() if value is not None}
        if self.kind is float:
            known["allow_inf_nan"] = self.item.default == math.inf
        kind: Any = Annotated[self.kind, PlainValidator(parse_text) if self.kind is str else Field(**known)]
        return TypeAdapter(kind)

    def _from_text(self, text: str) -> object:
        """The number or switch that a flag or a receipt says; what is none stays text."""
        if self.kind is int:
            return to_whole(text)
        if self.kind is bool:
            return {"true": True, "false": False}.get(text.lower(), text)
        try:
            return float(text) if self.kind is float else text
        except ValueError:
            return text

    def read(self, value: object, place: str) -> object:
        """Give the value, from text or TOML; SettingsError (of the budget BudgetError) with ``place`` otherwise."""
        if self.kind is str and value == self.item.default == "":
            return value
        try:
            return self._adapter.validate_python(
                self._from_text(value) if isinstance(value, str) else value, strict=True
            )
        except ValidationError as error:
            cause = error.errors()[0].get("ctx", {}).get("error")
        if isinstance(cause, ValueError):  # of its own parser
            joint = ": " if isinstance(cause, SettingsError) else " "
            raise (BudgetError if isinstance(cause, BudgetError) else SettingsError)(f"{place}{joint}{cause}")
        hint = unit_guess(value, *span_of(self.item), self.about["unit"]) if self.kind is float else ""
        why = f"; {self.about['why']}" if self.about["why"] else ""
        raise SettingsError(f"{place} must be {self.expected}{';' if self.choices else ','} got {value!r}{hint}{why}")


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


SURVEY = _declared(Settings)  # a table by the dataclass that it stands for
TABLES = {
    name: _declared(one.kind)
    for name, one in SURVEY.items()
    if isinstance(one.kind, type) and dataclasses.is_dataclass(one.kind)
}


OF_THE_PLAN = ("zoom", *UNIFORM, *OF_TWO_PASSES, *SPARING, "scan_exposure_ms", "extent")
OF_THE_RUN = (
    "camera",
    "cost",
    "rig",
    "pose",
    "map",
    "zones",
    "resampling",
    "pointing_px",
    "seed",
    "sky",
    "weights",
    "unknown",
)
OF_ZOOM = ("seconds", "scan_step")  # settings of a uniform scan that a first pass has too
BUILT_IN_WEIGHTS = "farm"
FLAGS = {"sky.light": "sky"}  # of settings in tables whose flag has another name


def usual_of_recording(table: Mapping[str, object]) -> dict[str, Any]:
    """Return what the settings beside ``sweeps`` are by default: those of the run that took them, where one is named.

    So `survey --sweeps ARCHIVE/runs/NAME` alone plans as that run did. Cubes of files know nothing of a survey: without
    a budget or a scan every recorded line is read as it is.
    Raises SceneError, ArchiveError: there is no such recording, or no run of it.
    """
    if table.get("source", RECORDED) != RECORDED:
        return {}
    usual: dict[str, Any] = {"source": RECORDED, "scene": RIG_FIELD}
    asked = {name for name in OF_THE_PLAN if table.get(name) is not None}
    found = find_recorded_run(str(table["sweeps"]))
    if found is not None:
        run, shape = found
        uniform = any(run.settings.get(name) is not None for name in UNIFORM)
        another_plan = asked if uniform else asked & set(UNIFORM)
        names = OF_THE_RUN if another_plan else (*OF_THE_RUN, *OF_THE_PLAN)
        usual |= {name: run.settings[name] for name in names if run.settings.get(name) is not None}
        usual |= {"name": str(run.receipt.get("survey") or run.folder.name)}
        usual |= {} if shape is None else {"size": shape[::-1]}
        if run.settings.get("weights") is None and run.settings.get("scene") in BUILT_IN_SCENES:
            usual["weights"] = BUILT_IN_WEIGHTS
    elif not asked:
        usual["scan"] = RECORDED
    return usual


def load_settings(
    path: str | Path | None = None,
    flags: Mapping[str, object] | None = None,
    *,
    usual: Mapping[str, object] | None = None,
) -> Settings:
    """Read the TOML file (None: defaults and flags alone), lay the flags over it and check the whole.

    Relative paths in the file start at its folder, those of flags at the current one. Flags are keys as in the file,
    ``camera.exposure_ms`` for one in a table; None means not given. ``usual`` are defaults of the caller's own. Raises
    SettingsError, BudgetError: the first key that cannot be used, with its place and what it should be.
    """
    try:
        table = {} if path is None else anchor_paths(read_toml(Path(path)), Path(path).parent)
    except FileNotFoundError:
        raise SettingsError(f"no settings file {path}; give the path of a survey's TOML file, or none") from None
    except ValueError as error:
        scene = f"; a scene is given as --scene {path}" if Path(str(path)).suffix != ".toml" else ""
        raise SettingsError(f"cannot read the settings file {path}: {error}; expected TOML in UTF-8{scene}") from None
    origin = dict.fromkeys(table, str(path))
    for name in TABLES:
        inner = table.get(name)
        origin |= {f"{name}.{key}": str(path) for key in inner} if isinstance(inner, Mapping) else {}
    for key, value in (flags or {}).items():
        if value is not None:
            head, _, tail = key.rpartition(".")
            inner = table.get(head, {})
            table[head or key] = {**inner, tail: value} if head and isinstance(inner, Mapping) else value
            origin[key] = "flag"
    if table.get("source") == SURVEY["source"].item.default:  # as if it were not said
        del table["source"]
    given = {key for key, value in table.items() if value is not None}
    recorded = usual_of_recording(table) if "sweeps" in given else {}
    for name in TABLES:
        inner = table.get(name)
        if isinstance(inner, Mapping):
            table[name] = {**recorded.pop(name, {}), **inner}
    asked = {**(usual or {}), **recorded, **table}
    for wrong in (*_camera_of_a_map(asked, origin), *_contradictions(given, origin, zooms=asked.get("zoom") == ALWAYS)):
        raise SettingsError(wrong)
    passes = any(name in given and not _is_usual(table[name], SURVEY[name], origin.get(name)) for name in OF_TWO_PASSES)
    passes |= asked.get("zoom") == ALWAYS and asked.get("seconds") is None
    if passes and not _is_map(asked) and not any(asked.get(name) is not None for name in (*UNIFORM, "budget")):
        asked["budget"] = USUAL_BUDGET
    if "prior" in given and "extent" not in given and _may_choose_a_part(asked):
        asked["extent"] = EXTENT_PART
    return parse_settings(asked, origin)


def _may_choose_a_part(asked: Mapping[str, object]) -> bool:
    """Return whether a revisit that is bounded by its seconds alone can choose its lines by the prior map."""
    others = {"sweeps", "kept_bytes", "pointing_px", *UNIFORM, *SPARING} - {"seconds"}
    chosen = any(asked.get(name) is not None for name in others) or asked.get("zoom") == ALWAYS
    return asked.get("seconds") is not None and asked["prior"] != "none" and not chosen and not _is_map(asked)


def _is_usual(value: object, declared: Declared | None, origin: str | None) -> bool:
    """Return whether a file, and no flag, says what is the default anyway."""
    return declared is not None and origin != "flag" and declared.read(value, "") == declared.item.default


def _scene_of(table: Mapping[str, object]) -> str:
    return str(table.get("scene") or SURVEY["scene"].item.default)


def _is_map(table: Mapping[str, object]) -> bool:
    return (table.get("source") or source_of(_scene_of(table))) == RASTER


def _camera_of_a_map(table: Mapping[str, object], origin: Mapping[str, str]) -> Iterator[str]:
    """Settings that only a camera has, beside a scene whose pixels are taken as they are.

    Those of a file that say what is the default anyway, as those of the example do, ask for nothing.
    """
    scene = _scene_of(table)
    if not _is_map(table):
        return
    view = OF_A_VIEW if table.get("pose") is not None else ()
    for name in OF_A_CAMERA:
        value = table.get(name)
        items = value if name in TABLES and isinstance(value, Mapping) else {name: value}
        declared, head = (TABLES[name], f"{name}.") if name in TABLES else (SURVEY, "")
        for key, one in items.items():
            full = key if key == name else head + key
            if one is not None and full not in view and not _is_usual(one, declared.get(key), origin.get(full)):
                yield (
                    f"{place_of(full, origin.get(full))} is of a camera, and the scene {scene} is a raster"
                    " whose pixels are taken as they are: leave it out, or give --source sim to have the simulated rig"
                    " photograph the file"
                )


def parse_settings(table: Mapping[str, object], origin: Mapping[str, str] | None = None) -> Settings:
    """Check a table of settings, with tables in it as in the file, and fill in the defaults; None means not given.

    ``origin`` says where each (dotted) key came from, for the messages: a file's name or ``flag``.
    """
    origin = origin or {}
    settings = Settings(**_check_table(table, SURVEY, "", origin))
    for wrong in chain(
        _policy_wrongs(settings.policy, settings.mask),
        _scene_wrongs(settings, origin),
        _rig_wrongs(settings),
        _recorded_wrongs(settings, origin),
        _extent_errors(settings, origin),
        _sparing_wrongs(settings, origin),
    ):
        raise SettingsError(wrong)
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
            raise SettingsError(f"unknown setting {place}{_hint(full, declared, prefix)}")
        if not prefix and key in TABLES:
            checked[key] = _parse_table(key, value, place, origin)
        else:
            checked[key] = declared[key].read(value, place)
    return checked


def _parse_table(key: str, value: object, place: str, origin: Mapping[str, str]) -> object:
    if not isinstance(value, Mapping):
        raise SettingsError(f"{place} must be a table, [{key}] with keys below it; got {value!r}")
    given = _check_table(value, TABLES[key], f"{key}.", origin)
    missing = [name for name, one in TABLES[key].items() if one.item.default is MISSING and name not in given]
    if missing:
        raise SettingsError(f"[{key}] lacks {', '.join(missing)}; give every one, or leave the table out")
    try:
        return SURVEY[key].kind(**given)
    except PoseError as error:
        raise SettingsError(f"[{key}]: {error}") from None


def _hint(full: str, known: Mapping[str, Declared], prefix: str) -> str:
    """Return what an unknown key may mean: its present name, the nearest of its table, or of another table."""
    if full in renamed.SETTINGS:
        return f"; it is called '{renamed.SETTINGS[full]}' now"
    everywhere = [*SURVEY, *(f"{name}.{key}" for name, keys in TABLES.items() for key in keys)]
    short = full.removeprefix(prefix)
    near = [name for name in everywhere if name.split(".")[-1] == short]
    near = near or [prefix + key for key in difflib.get_close_matches(short, known, n=1, cutoff=0.5)]
    return f"; did you mean '{near[0]}'?" if near else f"; known keys: {', '.join(prefix + key for key in known)}"


def of_this_version(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a receipt's settings without what it says beside them."""
    return {key: value for key, value in stored.items() if key in SURVEY}


def anchor_paths(table: dict[str, object], folder: Path) -> dict[str, object]:
    """Relative paths of a file's settings, made to start at the file's folder."""
    named = {*BUILT_IN_SCENES, RIG_FIELD}
    anchored = dict(table)
    for key in PATHS:
        head, _, tail = key.rpartition(".")
        inner = anchored.get(head) if head else anchored
        value = inner.get(tail) if isinstance(inner, Mapping) else None
        if isinstance(value, str) and value and value not in named and "://" not in value:
            path = str(folder / Path(value).expanduser())
            anchored |= {head: {**inner, tail: path}} if head and isinstance(inner, Mapping) else {tail: path}
    return anchored


def _contradictions(given: set[str], origin: Mapping[str, str], *, zooms: bool) -> Iterator[str]:
    """Yield settings of a uniform scan beside some of a survey that zooms, or those that choose it beside it itself."""
    plain = [place_of(key, origin.get(key)) for key in UNIFORM if key in given and not (zooms and key in OF_ZOOM)]
    if zooms and plain:
        yield f"{plain[0]} asks for one uniform scan of the field, and --zoom always for lines between; leave one out"
    chosen = OF_CHOOSING if given & set(SPARING) else ()
    passes = [place_of(key, origin.get(key)) for key in OF_TWO_PASSES if key in given and key not in chosen]
    if plain and passes:
        yield (
            f"{plain[0]} asks for one uniform scan of the field, and {passes[0]} is for a survey that captures "
            "again; leave one of them out"
        )
    by_hand = [place_of(key, origin.get(key)) for key in ("scan_step", "scan_exposure_ms", "scan") if key in given]
    if by_hand and not zooms and given & {"seconds", "bytes_raw", "goal"}:
        yield f"{plain[0]} leaves the choice of the scan to the weights' record, {by_hand[0]} makes it: leave one out"
    if "scan_exposure_ms" in given and "scan_step" not in given:
        yield f"{by_hand[0]} is for a uniform scan: give --scan-step too (1 for every line), or --coarse-exposure-ms"


IN_NAT = ("gain", "entropy")  # policies whose scores are gains, or the most that these can be


def _policy_wrongs(policy: str, mask: str | None) -> Iterator[str]:
    if (policy == "mask") != (mask is not None):
        wants = "policy 'mask' needs a mask file" if mask is None else "a mask is used by policy 'mask' only"
        yield f"{wants}: got policy = {policy!r}, mask = {mask!r}; give both or neither"


def _scene_wrongs(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    scene = settings.scene
    bands, wavelengths = settings.bands, settings.wavelengths
    if bands is not None and wavelengths is not None and len(bands) != len(wavelengths):
        place = place_of("wavelengths", origin.get("wavelengths"))
        yield f"{place} must have one value for each of the {len(bands)} bands, got {len(wavelengths)}"
    if scene == RIG_FIELD and settings.source not in (RIG, RECORDED):
        yield f"scene {RIG_FIELD!r} is what stands before a rig: give --source rig, or a file"
    if settings.is_map and scene in BUILT_IN_SCENES:
        yield f"source 'raster' takes the pixels of a file, and {scene} is drawn: give --source sim, or a file"
    if settings.size is not None and scene not in (*BUILT_IN_SCENES, RIG_FIELD):
        yield f"size is for built-in scenes ({', '.join(BUILT_IN_SCENES)}); {scene} has its own"
    for name, value in {"day": settings.day, "hour": settings.hour}.items():
        if value is not None and scene not in BUILT_IN_SCENES:
            yield (
                f"{place_of(name, origin.get(name))} = {value:g} is for built-in scenes, whose crops grow; {scene}"
                " is as it is: leave it out"
            )
    if settings.interest is not None and scene not in SCOUTING_NAMES:
        place = place_of("interest", origin.get("interest"))
        yield f"{place} = {settings.interest:g} is for the scene scouting, and the scene is {scene}: leave it out"
    if settings.zones.plots_name is not None and settings.zones.plots is None:
        place = place_of("zones.plots_name", origin.get("zones.plots_name"))
        yield f"{place} = {settings.zones.plots_name!r} names plots, and there are none: give --plots FILE too"
    if settings.pose is None and settings.map != MapChoice():
        yield "[map] says how to draw the ground, which needs to know where the rig stands: give [pose]"


def _rig_wrongs(settings: Settings) -> Iterator[str]:
    air, camera = settings.air, settings.camera
    if camera.dark_dn >= camera.full_scale_dn:
        yield (
            f"camera.dark_dn = {camera.dark_dn:g} leaves no room below the {camera.full_scale_dn} DN of {camera.bits} "
            "bits; use a smaller dark level"
        )
    for name, metres in {"nearest_m": air.nearest_m, "farthest_m": air.farthest_m}.items():
        if metres is not None and air.distance_m is None:
            yield f"air.{name} = {metres:g} needs air.distance_m, how far the middle of the scene is"
    distances = settings.simulated_rig.distances_m
    if distances is not None and distances[0] > distances[1]:
        yield f"air.nearest_m = {distances[0]:g} lies beyond air.farthest_m = {distances[1]:g}"
    pairs = settings.cost.vector_pairs
    if settings.source == "rig" and not 2 <= pairs <= MOST_PAIRS:
        yield f"cost.vector_pairs = {pairs}: the mirror's vector memory takes 2 to {MOST_PAIRS} pairs; give what it has"


def _recorded_wrongs(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    """Yield what a recording needs, and what nothing else has."""
    if settings.source != RECORDED:
        for name in OF_RECORDINGS:
            if getattr(settings, name) is not None:
                yield (
                    f"{place_of(name, origin.get(name))} is for recorded sweeps, and source = {settings.source!r}; "
                    "give --source recorded with --sweeps, or leave it out"
                )
        return
    if settings.sweeps is None:
        yield "source = 'recorded' reads sweeps that were taken before; give --sweeps, where they lie"
    if settings.scene != RIG_FIELD:
        yield (
            f"{place_of('scene', origin.get('scene'))} = {settings.scene!r}, and the field of recorded sweeps is what "
            "they show; leave it out, and give --labels FILE where there are some"
        )
    if settings.bands is not None:
        yield f"{place_of('bands', origin.get('bands'))} is for scenes: all bands of a recording are read; leave it out"
    if settings.extent == EXTENT_PART:
        yield (
            f"{place_of('extent', origin.get('extent'))} = 'part' chooses lines and exposures for a camera that looks "
            "again, and a recording has those that were taken; leave it out"
        )


def _extent_errors(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    if settings.extent == EXTENT_PART and settings.seconds is None:
        place = place_of("extent", origin.get("extent"))
        yield f"{place} = 'part' looks where the seconds are worth most: give --seconds too"
    if settings.extent not in (EXTENT_WHOLE, EXTENT_PART) and settings.scan_step is None:
        yield f"{place_of('extent', origin.get('extent'))} names lines of a uniform scan: give its --scan-step too"
    if settings.extent != EXTENT_WHOLE and settings.pointing_px:
        yield (
            f"{place_of('extent', origin.get('extent'))}: a mirror that may look beside the plan (pointing_px = "
            f"{settings.pointing_px:g}) ties its sweeps by what they share, so that none is left out; leave it out"
        )
    if settings.skip_below_error is not None and settings.extent == EXTENT_WHOLE:
        place = place_of("skip_below_error", origin.get("skip_below_error"))
        yield f"{place} says how sure a memory may be so that nothing is looked at: give --extent part too"
    if settings.kept_bytes is not None and not (settings.plain and settings.source != RASTER):
        place = place_of("kept_bytes", origin.get("kept_bytes"))
        yield f"{place} is for the lines of a uniform scan: give --seconds or --scan-step too, or leave it out"
    if settings.max_age is not None and settings.extent == EXTENT_WHOLE:
        place = place_of("max_age", origin.get("max_age"))
        yield f"{place} says how old a place may become of which a visit looks at a part: give --extent part too"


def _sparing_wrongs(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    """Budgets of patches where none are chosen: zoomed, seconds buy them, and of a part all is read."""
    given = [place_of(name, origin.get(name)) for name in SPARING if getattr(settings, name) is not None]
    if given and not settings.plain:
        yield (
            f"{given[0]} is for a raster or a uniform scan, of which a part is kept and read in detail: give "
            "--seconds or --scan-step too; what a zoomed survey reads in detail, its --budget says"
        )
    if given and settings.extent != EXTENT_WHOLE:
        place = place_of("extent", origin.get("extent"))
        yield f"{given[0]} chooses among the patches of a whole field, {place} covers a part: leave one of them out"
    if settings.least_gain is not None and settings.policy not in IN_NAT:
        place = place_of("least_gain", origin.get("least_gain"))
        yield (
            f"{place} is a gain [nat], and policy {settings.policy!r} scores in a unit of its own: leave it out, or "
            f"take --policy {' or '.join(IN_NAT)}"
        )


def place_of(key: str, origin: str | None) -> str:
    """Return how a message names a setting: as a flag (without the table that holds it), or in its file."""
    if origin == "flag":
        return "--" + FLAGS.get(key, key.rpartition(".")[2]).replace("_", "-")
    return f"'{key}'" + (f" in {origin}" if origin else "")
