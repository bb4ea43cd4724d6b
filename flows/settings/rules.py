"""Joint rules of the settings of a survey: what follows from others, and what contradicts them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from spectralzoom.flows.settings.load import OF_A_SCENE, place_of
from spectralzoom.flows.settings.values import (
    ALWAYS,
    AUTO,
    BUILT_IN_SCENES,
    PART,
    RASTER,
    RECORDED,
    RIG,
    RIG_FIELD,
    SIM,
    WHOLE,
)
from spectralzoom.pipeline.planning.fine_pass import FIRST_STEPS
from spectralzoom.pipeline.rig.device_settings import MOST_PAIRS
from spectralzoom.pipeline.simulator.scenes.laws import SCOUTING_NAMES

if TYPE_CHECKING:
    from spectralzoom.flows.settings.settings import Settings

USUAL_BUDGET = 0.5  # of a zoomed survey
OF_RECORDINGS = ("sweeps", "pointing", "dark", "white")
# settings and tables that only a camera has
OF_A_CAMERA = (
    *("camera", "optics", "mirror", "detector", "air", "sky", "cost", "rig", "seconds", "scan_step"),
    *("scan_exposure_ms", "budget", "zoom", "effects", "tol", "resampling", "pointing_px", "extent", "max_age"),
)
OF_THE_PLAN = ("zoom", "seconds", "scan_step", "budget", "policy", "mask", "macs", "scan_exposure_ms", "extent")
OF_A_VIEW = ("camera.pitch_um", "camera.focal_length_mm")  # these give the IFOV, which a [pose] needs


def with_source(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of settings with the actual source in place of ``auto``."""
    found = dict(table)
    scene = found.get("scene", BUILT_IN_SCENES[0])
    if found.get("source", AUTO) == AUTO:
        of_scene = RIG if scene == RIG_FIELD else SIM if scene in BUILT_IN_SCENES else RASTER
        found["source"] = RECORDED if "sweeps" in found else of_scene
    if found["source"] == RECORDED:
        found.setdefault("scene", RIG_FIELD)
    return found


def completed(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of settings with what follows from those that are stated."""
    found = with_source(table)
    if found["source"] == RASTER:
        return found
    zooms = found.get("zoom") == ALWAYS
    chooses = "macs" not in found and (found.get("policy", "gain") != "gain" or "mask" in found)
    if (zooms or chooses) and not {"seconds", "budget"} & set(found):
        found["budget"] = USUAL_BUDGET
    planned = zooms or {"extent", "sweeps", "pointing_px", "macs", "scan_step", "budget"} & set(found)
    if found.get("prior", AUTO) not in (AUTO, "none") and "seconds" in found and not planned:
        found["extent"] = PART  # the prior map can choose the lines of a revisit
    return found


def changed(settings: Settings, *names: str) -> list[str]:
    """Return those of the settings that differ from their defaults; of a table, the keys that do."""
    usual = type(settings).model_fields
    found: list[str] = []
    for name in names:
        own, other = getattr(settings, name), usual[name].default
        if is_dataclass(other) and is_dataclass(own) and name != "tol":
            keys = (item.name for item in fields(other))
            found += [f"{name}.{key}" for key in keys if getattr(own, key) != getattr(other, key)]
        elif own != other:
            found.append(name)
    return found


def mistakes(settings: Settings, origin: Mapping[str, str]) -> Iterator[str]:
    """Yield errors: settings that do not fit each other. ``origin`` has the place of each setting that is stated."""

    def at(name: str) -> str:
        return place_of(name, origin)

    if not settings.is_map:
        yield from _scan_errors(settings, at, [name for name in changed(settings, *OF_THE_PLAN) if name in origin])
    for check in (_camera_errors, _scene_errors, _air_errors, _recorded_errors, _extent_errors, _limit_errors):
        yield from check(settings, at)


def _scan_errors(settings: Settings, at: Callable[[str], str], stated: Sequence[str]) -> Iterator[str]:
    """Yield errors: ``stated`` settings that choose different scans."""
    uniform = [name for name in ("seconds", "scan_step") if name in stated and settings.zoom != ALWAYS]
    passes = [name for name in ("policy", "mask") if name in stated and not settings.macs]
    passes += [name for name in ("budget",) if name in stated]
    by_hand = [name for name in ("scan_step", "scan_exposure_ms") if name in stated]
    if uniform and passes:
        yield (
            f"{at(uniform[0])} asks for one uniform scan of the field, and {at(passes[0])} is for a survey that "
            "captures again; leave one of them out"
        )
    if "scan_exposure_ms" in stated and settings.source == RECORDED:
        yield f"{at('scan_exposure_ms')} is for a camera, and recorded lines have their own: leave it out"
    if "seconds" in uniform and by_hand:
        yield (
            f"{at('seconds')} leaves the choice of the scan to the weights' record, {at(by_hand[0])} makes it: leave "
            "one out"
        )
    if by_hand == ["scan_exposure_ms"] and not settings.zooms:
        yield (
            f"{at('scan_exposure_ms')} is for lines that you choose: give --scan-step too (1 for every line), or "
            "--zoom always"
        )


def _camera_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings of a camera for a raster. The IFOV is that of its [pose]."""
    if settings.is_map:
        for name in changed(settings, *OF_A_CAMERA):
            if settings.pose is None or name not in OF_A_VIEW:
                yield (
                    f"{at(name)} is of a camera, and the scene {settings.scene} is a raster that no camera captures: "
                    "leave it out, or give --source sim for a simulated capture of the file"
                )


def _scene_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings that the scene cannot have."""
    scene = settings.scene
    bands, wavelengths = settings.bands, settings.wavelengths
    if Path(scene).suffix.lower() == ".toml":
        right = f"settings as: spectralzoom survey {quote(scene)}"
        if Path(scene).name == OF_A_SCENE:
            right = f"its scene: --scene {quote(str(Path(scene).parent))}"
        yield f"{at('scene')} = {scene!r} is TOML and no scene; give {right}"
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
    if settings.plots_name is not None and settings.plots is None:
        yield f"{at('plots_name')} = {settings.plots_name!r} names plots: give --plots FILE too"
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
    if settings.scene != RIG_FIELD:
        yield (
            f"{at('scene')} = {settings.scene!r}, and the field of recorded sweeps is what they show; leave it out, "
            "and give --labels FILE where there are some"
        )
    if settings.bands is not None:
        yield f"{at('bands')} is for scenes: all bands of a recording are read; leave it out"
    if settings.extent == PART:
        yield f"{at('extent')} = 'part' chooses lines to capture, and a recording has fixed lines; leave it out"


def _extent_errors(settings: Settings, at: Callable[[str], str]) -> Iterator[str]:
    """Yield errors: settings of a partial scan without one, or that contradict it."""
    if settings.extent != WHOLE and settings.zooms:
        yield f"{at('extent')} is for one uniform scan; leave it out, or zoom and budget"
    if settings.extent == PART and settings.seconds is None:
        yield f"{at('extent')} = 'part' needs a time budget: give --seconds too"
    if settings.extent not in (WHOLE, PART) and settings.scan_step is None:
        yield f"{at('extent')} names lines of a uniform scan: give its --scan-step too"
    if settings.extent != WHOLE and settings.pointing_px:
        yield (
            f"{at('extent')} leaves sweeps out, and registration (pointing_px = {settings.pointing_px:g}) needs all "
            "of them; leave one of the two out"
        )
    if settings.max_age is not None and settings.extent == WHOLE:
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
            f"{at('macs')} is for a uniform scan, and the survey takes two passes: leave it out, or --budget and "
            "--zoom always"
        )
    if settings.macs is not None and settings.extent != WHOLE:
        yield f"{at('macs')} chooses among the patches of a whole field, {at('extent')} covers a part: leave one out"
