"""Laws of every effect: absent ones change nothing, bounds hold, block size does not matter, seeds decide draws."""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import spectralzoom.pipeline.simulator.effects as package
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator import render as registry
from spectralzoom.pipeline.simulator.effects.effect import OFF, Bound, Effect
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.effects.probe import Probe
from spectralzoom.pipeline.simulator.readout import read_out
from spectralzoom.pipeline.simulator.render import AIMS, BY_NAME, EFFECTS, FOOTPRINT, RAYS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Detector, MirrorMotion, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection.choice import decide, list_effects
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from spectralzoom.pipeline.simulator.simulated import sweep_block
from tests.pipeline.simulator.bound_trials import trials
from tests.pipeline.simulator.made_up_effects import even_probe
from tests.pipeline.simulator.random_cases import random_case
from tests.pipeline.simulator.small_scenes import looking_at_less, made_scene

RIG = Rig(  # with every effect
    LineCamera(samples=48, exposure_ms=20.0),
    Optics(aberration_px=0.3, keystone_px=0.4, smile_nm=0.8, stray_fraction=0.02, stray_halo_px=8.0),
    MirrorMotion(positions_per_line=1.5, repeatability_urad=40.0, hysteresis_px=3.0, drift_px_per_min=50.0),
    Detector(dead_fraction=0.02, hot_fraction=0.02, dark_e_per_s=1000.0),
    Air(40.0, "step", 30.0, 60.0, visibility_km=2.0, turbulence_cn2=1e-12, wind_amplitude_m=0.02),
    Sky(datetime(2026, 6, 21, 5, 34, tzinfo=UTC), cloud_fraction=0.4, cloud_size_px=40.0, hot_spot=0.1),
)
WITHOUT: dict[str, dict[str, Any]] = {  # settings of a rig that lacks an effect
    "staircase": {"mirror": {"positions_per_line": 1.0}},
    "jitter": {"mirror": {"repeatability_urad": 0.0}},
    "hysteresis": {"mirror": {"hysteresis_px": 0.0}},
    "thermal-drift": {"mirror": {"drift_px_per_min": 0.0}},
    "turbulence": {"air": {"turbulence_cn2": 0.0}},
    "parallax": {"air": {"relief": "flat"}},
    "wind": {"air": {"wind_amplitude_m": 0.0}},
    "defocus": {"optics": {"focus_m": 40.0}},
    "aberration": {"optics": {"aberration_px": 0.0}},
    "keystone": {"optics": {"keystone_px": 0.0}},
    "drift": {"sky": {"started": None}},
    "cloud": {"sky": {"cloud_fraction": 0.0}},
    "brdf": {"sky": {"brdf_per_rad": 0.0, "hot_spot": 0.0}},
    "path-radiance": {"air": {"distance_m": None}},
    "absorption": {"air": {"distance_m": None}},
    "response": {"optics": {"fwhm_nm": 0.0}},
    "smile": {"optics": {"smile_nm": 0.0}},
    "polarisation": {"mirror": {"coating": "ideal"}},
    "stray-light": {"optics": {"stray_fraction": 0.0}},
    "prnu": {"detector": {"prnu_std": 0.0}},
    "striping": {"detector": {"striping_std": 0.0}},
    "dark-current": {"detector": {"dark_e_per_s": 0.0}},
    "defects": {"detector": {"dead_fraction": 0.0, "hot_fraction": 0.0}},
    "shot": {"detector": {"noiseless": True}},
    "read-noise": {"camera": {"read_noise_e": 0.0}},
}
OF_THE_SEED = {"jitter", "turbulence", "wind", "cloud", "shot", "read-noise"}  # all others belong to the rig
FINE = Sweep("fine", "fine", "x", 3.0, -12.0, 15)
COARSE = Sweep("coarse", "coarse", "y", -6.0, -9.0, 5, 4, 4)
CASES = {  # of the first twelve cases: effects that find nearly all low bounds; an empty tuple takes every effect
    1: ("parallax", "turbulence", "defocus", "path-radiance", "absorption", "brdf"),
    5: ("stray-light", "lag", "prnu", "rotation"),
    6: ("aberration", "vignetting", "jitter", "rotation", "slit"),
    8: ("hysteresis", "diffraction", "keystone", "response", "jitter", "lag", "prnu"),
    10: ("thermal-drift", "striping"),
    11: (),
}
each_effect = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
each_variant = pytest.mark.parametrize(
    ("effect", "variant"),
    [(one, variant) for one in EFFECTS for variant in one.variants],
    ids=lambda one: getattr(one, "name", one),
)


@cache
def scene(flat: bool = False) -> RasterScene:
    """Return 3 components of 6 bands of 2 nm: grain that differs at every pixel, with a bright pixel, or ``flat``."""
    rng = np.random.default_rng(0)
    planes = np.full((60, 70, 3), 0.5) if flat else rng.uniform(0, 1, (60, 70, 3))
    planes[31, 36] *= 1 if flat else 8
    nm = np.linspace(700, 800, 6)
    return made_scene(planes, rng.uniform(1e4, 3e4, (3, 6)), nm, fwhm_nm=np.full(6, 2.0))


@cache
def probe(flat: bool = False) -> Probe:
    """Return the probe of the scene, on which the decision is based."""
    with looking_at_less():
        return replace(probe_scene(scene(flat), RIG, (FINE,)), seconds=600.0)


def rig_without(name: str) -> Rig:
    """Return the rig without one effect."""
    return replace(RIG, **{part: replace(getattr(RIG, part), **values) for part, values in WITHOUT[name].items()})


def taken(
    chosen: dict[Effect, str], rig: Rig = RIG, lines: range | None = None, *, sweep: Sweep = FINE, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
    """Return light and raw numbers of some lines, with rotated slits and the chosen effects."""
    with_rays = {ROTATION: "rays", SLIT: "1x1"} | chosen
    ordered = {one: with_rays[one] for one in EFFECTS if one in with_rays}
    block = sweep_block(scene(), rig, sweep, lines or range(sweep.lines), seed=seed, started_s=500.0)
    light = expected_light(scene(), block, ordered)
    return light, read_out(light.copy(), block, ordered)


@pytest.mark.parametrize("name", WITHOUT)
def test_effect_that_the_rig_lacks_changes_nothing(name: str):
    """The effect's bound is 0 and the numbers are those without it; on a rig that has the effect they differ."""
    effect = BY_NAME[name]
    lacking = rig_without(name)
    assert effect.bound(probe(), lacking).value == 0
    for variant in effect.variants:
        for on, off in zip(taken({effect: variant}, lacking), taken({}, lacking), strict=True):
            np.testing.assert_allclose(on, off, rtol=1e-6)
    assert (taken({effect: effect.variants[0]})[1] != taken({})[1]).any()


@each_variant
@pytest.mark.parametrize("sweep", [FINE, COARSE], ids=["fine", "coarse"])
def test_lines_do_not_depend_on_the_block_size(effect: Effect, variant: str, sweep: Sweep):
    """Blocks of one and of three lines have the bits of the whole sweep."""
    whole = taken({effect: variant}, sweep=sweep)
    for size in (1, 3):
        blocks = [range(first, first + size) for first in range(0, sweep.lines - size + 1, 2 * size)]
        for lines in blocks:
            for part, all_of_it in zip(taken({effect: variant}, lines=lines, sweep=sweep), whole, strict=True):
                np.testing.assert_array_equal(part, all_of_it[lines.start : lines.stop])


@each_variant
def test_seed_changes_only_the_draws_of_a_survey(effect: Effect, variant: str):
    """The same seed gives the same numbers; another seed leaves all effects of the rig itself unchanged."""
    one, same, other = (taken({effect: variant}, seed=seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() == (effect.name in OF_THE_SEED)


@each_effect
def test_effects_are_complete(effect: Effect):
    """Each variant has a cost, bounds are finite with reasons, the exact one's is 0, and effects are hashable."""
    assert effect.variants
    assert OFF not in effect.variants
    assert set(effect.cost_ns) == set(effect.variants)
    assert all(cost >= 0 for cost in effect.cost_ns.values())
    assert {effect: 1}[effect] == 1
    for seen in (probe(), even_probe()):
        for variant in (OFF, *effect.variants):
            bound = effect.bound(seen, RIG, variant)
            assert isinstance(bound, Bound)
            assert 0 <= bound.value < np.inf
            assert bound.why
        assert effect.bound(seen, RIG, effect.variants[0]).value == 0


@pytest.mark.parametrize("effect", [*AIMS, *RAYS, *FOOTPRINT], ids=lambda effect: effect.name)
def test_flat_scenes_show_no_shift_and_no_blur(effect: Effect):
    """The bound is 0 without slope, curvature and span; without lines it is 0 for mirror, rotation, parallax, smear."""
    for variant in (OFF, *effect.variants):
        assert effect.bound(probe(flat=True), RIG, variant).value == pytest.approx(0, abs=1e-3)
    none = even_probe(sweeps=(), lines=0, slope=np.ones((2, 1)), curvature=np.ones((2, 1)))
    if effect in AIMS[:-1] or effect.name in ("parallax", "rotation", "smear"):
        assert effect.bound(none, RIG).value == 0


@pytest.mark.parametrize(("number", "effects"), CASES.items())
def test_no_change_exceeds_its_bound(number: int, effects: tuple[str, ...]):
    """A case's effects are left out, and their variants taken, with all others exact.

    The last case has a mirror that swings within its exposures: that is left out with the smear.
    """
    found = list(trials(random_case(number), effects))
    assert set(effects or ["slit"]) <= {trial.effect for trial in found}
    assert [trial for trial in found if trial.is_broken] == []


@each_variant
def test_no_variant_makes_light_negative(effect: Effect, variant: str):
    """One bright pixel through every variant of every effect, with all exact blurs, gives finite light of 0 or more."""
    blurs: dict[Effect, str] = {blur: blur.variants[0] for blur in FOOTPRINT if hasattr(blur, "moments")}
    light = taken(blurs | {effect: variant})[0]
    assert np.isfinite(light).all()
    assert light.min() >= 0


@each_effect
@pytest.mark.parametrize("step", [1, 4])
def test_extreme_rigs_give_finite_light(effect: Effect, step: int):
    """At the limits of mirror and air settings light is finite, also in a block without lines; no bound is negative."""
    slow = MirrorMotion(0.1, 1e3, 1e2, 1e2, damping=0.01, settled_s=0.0, positions_per_line=0.01)
    stiff = MirrorMotion(1e5, 0.0, 0.0, 0.0, damping=10.0, settled_s=1e4, positions_per_line=1e4)
    far = Air(distance_m=np.inf, relief="plane", nearest_m=1e-3, wind_amplitude_m=100.0, wind_hz=50.0)
    sweep = replace(FINE, step=step, lines=3)
    for mirror in (slow, stiff):
        rig = replace(RIG, mirror=mirror, air=far)
        for variant in effect.variants:
            for lines in (range(3), range(2, 2)):
                assert np.isfinite(taken({effect: variant}, rig, lines, sweep=sweep)[0]).all()
        for variant in (OFF, *effect.variants):
            assert effect.bound(replace(probe(), sweeps=(sweep,)), rig, variant).value >= 0


def test_manifest_lists_every_effect():
    """The order is the chain's; at tolerance 0 all effects of the rig are on and exact, and any others absent."""
    rows = list_effects(decide(probe(), RIG, EFFECTS, 0.0))
    assert [row["name"] for row in rows] == [effect.name for effect in EFFECTS]
    others = [row for row in rows if row["variant"] != BY_NAME[row["name"]].variants[0]]
    assert [(row["name"], row["reason"]) for row in others] == [("smear", "absent")]
    lacking = {row["name"]: row for row in list_effects(decide(probe(), rig_without("keystone"), EFFECTS, 0.0))}
    assert (lacking["keystone"]["state"], lacking["keystone"]["reason"]) == ("off", "absent")


def test_every_effect_of_every_module_is_registered_once():
    """The effects of a forgotten module would never be computed."""
    names = [f"{package.__name__}.{one.name}" for one in pkgutil.iter_modules(package.__path__)]
    there = [
        one
        for module in map(importlib.import_module, names)
        if module is not registry
        for name, one in vars(module).items()
        if not name.startswith("__") and type(one).__module__ == module.__name__
        if hasattr(one, "bound") and hasattr(one, "variants")
    ]
    assert {one.name: type(one) for one in there} == {one.name: type(one) for one in EFFECTS}
    assert len(EFFECTS) == len({one.name for one in EFFECTS}) == len(there)
