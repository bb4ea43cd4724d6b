"""The probe of a scene: its maxima are reached, the image does not exceed them, and unusual scenes are finite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import ROTATION, SLIT
from spectralzoom.pipeline.simulator.effects.probe import Probe, noise_electrons
from spectralzoom.pipeline.simulator.render import EFFECTS, expected_light
from spectralzoom.pipeline.simulator.rig_model import Detector, Rig
from spectralzoom.pipeline.simulator.scenes.scene import RasterScene
from spectralzoom.pipeline.simulator.selection.options import SAFETY, list_options
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene, probe_survey
from tests.pipeline.simulator.small_scenes import image_scene, leave_slit_unmeasured, made_scene

RIG = Rig(camera=LineCamera(samples=96))
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-30.0, lines=61)
BLURS: dict[Any, str] = {DIFFRACTION: "airy", ABERRATION: "gaussian", KEYSTONE: "linear"}


def scene_of(values: np.ndarray) -> RasterScene:
    """Return a scene of given values (y, x, band)."""
    return image_scene(values, RIG.camera, np.linspace(400, 900, values.shape[2]))


def mixed(seed: int, shape: tuple[int, int] = (80, 110), bands: int = 6) -> RasterScene:
    """Return grain, waves, an edge and a point of 3 components, each with a strength of its own."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    grain = rng.uniform(0, 1, (*shape, 3)) * rng.uniform(0, 0.6)
    wave = np.sin(2 * np.pi * (y * rng.normal() + x * rng.normal()) / rng.uniform(4, 30))
    wave = wave[..., None] * rng.normal(size=3)
    edge = ((y - 40) * rng.normal() + (x - 55) * rng.normal() > 0)[..., None] * rng.uniform(0, 1, 3)
    planes = np.clip(0.4 + grain + 0.2 * wave + edge, 0, None).astype(np.float32)
    planes[rng.integers(20, 60), rng.integers(20, 90)] += rng.uniform(0, 2)
    electrons = rng.uniform(50, 6e3, (3, bands)).astype(np.float32)
    return made_scene(planes, electrons, np.linspace(400, 1000, bands))


def seen(scene: RasterScene, sweep: Sweep, variant: str = "3x1", blurs: dict[Any, str] | None = None) -> np.ndarray:
    """Return all lines of a sweep through the footprint."""
    block = SweepBlock(RIG, sweep, range(sweep.lines), scene.wavelength_nm, scene.shape)
    return expected_light(scene, block, {ROTATION: "rays", SLIT: variant, **(blurs or {})})


def test_flat_scene_has_no_slope() -> None:
    """A flat scene has a level but neither slope, curvature nor span."""
    probe = probe_scene(scene_of(np.full((50, 60, 1), 3.0)), RIG, [SWEEP])
    assert probe.slope.max() == probe.curvature.max() == probe.span.max() == 0
    assert probe.level[0] == pytest.approx(probe.brightest_e / noise_electrons(np.float32([probe.brightest_e]), RIG)[0])
    assert probe.spectral_slope.shape == (1,)
    assert set(probe.slit_errors.values()) == {0.0}


def quick(probe: Callable[..., Any], *given: object) -> Any:
    """Return what a probe finds without comparing the slit's variants, which is most of its work."""
    with pytest.MonkeyPatch.context() as patch:
        leave_slit_unmeasured(patch)
        return probe(*given)


@pytest.mark.parametrize("along", ["x", "y"])
def test_wave_has_its_slope_and_curvature(along: str) -> None:
    """A long wave across the lines has slope and curvature of its amplitude and frequency, and no slope along them."""
    y, x = np.mgrid[:121, :121]  # level at the edges, which are repeated
    phase = 2 * np.pi * (y if along == "x" else x) / 24
    scene = scene_of((1 + 0.5 * np.cos(phase))[..., None])
    probe = quick(probe_scene, scene, RIG, [replace(SWEEP, along=along)], "dn")
    passed = np.sinc(RIG.camera.slit_px / 24)
    high = 0.5 * scene.electrons[0] * passed / RIG.camera.electrons_per_dn
    assert probe.slope[1, 0] == pytest.approx(high * 2 * np.pi / 24, rel=0.03)
    assert probe.curvature[1, 0] == pytest.approx(high * (2 * np.pi / 24) ** 2, rel=0.12)  # between pixels it is linear
    assert probe.slope[0, 0] < 0.02 * probe.slope[1, 0]
    assert probe.span[0] == pytest.approx(2 * high, rel=0.01)
    assert probe.unit_least_dn == 1.0


@pytest.mark.parametrize("seed", [0, 11])
def test_image_does_not_exceed_the_probe(seed: int) -> None:
    """Levels, spans and differences of neighbours stay within 1.05 of the probe's; slit variants keep their bounds."""
    scene = mixed(seed)
    sweep = replace(SWEEP, swath_px=40.0 * (seed % 3), start_px=-30.0 + seed)
    probe = probe_scene(scene, RIG, [sweep])
    light = seen(scene, sweep)
    noise = noise_electrons(light, RIG)
    level = (light / noise).max(axis=(0, 1))
    assert (level <= 1.03 * probe.level).all()
    assert (level >= 0.9 * probe.level).all()
    assert light.max() <= 1.03 * probe.brightest_e
    assert light.min() >= 0.97 * probe.darkest_e
    assert (light.max(axis=(0, 1)) - light.min(axis=(0, 1)) <= 1.05 * probe.span * noise.max(axis=(0, 1))).all()
    for axis, step in ((1, np.diff(light, axis=0)), (0, np.diff(light, axis=1))):
        least = np.minimum(noise[1:], noise[:-1]) if axis else np.minimum(noise[:, 1:], noise[:, :-1])
        assert (np.abs(step) / least).max() <= 1.05 * probe.slope[axis].max()
    blurred = seen(scene, sweep, "9x3", BLURS)
    for variant in (*SLIT.variants[1:], "off"):
        change = np.abs(seen(scene, sweep, variant, BLURS) - blurred) / noise_electrons(blurred, RIG)
        assert change.max() <= SAFETY * SLIT.bound(probe, RIG, variant).value


@pytest.mark.parametrize(("swath", "seed"), [(300.0, 0), (900.0, 1)])
def test_rotated_lines_do_not_exceed_the_probe(seed: int, swath: float) -> None:
    """Far from the middle, with lines rotated by 3 and 8 deg, each slit variant keeps its bound with all blurs on."""
    scene = mixed(seed, (80, 2000))
    sweep = replace(SWEEP, swath_px=swath)
    probe = probe_scene(scene, RIG, [sweep])
    light = seen(scene, sweep, "9x3", BLURS)
    noise = noise_electrons(light, RIG)
    for variant in (*SLIT.variants[1:], "off"):
        change = np.abs(seen(scene, sweep, variant, BLURS) - light) / noise
        bound = SLIT.bound(probe, RIG, variant).value
        assert 0 < change.max() <= SAFETY * bound <= 25 * change.max()


def test_bands_at_the_same_wavelength_have_finite_derivatives() -> None:
    """Overlapping detectors repeat wavelengths and step back; no derivative is taken across such a seam."""
    scene = replace(mixed(2, bands=4), wavelength_nm=np.array([500.0, 510.0, 510.0, 505.0]))
    probe = quick(probe_scene, scene, RIG, [SWEEP])
    assert np.isfinite(probe.spectral_slope).all()
    assert probe.spectral_slope[1] > 0


def test_probe_finds_a_single_bright_pixel_in_a_large_scene() -> None:
    """One bright pixel among 360 000 is found by its level and its slope."""
    values = np.full((600, 600, 2), 1.0)
    values[431, 222] = 5.0
    scene = scene_of(values)
    sweeps = [replace(SWEEP, name=f"{n}", swath_px=n, start_px=-300, lines=600) for n in (-252.0, -160.0, -64.0, 90.0)]
    probe = quick(probe_scene, scene, RIG, sweeps)
    assert probe.brightest_e > 1.5 * scene.electrons[0]
    assert probe.slope.min() > 10


def test_survey_has_a_probe_for_each_exposure() -> None:
    """Each probe is that of a rig which takes all lines with this exposure, except for the survey's time and lines."""
    scene = mixed(4)
    coarse = replace(SWEEP, name="c", kind="coarse", lines=15, step=4, exposure_ms=25.0)
    fast = replace(SWEEP, name="f", exposure_ms=5.0)
    probes = quick(probe_survey, scene, RIG, [coarse, SWEEP, fast])
    assert [one.sweeps for one in probes] == [(fast,), (coarse,), (SWEEP,)]
    for exposure_ms, sweep, found in ((5.0, fast, probes[0]), (25.0, coarse, probes[1])):
        told = replace(RIG, camera=replace(RIG.camera, exposure_ms=exposure_ms))
        alone = quick(probe_scene, scene, told, [replace(sweep, exposure_ms=None)])
        for name in ("level", "span", "slope", "curvature", "white_e"):
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))
        assert (found.brightest_e, found.darkest_e) == (alone.brightest_e, alone.darkest_e)
    dim, whole = ({one.name: one for one in list_options(probe, RIG, EFFECTS)} for probe in (probes[0], probes[2]))
    assert dim["lag"].off.error > 0
    assert "in 5 ms" in dim["dark-current"].off.why
    assert "in 100 ms" in whole["dark-current"].off.why


def test_survey_time_includes_slow_setups() -> None:
    """Drifts are bounded over the whole survey, including slews of 10 s and reloads of 60 s."""
    slow = CostModel(slew_s=10, reload_s=60)
    sweeps = [replace(SWEEP, name=name) for name in "ab"]
    (probe,) = quick(probe_survey, mixed(4), RIG, sweeps, "sigma", slow)
    assert probe.seconds == slow.seconds(sweeps, RIG.camera) > CostModel().seconds(sweeps, RIG.camera) + 60


def test_probe_of_a_noiseless_rig_is_finite() -> None:
    """The unit is the noise of quantisation, also where there is no light, and every effect has a finite bound."""
    values = np.zeros((60, 60, 3))
    values[30:] = 1.0
    noiseless = replace(RIG, detector=Detector(noiseless=True))
    probe = probe_scene(scene_of(values), noiseless, [SWEEP])
    found = (probe.level, probe.span, probe.slope, probe.curvature, probe.spectral_slope)
    assert all(np.isfinite(one).all() for one in (*found, list(probe.slit_errors.values())))
    assert probe.unit_least_dn == pytest.approx(1 / np.sqrt(12))
    assert all(np.isfinite(menu.off.error) for menu in list_options(probe, noiseless, EFFECTS))


def test_survey_without_lines_is_refused() -> None:
    """A probe needs at least one line."""
    with pytest.raises(SettingsError, match="no sweep has a line"):
        probe_scene(mixed(0), RIG, [replace(SWEEP, lines=0)])


def test_sweep_outside_of_the_scene_has_a_finite_probe() -> None:
    """Lines that miss the scene see its repeated edge."""
    probe: Probe = quick(probe_scene, mixed(1), RIG, [replace(SWEEP, swath_px=900.0, start_px=800.0)])
    assert np.isfinite(probe.slope).all()
    assert np.isfinite(probe.level).all()
