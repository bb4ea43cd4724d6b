"""What effects cost: each variant beside what the rig usually computes, against what the choice counts it by.

Costs are stated in ns of the machine on which noise was timed. What this one measures is scaled so that noise, which
loops of light do not touch, costs what is stated: a slower or busier machine gives the same figures.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from measure import Clock, Row, time_in_turn

from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.counting import QUANTISATION, READ_NOISE, SATURATION, SHOT
from pipeline.simulator.effects.effect import OFF, Effect, SweepBlock
from pipeline.simulator.effects.registry import BY_NAME
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Air, MirrorMotion, Optics, Rig, Sky
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.simulated import sweep_block

SHAPE, LINES, ROUNDS = (512, 1280), 24, 7
FACTOR = 4  # of the coarse pass
SCENE_FWHM_NM = 2.0  # less than the rig's: what the response widens
ALIKE = (0.5, 2.0)  # stated over measured, of what costs more than `NOTICED_NS`
NOTICED_NS = 0.5
OPTICS = Optics(aberration_px=0.3, keystone_px=0.3, smile_nm=0.5, stray_share=1e-3, focus_m=40.0, fwhm_nm=6.0)
OUTDOORS = Air(distance_m=60.0, relief="plane", nearest_m=40.0, farthest_m=90.0, turbulence_cn2=1e-14)
RIG = Rig(
    optics=OPTICS,
    mirror=MirrorMotion(positions_per_line=1.25, repeatability_urad=2.0),
    air=OUTDOORS,
    sky=Sky(brdf_per_rad=0.2, cloud_share=0.3),
)
USUAL = {
    "rotation": "rays",
    "slit": "3-percent",
    "diffraction": "airy",
    "aberration": "gaussian",
    "keystone": "linear",
    "smile": "cubic",
    "vignetting": "held",
    "stray-light": "even",
}  # what others are timed beside
TIMED = ("staircase", "slit", "diffraction", "aberration", "defocus", "keystone", "smile", "stray-light", "response")
TIMED += ("vignetting", "absorption", "path-radiance", "parallax", "turbulence")


def rows() -> list[Row]:
    """Every variant that the loops of light compute, and smear on a coarse sweep."""
    farm = farm_scene(0, SHAPE)
    scene = replace(farm, fwhm_nm=np.full(len(farm.wavelength_nm), SCENE_FWHM_NM))
    fine = sweep_block(scene, RIG, Sweep("fine", "fine", "x", -320.0, -256.0, SHAPE[0]), range(100, 100 + LINES))
    held = Sweep("coarse", "coarse", "x", 0.0, -256.0, SHAPE[0] // FACTOR, FACTOR, FACTOR)
    coarse = sweep_block(scene, RIG, held, range(20, 20 + LINES))
    scale = _scale(scene, fine)
    found = [row for name in TIMED for row in _of_effect(scene, fine, BY_NAME[name], scale)]
    beside_pattern = _timed(scene, fine, BY_NAME["keystone"], USUAL.keys() - {"keystone"})
    shared = BY_NAME["keystone"].merged(RIG)
    merged = _row("keystone beside diffraction, linear", shared.cost_ns, scale * beside_pattern["linear"])
    return [*found, merged, *_of_effect(scene, coarse, BY_NAME["smear"], scale)]


def _of_effect(scene: RasterScene, block: SweepBlock, effect: Effect, scale: float) -> list[Row]:
    """Beside all that is usual; what keystone shares with diffraction is a figure of its own."""
    names = USUAL.keys() - {effect.name, "diffraction" if effect.name == "keystone" else ""}
    found = _timed(scene, block, effect, names)
    return [_row(f"{effect.name}, {way}", effect.cost_ns[way], scale * ns) for way, ns in found.items()]


def _timed(scene: RasterScene, block: SweepBlock, effect: Effect, names: Collection[str]) -> dict[str, float]:
    """Nanoseconds a number that each variant takes beside usual effects."""
    beside = {BY_NAME[name]: USUAL[name] for name in names}
    ways = {variant: {**beside, effect: variant} for variant in effect.variants} | {OFF: beside}
    calls = {way: partial(expected_light, scene, block, _ordered(chosen)) for way, chosen in ways.items()}
    clocks = time_in_turn(calls, ROUNDS)
    return {way: _ns_more(clocks, way, block) for way in effect.variants}


def _row(what: str, stated: float, measured_ns: float) -> Row:
    near = ALIKE[0] <= stated / max(measured_ns, 1e-9) <= ALIKE[1] or max(stated, measured_ns) <= NOTICED_NS
    return Row(
        f"cost of {what}: ns/px*band", f"{measured_ns:.2f}", f"{stated:g} stated, within {ALIKE[1]:g} times", near
    )


def _ordered(chosen: Mapping[Effect, str]) -> dict[Effect, str]:
    """The same in the order of the chain."""
    return {effect: chosen[effect] for effect in BY_NAME.values() if effect in chosen}


def _ns_more(clocks: Mapping[str, Clock], way: str, block: SweepBlock, without: str = OFF) -> float:
    """Nanoseconds a number that one way takes more than another: the median of the rounds."""
    numbers = len(block.lines) * block.rig.camera.samples * len(block.wavelength_nm)
    pairs = zip(clocks[way].cpu_s, clocks[without].cpu_s, strict=True)
    return 1e9 * statistics.median(one - other for one, other in pairs) / numbers


def _scale(scene: RasterScene, block: SweepBlock) -> float:
    """What is stated for exact and for merged noise over what this machine takes."""
    light = expected_light(scene, block, {})
    ways: dict[str, dict[Effect, str]] = {OFF: {}, "exact": {SHOT: "exact"}, "gaussian": {SHOT: "gaussian"}}
    always: dict[Effect, str] = {SATURATION: "exact", QUANTISATION: "exact"}
    calls: dict[str, Callable[[], object]] = {
        way: partial(read_out, light, block, {**chosen, **always}) for way, chosen in ways.items()
    }
    calls["read"] = partial(read_out, light, block, {READ_NOISE: "exact", **always})
    clocks = time_in_turn(calls, ROUNDS)
    measured = sum(_ns_more(clocks, way, block) for way in ("exact", "gaussian", "read"))
    return (SHOT.cost_ns["exact"] + SHOT.cost_ns["gaussian"] + READ_NOISE.cost_ns["exact"]) / measured


if __name__ == "__main__":
    for one in rows():
        print(one.what, one.figure, one.goal, one.met, sep=" | ", flush=True)
