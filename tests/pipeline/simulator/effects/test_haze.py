"""Air between rig and scene: extinction and gases against published models, limits, variants and bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.planning.coverage import full_sweeps
from spectralzoom.pipeline.simulator.effects.air import (
    ABSORPTION,
    AIR_MASS_M,
    PATH_RADIANCE,
    extinction_per_m,
    rayleigh_per_m,
    transmission,
)
from spectralzoom.pipeline.simulator.rig_model import Air, Optics, Rig, Sky
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from tests.pipeline.simulator.outdoors import BANDS, WAVELENGTH, block_of, rig_with, white_e
from tests.pipeline.simulator.small_scenes import image_scene, leave_slit_unmeasured

CLEAR_30_M, HAZY_300_M = Air(30.0, visibility_km=23.0), Air(300.0, visibility_km=5.0)
SLOPING = Air(30.0, relief="plane", nearest_m=10.0, farthest_m=100.0)


def test_extinction_matches_hand_calculation() -> None:
    """A visibility of 23 km gives 3.912 / 23 = 0.1701 /km at 550 nm; molecules are 0.0116 /km of it (0.0432 at 400)."""
    at_550 = extinction_per_m(Air(visibility_km=23.0), np.array([550.0]))[0] * 1e3
    assert at_550 == pytest.approx(0.17009, abs=1e-5)
    molecules = rayleigh_per_m(np.array([400.0, 550.0])) * 1e3
    np.testing.assert_allclose(molecules, [0.0426, 0.0115], rtol=0.02)  # Bucholtz 1995, Applied Optics 34, table 3
    at_400 = extinction_per_m(Air(visibility_km=23.0), np.array([400.0]))[0] * 1e3
    assert at_400 == pytest.approx((0.17009 - 0.01165) * (550 / 400) ** 1.14 + 0.04317, abs=1e-4)


@given(st.floats(0.05, 335.0))
def test_contrast_at_the_visibility_is_2_percent(visibility_km: float) -> None:
    """Koschmieder's definition holds at 550 nm, in any air with aerosol."""
    beta = extinction_per_m(Air(visibility_km=visibility_km), np.array([550.0]))[0]
    assert math.exp(-beta * visibility_km * 1e3) == pytest.approx(0.02, rel=3e-4)


def test_scene_at_infinity_has_the_light_of_the_horizon() -> None:
    """At infinity every scene has 0.3 of the light of the white reference."""
    rig = rig_with(Air(math.inf))
    light = PATH_RADIANCE.change(np.full((2, 640, BANDS), 5e3, np.float32), block_of(rig, range(2)), "range")
    np.testing.assert_allclose(light, np.broadcast_to(0.3 * white_e(), light.shape), rtol=1e-6)


def test_light_equal_to_the_horizon_is_unchanged() -> None:
    """At 0.3 of the white reference, path radiance replaces the light that extinction takes."""
    light = np.tile((0.3 * white_e()).astype(np.float32), (2, 640, 1))
    seen = PATH_RADIANCE.change(light.copy(), block_of(rig_with(HAZY_300_M), range(2)), "range")
    np.testing.assert_allclose(seen, light, rtol=1e-6)


@pytest.mark.parametrize("air", [CLEAR_30_M, HAZY_300_M, Air(math.inf), SLOPING])
@pytest.mark.parametrize("black", [slice(1, 2), slice(None)], ids=["one band", "all bands"])
def test_bands_without_light_have_a_finite_bound(air: Air, black: slice, monkeypatch: pytest.MonkeyPatch) -> None:
    """Path radiance is the only light of such bands; no value overflows, with any effect of the view."""
    leave_slit_unmeasured(monkeypatch)
    values = np.random.default_rng(0).uniform(0, 1, (24, 32, 3))
    values[..., black] = 0
    scene = image_scene(values, LineCamera(samples=32), [640.0, 550.0, 460.0])
    rig = Rig(LineCamera(samples=32), air=air, sky=Sky(brdf_per_rad=0.3, hot_spot=0.2))
    probe = probe_scene(scene, rig, full_sweeps(SceneGrid(24, 32, 8), rig.camera, "x"))
    assert 0 < PATH_RADIANCE.bound(probe, rig).value < np.inf


SHARP = Rig(optics=Optics(fwhm_nm=0.0))


def clear_sky(**what: float) -> tuple[np.ndarray, np.ndarray]:
    """Return SPECTRL2's wavelengths and the direct beam of a zenith sun, through air with only these constituents."""
    from pvlib.spectrum import spectrl2

    nothing = {"precipitable_water": 0.0, "ozone": 0.0, "aerosol_turbidity_500nm": 0.0, "surface_pressure": 101325.0}
    overhead = {"apparent_zenith": 0.0, "aoi": 0.0, "surface_tilt": 0.0, "ground_albedo": 0.2, "dayofyear": 172}
    sky = spectrl2(**overhead, **(nothing | {"relative_airmass": 1.0} | what))
    return sky["wavelength"], sky["dni"][:, 0] / sky["dni_extra"][:, 0]


def test_absorption_by_water_matches_spectrl2() -> None:
    """A path with 3 cm of water passes what SPECTRL2's atmosphere with 3 cm does, at its own wavelengths."""
    nm, wet = clear_sky(precipitable_water=3.0)
    known = (nm >= 570) & (nm <= 1040)
    rig = replace(SHARP, air=Air(vapour_g_per_m3=3e4 / AIR_MASS_M))
    oxygen = transmission(np.array([AIR_MASS_M]), replace(SHARP, air=Air(vapour_g_per_m3=0.0)), nm[known])[0]
    passed = transmission(np.array([AIR_MASS_M]), rig, nm[known])[0] / oxygen
    np.testing.assert_allclose(passed, (wet / clear_sky()[1])[known], rtol=2e-3)


def test_absorption_by_oxygen_matches_spectrl2() -> None:
    """A whole atmosphere of air passes what SPECTRL2's does after division by the scattering of molecules."""
    nm, through = clear_sky()
    known = (nm >= 600) & (nm <= 1000)
    micron = nm[known] / 1000
    scattered = np.exp(-1 / (micron**4 * (115.6406 - 1.3366 / micron**2)))  # Rayleigh, Eq. 2-4
    passed = transmission(np.array([AIR_MASS_M]), replace(SHARP, air=Air(vapour_g_per_m3=0.0)), nm[known])[0]
    np.testing.assert_allclose(passed, through[known] / scattered, rtol=2e-3)


def test_transmission_falls_with_the_path() -> None:
    """A path of 0 passes all light, a longer path never more, and 1e7 m almost nothing in the absorption bands."""
    passed = transmission(np.array([0.0, 1.0, 30.0, 300.0, 1e7]), Rig(), WAVELENGTH)
    assert (passed[0] == 1).all()
    assert (np.diff(passed, axis=0) <= 1e-12).all()
    assert passed[-1].min() < 1e-3


def test_relief_uses_the_transmission_of_each_distance() -> None:
    """Between knots the gain matches the transmission of the sample's own distance to 1e-4."""
    rig = rig_with(SLOPING)
    block = block_of(rig, range(0, 60, 59))
    gain = ABSORPTION.gain(block, "range")
    row = block.scan_px / ((block.shape[0] - 1) / 2)
    metres = 1 / (1 / 100 * (1 - row) / 2 + 1 / 10 * (1 + row) / 2)
    assert gain.shape == (2, 640, BANDS)
    np.testing.assert_allclose(gain[:, 1], transmission(metres, rig, WAVELENGTH), atol=1e-4)
