"""Effects that a scene and a rig need at a tenth of the noise: one test for every case of the design's table."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.probe import Probe, noise_electrons
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.selection.choice import Decision, decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.bound_trials import ROUNDING, misplaced_fraction
from tests.pipeline.simulator.small_scenes import looking_at_less, made_scene

TOLERANCE = 0.1
CAMERA = LineCamera()
WAVELENGTHS = np.array([500.0, 550.0, 600.0])
SWEEPS = (Sweep("near", "fine", "x", 0.0, -30.0, 60), Sweep("far", "fine", "x", 0.0, 400.0, 60))
NOON = datetime(2026, 6, 21, 11, 20, tzinfo=UTC)
LOW_SUN = datetime(2026, 6, 21, 5, 20, tzinfo=UTC)  # about 20 deg high at 52 N, 10 E
DIM, BRIGHT, ROOF = 50.0, 10_000.0, 40_000.0


@dataclass(frozen=True)
class Case:
    """A scene of given electrons at the exposure, with an optional gentle texture or roof, and a rig."""

    electrons: float = 2_000.0
    texture: float = 0.0  # amplitude of waves of 40 px, over the electrons
    roof_e: float = 0.0
    rig: Rig = field(default_factory=lambda: Rig(camera=CAMERA))
    seconds: float | None = None  # from the first line to the last; None is that of the sweeps


@cache
def scene_of(case: Case) -> RasterScene:
    """Return a scene of one component that is the same in all bands."""
    y, x = np.mgrid[:1000, :680]
    plane = case.electrons * (1 + case.texture * np.sin(2 * np.pi * (x + y) / 40))
    if case.roof_e:
        plane[490:510, 70:90] = case.roof_e
    spectra = np.full((1, 3), DEFAULT_EXPOSURE_MS / case.rig.camera.exposure_ms, np.float32)
    white = 2 * case.electrons * spectra[0]  # the scene reflects about half
    return made_scene(plane[..., None], spectra, WAVELENGTHS, white)


@cache
def probed(case: Case) -> Probe:
    """Return the probe of a case, from few samples: waves, a roof and flat fields repeat themselves."""
    with looking_at_less():
        probe = probe_scene(scene_of(case), case.rig, SWEEPS)
    return probe if case.seconds is None else replace(probe, seconds=case.seconds)


@cache
def decided(case: Case) -> Decision:
    """Return the decision for a case."""
    return decide(probed(case), case.rig, EFFECTS, TOLERANCE)


def rig_of(*, exposure_ms: float = 100.0, **parts: object) -> Rig:
    """Return a rig with some parts other than the defaults."""
    return Rig(camera=replace(CAMERA, exposure_ms=exposure_ms), **parts)


FLAT = Case()
NOISELESS = Case(rig=rig_of(detector=Detector(noiseless=True)))
BRIGHT_FLAT = Case(BRIGHT, rig=rig_of(mirror=MirrorMotion(coating="ideal")))  # others use up the tolerance
HAZY_300_M = Case(DIM, 0.08, rig=rig_of(air=Air(distance_m=300.0, visibility_km=2.0, turbulence_cn2=1e-12)))
FOUR_HOURS = Case(rig=rig_of(sky=Sky(started=LOW_SUN)), seconds=4 * 3600.0)
ONE_SWEEP_AT_NOON = Case(rig=rig_of(sky=Sky(started=NOON)), seconds=6.0)
DEPTH_STEP = Case(  # focused on the scene: with the focus at infinity the blur would be 33 px
    texture=0.2, rig=rig_of(air=Air(distance_m=3.0, nearest_m=2.0, relief="step"), optics=Optics(focus_m=3.0))
)
TABLE = [
    pytest.param(
        FLAT,
        "vignetting,shot,read-noise,prnu,striping",
        "slit,smear,diffraction,defocus,aberration,keystone,turbulence,rotation",
        id="flat field",
    ),
    pytest.param(NOISELESS, "", "shot,read-noise,dark-current", id="noiseless"),
    pytest.param(BRIGHT_FLAT, "shot", "read-noise", id="10,000 electrons"),
    pytest.param(Case(DIM, rig=rig_of(exposure_ms=1000.0)), "dark-current", "", id="dim at 1 s"),
    pytest.param(Case(texture=0.01, rig=rig_of(exposure_ms=3.0)), "lag", "", id="3 ms lines"),
    pytest.param(Case(texture=0.01), "", "lag", id="100 ms lines"),
    pytest.param(Case(300.0, 0.02, rig=rig_of(air=Air(distance_m=30.0))), "", "wind", id="30 m calm"),
    pytest.param(HAZY_300_M, "path-radiance,turbulence", "", id="300 m hazy"),
    pytest.param(FOUR_HOURS, "drift", "", id="sun at 20 deg over 4 h"),
    pytest.param(ONE_SWEEP_AT_NOON, "", "drift", id="6 s at noon"),
    pytest.param(Case(roof_e=ROOF), "stray-light,saturation", "", id="bright roof"),
    pytest.param(DEPTH_STEP, "parallax", "", id="depth step at 3 m"),
]


@pytest.mark.parametrize(("case", "on", "off"), TABLE)
def test_effects_switch_as_in_the_design_table(case: Case, on: str, off: str):
    """Rigs have default settings except for those that the row names; the error stays within the tolerance."""
    states = {one.name: one.is_on for one in decided(case).taken}
    assert [name for name in on.split(",") if name and not states[name]] == []
    assert [name for name in off.split(",") if name and states[name]] == []
    assert decided(case).error <= TOLERANCE


@pytest.mark.parametrize("case", [pytest.param(row.values[0], id=row.id) for row in TABLE])
def test_light_of_the_decision_keeps_its_bound(case: Case):
    """Some lines of both sweeps, with everything on and with the choice, differ by at most the decision's error."""
    scene = scene_of(case)
    rig = case.rig
    probe = probed(case)
    decision = decided(case)
    ends = (0.0, 0.0 if case.seconds is None else case.seconds - rig.camera.scan_seconds(SWEEPS[1].lines))
    misplaced_e = misplaced_fraction(decision.exact, decision.chosen) * (probe.brightest_e - probe.darkest_e)
    for sweep, start in zip(SWEEPS, ends, strict=True):
        block = sweep_block(scene, rig, sweep, range(0, sweep.lines, 19), started_s=start)
        light, full = (expected_light(scene, block, one) for one in (decision.chosen, decision.exact))
        left = (np.abs(light - full) - misplaced_e - ROUNDING * full.max()) / noise_electrons(full, rig)
        assert left.max() <= decision.error
