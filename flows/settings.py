"""Settings of a survey: one TOML file and flags, every key checked. Flags win over the file, it over the defaults."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, cast

from flows.device_settings import MOST_PAIRS, RIG
from flows.rig_settings import field_parsers
from flows.setting_values import (
    Span,
    Tolerance,
    parse_bands,
    parse_budget,
    parse_choice,
    parse_effects,
    parse_memory,
    parse_name,
    parse_number,
    parse_scheduler,
    parse_size,
    parse_switch,
    parse_text,
    parse_tolerance,
    parse_wavelengths,
    parse_whole,
)
from models.vgg_sizes import TRAINED_VGG_FROM, VGG_FROM
from pipeline.camera import LineCamera
from pipeline.errors import PoseError, SettingsError
from pipeline.ground import LIMITS, RigPose
from pipeline.rig.survey_rig import SurveyRig
from pipeline.scan import CostModel
from pipeline.simulator.farm_laws import FARM_NAMES, SEASON_LAW, USUAL_DAY, USUAL_HOUR, has_days
from pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from storage.block_work import Crew

POLICIES = (
    "gain", "entropy", "margin", "sobel", "saliency", "spectral-residual", "random", "stratified", "centre", "uniform",
    "mask", "vgg-static", "vgg-trained", "self-attention",
)  # fmt: skip
IN_NAT = ("gain", "entropy")  # policies whose scores are gains, or the most that these can be
UNMOVED = ("random", "stratified", "centre", "uniform", "mask")  # policies by place: nothing seen changes them
ENGINES = ("prefect", "plain")
KERNELS = ("catmull-rom", "bilinear", "nearest")
BUILT_IN_SCENES = FARM_NAMES
BUILT_IN_SOURCES = ("sim", "rig")
RIG_FIELD = "field"  # the scene of which only the rig knows more than size and bands
OF_THE_MACHINE = ("scheduler", "workers")  # no byte depends on them; a cluster of that day need not be there today
_VGG_FROM = {"vgg-static": VGG_FROM, "vgg-trained": TRAINED_VGG_FROM}  # policies that read a file of VGG19
_PATHS = ("scene", "labels", "out", "mask", "vgg", "weights")

Parser = Callable[[object, str], object]


@dataclass(frozen=True)
class MapChoice:
    """What map to draw of a posed survey; None leaves the choice to the pose."""

    epsg: int | None = None  # a projected CRS in metres; by default the rig's UTM zone
    resolution_m: float | None = None  # by default the median footprint of a pixel


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
    rounds: int = 1  # of detail: with 2 half of the seconds are spent first, the rest by what they showed
    threshold: float | None = None  # least expected gain per second of fine capture [nat per px, summed over seats]
    seed: int = 0
    effects: str = "auto"  # of the simulated rig: auto, all, none, or names with commas
    tol: Tolerance = field(default_factory=Tolerance)  # what leaving effects out may change any number by
    controls: bool = True
    engine: Literal["prefect", "plain"] = "prefect"
    memory: int = 4 * 1024**3  # [bytes]
    scheduler: str = "threads"  # who makes blocks: threads, processes, or tcp://host:port of a dask scheduler
    workers: int | None = None  # blocks at a time; None is one a core. A scheduler elsewhere has its own
    kernel: Literal["catmull-rom", "bilinear", "nearest"] = "catmull-rom"
    pointing_px: float = 0.0  # how far off the mirror may point; above 0 sweeps overlap and their seams are registered
    size: tuple[int, int] | None = None  # (width, height) of the built-in scene [px]
    day: int | None = None  # of the year, for farm@2: 172 unless given
    hour: float | None = None  # true solar time, for farm@2: 11 unless given [h]
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
        if not has_days(self.scene):
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
    checked = _check_table({k: v for k, v in table.items() if v is not None}, _SURVEY, "", origin)
    settings = Settings(**checked)  # type: ignore[arg-type]
    _check_together(settings, origin)
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
        if prefix == "" and key in _TABLES:
            checked[key] = _parse_table(key, value, origin)
        else:
            checked[key] = parsers[key](value, _place(full, origin.get(full)))
    return checked


def _parse_table(key: str, value: object, origin: Mapping[str, str]) -> object:
    """One of the tables that stand for a dataclass of the pipeline."""
    if not isinstance(value, Mapping):
        place = _place(key, origin.get(key))
        raise SettingsError(f"{place} must be a table, [{key}] with keys below it; got {value!r}")
    make, spans = _TABLES[key]
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
    everywhere = [*_SURVEY, *(f"{name}.{key}" for name, (_, spans) in _TABLES.items() for key in spans)]
    short = full.removeprefix(prefix)
    near = [name for name in everywhere if name.split(".")[-1] == short]
    near = near or [prefix + key for key in difflib.get_close_matches(short, known, n=1, cutoff=0.5)]
    hint = f"; did you mean '{near[0]}'?" if near else f"; known keys: {', '.join(prefix + key for key in known)}"
    raise SettingsError(f"unknown setting {_place(full, origin)}{hint}")


def _check_together(settings: Settings, origin: Mapping[str, str]) -> None:
    """What no key can say alone."""
    if (settings.policy == "mask") != (settings.mask is not None):
        wants = "policy 'mask' needs a mask file" if settings.mask is None else "a mask is used by policy 'mask' only"
        got = f"policy = {settings.policy!r}, mask = {settings.mask!r}"
        raise SettingsError(f"{wants}: got {got}; give both or neither")
    vgg_from = _VGG_FROM.get(settings.policy)
    if vgg_from is not None and settings.vgg is None:
        raise SettingsError(f"policy {settings.policy!r} needs --vgg FILE, {vgg_from}")
    if vgg_from is None and settings.vgg is not None:
        wanted = " or ".join(map(repr, _VGG_FROM))
        raise SettingsError(f"a vgg file is for policy {wanted}, got policy = {settings.policy!r}; leave --vgg out")
    _check_spending(settings)
    bands, wavelengths = settings.bands, settings.wavelengths
    if bands is not None and wavelengths is not None and len(bands) != len(wavelengths):
        raise SettingsError(
            f"{_place('wavelengths', origin.get('wavelengths'))} must have one value for each of the "
            f"{len(bands)} bands, got {len(wavelengths)}"
        )
    if settings.scene == RIG_FIELD and settings.source != "rig":
        raise SettingsError(f"scene {RIG_FIELD!r} is what stands before a rig: give --source rig, or a file")
    if settings.size is not None and settings.scene not in (*BUILT_IN_SCENES, RIG_FIELD):
        raise SettingsError(f"size is for built-in scenes ({', '.join(BUILT_IN_SCENES)}); {settings.scene} has its own")
    for name, value in {"day": settings.day, "hour": settings.hour}.items():
        if value is not None and not has_days(settings.scene):
            raise SettingsError(
                f"{_place(name, origin.get(name))} = {value:g} is for the scene {SEASON_LAW}, whose fields grow; "
                f"{settings.scene} is as it is: leave it out"
            )
    if settings.camera.dark_dn >= settings.camera.full_scale_dn:
        raise SettingsError(
            f"camera.dark_dn = {settings.camera.dark_dn:g} leaves no room below the {settings.camera.full_scale_dn} DN "
            f"of {settings.camera.bits} bits; use a smaller dark level"
        )
    _check_rig(settings)
    _check_devices(settings)
    if settings.pose is None and settings.map != MapChoice():
        raise SettingsError("[map] says how to draw the ground, which needs to know where the rig stands: give [pose]")


def _check_rig(settings: Settings) -> None:
    """What no number of the rig can say alone."""
    near, far = settings.air.nearest_m, settings.air.farthest_m
    for name, metres in {"nearest_m": near, "farthest_m": far}.items():
        if metres is not None and settings.air.distance_m is None:
            raise SettingsError(f"air.{name} = {metres:g} needs air.distance_m, how far the middle of the scene is")
    distances = settings.simulated_rig.distances_m
    if distances is not None and distances[0] > distances[1]:
        raise SettingsError(f"air.nearest_m = {distances[0]:g} lies beyond air.farthest_m = {distances[1]:g}")


def _check_devices(settings: Settings) -> None:
    """What the rig's devices ask of the other settings."""
    pairs = settings.cost.vector_pairs
    if settings.source == "rig" and not 2 <= pairs <= MOST_PAIRS:
        raise SettingsError(
            f"cost.vector_pairs = {pairs}: the mirror's vector memory takes 2 to {MOST_PAIRS} pairs; give what it has"
        )


def _check_spending(settings: Settings) -> None:
    """Thresholds and rounds that the policy gives no meaning to."""
    policy = settings.policy
    if settings.threshold is not None and policy not in IN_NAT:
        raise SettingsError(
            f"threshold is a gain [nat], and policy {policy!r} scores in a unit of its own: leave --threshold out, or "
            f"take --policy {' or '.join(IN_NAT)} (entropy is the most that a look can gain)"
        )
    if settings.rounds > 1 and policy in UNMOVED:
        raise SettingsError(
            f"a second round goes where the first showed more than was expected, and policy {policy!r} expects "
            f"nothing: take --rounds 1, or a policy that looks, such as gain"
        )


def _read_toml(path: Path) -> dict[str, object]:
    """The file's tables; a file that is not there or not TOML is an error with its place."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SettingsError(f"no settings file {path}; give the path of a survey's TOML file, or none") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"cannot read the settings file {path}: {error}; expected TOML in UTF-8") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path} is not valid TOML: {error}") from None


def anchor_paths(table: dict[str, object], folder: Path) -> dict[str, object]:
    """Relative paths of a file's settings, made to start at the file's folder."""
    named = {*BUILT_IN_SCENES, RIG_FIELD}
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
        if key in _TABLES and isinstance(value, Mapping):
            flat.update({f"{key}.{inner}": item for inner, item in value.items()})
        else:
            flat[key] = value
    return flat


def _put(table: dict[str, object], key: str, value: object) -> None:
    """Set a dotted key, without changing the inner table that came in."""
    head, _, tail = key.partition(".")
    inner = table.get(head, {})
    table[head] = {**cast("Mapping[str, object]", inner), tail: value} if tail and isinstance(inner, Mapping) else value


def _place(key: str, origin: str | None) -> str:
    """How a message names a setting: as a flag (without the table that holds it), or in its file."""
    if origin == "flag":
        return "--" + key.rpartition(".")[2].replace("_", "-")
    return f"'{key}'" + (f" in {origin}" if origin else "")


_CAMERA: dict[str, Parser] = {
    "samples": parse_whole(16, 65_536),
    "pitch_um": parse_number(Span(0.5, 200, "um")),
    "focal_length_mm": parse_number(Span(1, 5000, "mm")),
    "slit_um": parse_number(Span(0.5, 2000, "um")),
    "exposure_ms": parse_number(Span(0.5, 10_000, "ms")),
    "readout_ms": parse_number(Span(0, 1000, "ms")),
    "max_rate_hz": parse_number(Span(0.1, 100_000, "hz")),
    "bits": parse_whole(8, 14),  # the sum of four neighbours must fit 16 bits
    "electrons_per_dn": parse_number(Span(1e-3, 1e4, "")),
    "read_noise_e": parse_number(Span(0, 1e4, "")),
    "dark_dn": parse_number(Span(0, 16_383, "")),
}
_COST: dict[str, Parser] = {
    "slew_s": parse_number(Span(0, 10, "s")),
    "settle_frames": parse_number(Span(0, 1000, "")),
    "capture_start_s": parse_number(Span(0, 60, "s")),
    "reload_s": parse_number(Span(0, 60, "s")),
    "vector_pairs": parse_whole(1, 10_000_000),
    "provenance": parse_text,
}
_POSE: dict[str, Parser] = {
    name: parse_number(Span(*limits, name.rpartition("_")[2])) for name, limits in LIMITS.items()
}
_MAP: dict[str, Parser] = {
    "epsg": parse_whole(1024, 32_767, why="the number after EPSG:, such as 32632"),
    "resolution_m": parse_number(Span(1e-4, 1000, "m")),
}
_OF_THE_RIG: dict[str, type[Any]] = {
    "optics": Optics, "mirror": MirrorMotion, "detector": Detector, "air": Air, "sky": Sky,
}  # fmt: skip
_TABLES: dict[str, tuple[type[Any], dict[str, Parser]]] = {
    "camera": (LineCamera, _CAMERA),
    **{name: (make, field_parsers(make)) for name, make in _OF_THE_RIG.items()},
    "cost": (CostModel, _COST),
    "rig": (SurveyRig, RIG),
    "pose": (RigPose, _POSE),
    "map": (MapChoice, _MAP),
}
_SURVEY: dict[str, Parser] = {
    "name": parse_name,
    "visit": parse_text,
    "scene": parse_text,
    "labels": parse_text,
    "bands": parse_bands,
    "wavelengths": parse_wavelengths,
    "source": parse_choice(BUILT_IN_SOURCES),
    "out": parse_text,
    "budget": parse_budget,
    "policy": parse_choice(POLICIES),
    "mask": parse_text,
    "vgg": parse_text,
    "weights": parse_text,
    "rounds": parse_whole(1, 2, why="one coarse look, then one round of detail or two"),
    "threshold": parse_number(Span(0, 1e9, "nat per second")),
    "seed": parse_whole(0, 2**63 - 1),
    "effects": parse_effects,
    "tol": parse_tolerance,
    "controls": parse_switch,
    "engine": parse_choice(ENGINES),
    "memory": parse_memory,
    "scheduler": parse_scheduler,
    "workers": parse_whole(1, 1024, why="one process or thread each; leave it out for one a core"),
    "kernel": parse_choice(KERNELS),
    "pointing_px": parse_number(Span(0, 300, "px")),
    "size": parse_size,
    "day": parse_whole(1, 366, why="of the year, 172 is the 21st of June"),
    "hour": parse_number(Span(0, 24, "h")),
    **dict.fromkeys(_TABLES, parse_text),  # checked by _parse_table
}
