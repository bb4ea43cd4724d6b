"""Every key of the settings, table by table, and what it may be; `flows.settings.survey_settings` reads them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flows.settings.device_table import RIG
from flows.settings.simulated_rig_tables import field_parsers
from flows.settings.values import (
    Span,
    parse_bands,
    parse_budget,
    parse_choice,
    parse_effects,
    parse_memory,
    parse_name,
    parse_number,
    parse_scene,
    parse_scheduler,
    parse_size,
    parse_switch,
    parse_text,
    parse_tolerance,
    parse_wavelengths,
    parse_whole,
)
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel
from pipeline.ground.view import LIMITS, RigPose
from pipeline.rig.survey_rig import SurveyRig
from pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Sky
from pipeline.simulator.scenes.farm.farm_scene import FARM_NAMES

POLICIES = (
    "gain", "entropy", "margin", "sobel", "saliency", "spectral-residual", "random", "stratified", "centre", "uniform",
    "mask", "vgg-static", "vgg-trained", "self-attention",
)  # fmt: skip
ENGINES = ("prefect", "plain")
KERNELS = ("catmull-rom", "bilinear", "nearest")
BUILT_IN_SCENES = FARM_NAMES
BUILT_IN_SOURCES = ("sim", "rig")
RIG_FIELD = "field"  # the scene of which only the rig knows more than size and bands
REPLACED = {  # keys of before
    "optics.polarisation": 'the mirror\'s coating says it now: [mirror] coating = "aluminium"',
    "rounds": "there is one round of detail: a second never paid (README, Limits) and was removed; leave it out",
}

Parser = Callable[[object, str], object]


@dataclass(frozen=True)
class MapChoice:
    """What map to draw of a posed survey; None leaves the choice to the pose."""

    epsg: int | None = None  # a projected CRS in metres; by default the rig's UTM zone
    resolution_m: float | None = None  # by default the median footprint of a pixel


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
TABLES: dict[str, tuple[type[Any], dict[str, Parser]]] = {
    "camera": (LineCamera, _CAMERA),
    **{name: (make, field_parsers(make)) for name, make in _OF_THE_RIG.items()},
    "cost": (CostModel, _COST),
    "rig": (SurveyRig, RIG),
    "pose": (RigPose, _POSE),
    "map": (MapChoice, _MAP),
}
SURVEY: dict[str, Parser] = {
    "name": parse_name,
    "visit": parse_text,
    "scene": parse_scene,
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
    "threshold": parse_number(Span(0, 1e9, "nat per second")),
    "seed": parse_whole(0, 2**63 - 1),
    "effects": parse_effects,
    "tol": parse_tolerance,
    "accuracy": parse_switch,
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
    **dict.fromkeys(TABLES, parse_text),  # checked as tables
}
