"""Small scenes and rigs for the simulator's hard cases, and the change from leaving out each effect."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.effect import Effect, SweepBlock
from spectralzoom.pipeline.simulator.effects.probe import Probe, noise_electrons
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection import survey_probe
from spectralzoom.pipeline.simulator.selection.choice import Decision, decide
from spectralzoom.pipeline.simulator.selection.options import acts_on_light
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.small_scenes import looking_at_less, made_scene

ROUNDING = 4e-6  # times the light over its noise: float32 sums in another order
CAMERA = LineCamera(samples=64)
RIG = Rig(camera=CAMERA)
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-15.5, lines=30)
NOON = datetime(2026, 6, 21, 11, 20, tzinfo=UTC)
PROBES: dict[tuple[Any, ...], Probe] = {}  # cache: a small decision spends most of its time on the probe
EVERYTHING = Rig(  # every part that a rig may have
    camera=CAMERA,
    mirror=MirrorMotion(positions_per_line=0.7, repeatability_urad=40.0, hysteresis_px=2.0, drift_px_per_min=1.0),
    detector=Detector(dead_fraction=0.01, hot_fraction=0.01),
    air=Air(distance_m=300.0, nearest_m=100.0, relief="plane", wind_amplitude_m=0.02),
    sky=Sky(started=NOON, cloud_fraction=0.3, hot_spot=0.1),
)


def scene_of(values: NDArray[np.floating], electrons: float = 5000.0) -> RasterScene:
    """Return a scene whose value 1 gives ``electrons`` in every band; the bands are 6 nm wide."""
    bands = values.shape[2]
    return made_scene(values, np.full(bands, electrons), np.linspace(450, 850, bands), fwhm_nm=np.full(bands, 6.0))


def block_of(scene: RasterScene, rig: Rig, lines: range = range(0, 30, 5), sweep: Sweep = SWEEP) -> SweepBlock:
    """Return some lines of a sweep as a block."""
    return sweep_block(scene, rig, sweep, lines)


def probed(scene: RasterScene, rig: Rig, sweep: Sweep = SWEEP) -> Probe:
    """Return the probe of a sweep, cached for all tolerances and tests."""
    asked = scene.planes.tobytes(), scene.planes.shape, scene.electrons.tobytes(), rig, sweep
    if asked not in PROBES:
        with looking_at_less():
            PROBES[asked] = survey_probe.probe_scene(scene, rig, [sweep])
    return PROBES[asked]


def decided(scene: RasterScene, rig: Rig, tolerance: float = 0.1, sweep: Sweep = SWEEP) -> Decision:
    """Return the decision for a scene and a rig."""
    return decide(probed(scene, rig, sweep), rig, EFFECTS, tolerance)


def left_out(scene: RasterScene, rig: Rig) -> dict[str, tuple[float, float]]:
    """Return change and bound of each effect of the light that is switched off, and of the whole decision (``all``).

    Changes are in units of the noise of each sample, over a few lines; all other effects are exact.
    """
    decision = decided(scene, rig)
    block = block_of(scene, rig)
    exact = expected_light(scene, block, decision.exact)
    noise = noise_electrons(exact, rig)
    slack = ROUNDING * float((np.abs(exact) / noise).max())

    def change(chosen: dict[Effect, str]) -> float:
        light = expected_light(scene, block, chosen)
        assert np.isfinite(light).all()
        return float((np.abs(light - exact) / noise).max())

    found = {"all": (change(decision.chosen), decision.error + slack)}
    for menu in (one.menu for one in decision.taken):
        if menu.present and acts_on_light(menu.effect):
            rest = {effect: way for effect, way in decision.exact.items() if effect is not menu.effect}
            found[menu.name] = (change(rest), menu.off.error + slack)
    return found
