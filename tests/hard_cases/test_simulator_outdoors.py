"""Hard cases of the simulator's mirror and weather: damping 1, stiff mirrors, sunset, night, infinite distance."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.effects.air import PARALLAX, PATH_RADIANCE, TURBULENCE, turbulence_px
from spectralzoom.pipeline.simulator.effects.blurs import DEFOCUS
from spectralzoom.pipeline.simulator.effects.lighting import DRIFT
from spectralzoom.pipeline.simulator.effects.line import ROTATION
from spectralzoom.pipeline.simulator.effects.pointing import LAG
from spectralzoom.pipeline.simulator.readout import read_out
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, MirrorMotion, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.daylight import sun_elevation_deg
from spectralzoom.pipeline.simulator.selection.choice import Decision, decide
from tests.hard_cases.simulated_scene import CAMERA, RIG, block_of, decided, left_out, probed, scene_of

TEXTURE = scene_of(np.random.default_rng(0).uniform(0.2, 1, (60, 80, 3)))
FLAT = scene_of(np.ones((60, 80, 3)))
EVENING = Sky(started=datetime(2026, 6, 21, 19, 30, tzinfo=UTC))  # about half an hour before sunset at 52 N, 10 E
NIGHT = Sky(started=datetime(2026, 6, 21, 23, 20, tzinfo=UTC))


def moving(exposure_ms: float, **mirror: float) -> Rig:
    """Return a rig with another exposure and other mirror settings."""
    return replace(RIG, camera=replace(CAMERA, exposure_ms=exposure_ms), mirror=MirrorMotion(**mirror))


@cache
def damped(damping: float) -> tuple[NDArray[np.float32], Decision]:
    """Return the light with lag at 3 ms lines, and the decision."""
    rig = moving(3.0, damping=damping)
    return expected_light(TEXTURE, block_of(TEXTURE, rig), {LAG: "exact", ROTATION: "rays"}), decided(TEXTURE, rig)


@pytest.mark.parametrize("damping", [1 - 1.2e-16, 1 + 2.3e-16, 1 - 1e-9])
def test_critical_damping_is_the_limit_from_both_sides(damping: float) -> None:
    """Close to damping 1, light, choice and error match those at damping 1, and lag is on at 3 ms lines."""
    (light, decision), (limit, critical) = damped(damping), damped(1.0)
    assert damping != 1
    np.testing.assert_allclose(light, limit, rtol=1e-5)
    assert LAG in critical.chosen
    assert decision.chosen == critical.chosen
    assert decision.error == pytest.approx(critical.error, rel=1e-6)


@pytest.mark.parametrize(
    ("natural_hz", "damping", "exposure_ms"),
    [(1e5, 10.0, 1000.0), (1e5, 0.01, 3.0), (5.0, 0.01, 100.0), (0.1, 10.0, 3.0)],
)
def test_stiff_and_slow_mirrors_keep_every_bound(natural_hz: float, damping: float, exposure_ms: float) -> None:
    """Lags range from 0 to 10,000 px, where lines have another rotation than planned."""
    for change, counted in left_out(TEXTURE, moving(exposure_ms, damping=damping, natural_hz=natural_hz)).values():
        assert change <= counted < math.inf


def test_light_ends_at_sunset() -> None:
    """Light decreases until sunset and is 0 for the 4 h after it; raw numbers without noise are then the dark level."""
    rig = replace(RIG, sky=EVENING)
    seconds = np.arange(3600.0)
    levels = []
    sunset_s = float(seconds[sun_elevation_deg(EVENING, seconds) <= 0][0])
    for beside in (-600.0, -60.0, -10.0, 10.0, 600.0, 4 * 3600.0):
        block = replace(block_of(FLAT, rig, range(1)), started_s=sunset_s + beside)
        light = expected_light(FLAT, block, {DRIFT: "spectral"})
        assert np.isfinite(light).all()
        levels.append(float(light.max()))
    assert levels == sorted(levels, reverse=True)
    assert levels[2] > 0
    assert levels[3:] == [0, 0, 0]
    assert (read_out(light, block, {}) == 64).all()


def test_drift_of_a_survey_into_the_night_is_bounded_by_the_level() -> None:
    """Leaving out drift errs by the whole level; drift is on, with an error within 0.1."""
    rig = replace(RIG, sky=EVENING)
    probe = replace(probed(FLAT, rig), seconds=2 * 3600.0)
    assert DRIFT.bound(probe, rig).value == pytest.approx(probe.level.max())
    decision = decide(probe, rig, EFFECTS, 0.1)
    assert DRIFT in decision.chosen
    assert decision.error <= 0.1


@pytest.mark.parametrize("sky", [NIGHT, replace(EVENING, started=datetime(2026, 6, 21, 19, 50, tzinfo=UTC))])
def test_survey_in_the_dark_keeps_every_bound(sky: Sky) -> None:
    """At night and at sunset, with clouds, a hot spot and air, changes are finite and within their bounds."""
    rig = replace(RIG, sky=replace(sky, cloud_fraction=0.5, hot_spot=0.2), air=Air(distance_m=300.0))
    found = left_out(TEXTURE, rig)
    assert {"drift", "cloud", "brdf", "path-radiance"} <= set(found)
    for change, counted in found.values():
        assert change <= counted < math.inf


@cache
def seen_from(distance_m: float, focus_m: float) -> tuple[NDArray[np.float32], Decision]:
    """Return the light with all effects exact, and the decision."""
    rig = replace(RIG, air=Air(distance_m=distance_m, wind_amplitude_m=0.1), optics=Optics(focus_m=focus_m))
    decision = decided(TEXTURE, rig)
    return expected_light(TEXTURE, block_of(TEXTURE, rig), decision.exact), decision


@pytest.mark.parametrize("focus_m", [60.0, math.inf])
def test_very_large_distance_equals_infinity(focus_m: float) -> None:
    """Light and error at 1e300 m match those at infinity; path radiance is on, and defocus with the focus at 60 m."""
    (light, decision), (limit, endless) = seen_from(1e300, focus_m), seen_from(math.inf, focus_m)
    assert np.isfinite(limit).all()
    np.testing.assert_allclose(light, limit, rtol=1e-5)
    assert decision.error == pytest.approx(endless.error, rel=0.01)
    assert PATH_RADIANCE in endless.chosen
    assert (DEFOCUS in endless.chosen) == (focus_m == 60.0)


@pytest.mark.parametrize(("relief", "focus_m"), [("flat", 60.0), ("step", 30.0)])
def test_scene_that_reaches_to_the_horizon_keeps_every_bound(relief: str, focus_m: float) -> None:
    """The farthest part lies at infinity: after a step, parallax there is the lever over the scene's 30 m."""
    air = Air(distance_m=30.0, nearest_m=20.0, farthest_m=math.inf, relief=relief)  # type: ignore[arg-type]
    rig = replace(RIG, air=air, optics=Optics(focus_m=focus_m))
    for change, counted in left_out(TEXTURE, rig).values():
        assert change <= counted < math.inf
    along = np.array([[-31.5, 31.5]])
    moved, _ = PARALLAX.displaced(block_of(TEXTURE, rig), along, np.full((1, 2), -29.5), "exact")
    lever = air.lever_m * (0 if relief == "flat" else -1 / 30)
    np.testing.assert_allclose(moved, lever * along, atol=1e-12)


def test_flat_scene_at_infinity_shows_no_turbulence() -> None:
    """An infinite path and a slope of 0 give a bound of 0, not NaN."""
    rig = replace(RIG, air=Air(distance_m=math.inf))
    assert math.isfinite(turbulence_px(rig))
    assert TURBULENCE.bound(probed(FLAT, rig), rig).value == 0


def test_bound_of_rotation_includes_turbulence() -> None:
    """Turbulence moves the view off the plan and so rotates a line of 640 samples, by more than 0.05 sigma."""
    air = Air(distance_m=300.0, visibility_km=1e6, airlight_fraction=0.0, vapour_g_per_m3=0.0)
    rig = Rig(air=air, optics=Optics(focus_m=300.0, aberration_px=0.0, stray_fraction=0.0))
    change, counted = left_out(scene_of(np.random.default_rng(0).uniform(0.2, 1, (60, 680, 1))), rig)["rotation"]
    assert 0.05 < change <= counted
