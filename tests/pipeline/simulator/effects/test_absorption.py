"""Absorption along the path: against its published band model, limits, its variants and bounds, and blocks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.simulator.effects.haze import ABSORPTION, AIR_MASS_M, OXYGEN, WATER, transmission
from pipeline.simulator.rig_model import Air, Optics, Rig
from tests.pipeline.simulator.outdoors import BANDS, WAVELENGTH, block_of, measured, probe_of, rig_with

SLOPING = Air(30.0, relief="plane", nearest_m=10.0, farthest_m=100.0)
SHARP = Rig(optics=Optics(fwhm_nm=0.0))


def clear_sky(**what: float) -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths of SPECTRL2 and the sun's beam from the zenith through air with nothing but what is asked for."""
    from pvlib.spectrum import spectrl2

    nothing = {"precipitable_water": 0.0, "ozone": 0.0, "aerosol_turbidity_500nm": 0.0, "surface_pressure": 101325.0}
    overhead = {"apparent_zenith": 0.0, "aoi": 0.0, "surface_tilt": 0.0, "ground_albedo": 0.2, "dayofyear": 172}
    sky = spectrl2(**overhead, **(nothing | {"relative_airmass": 1.0} | what))
    return sky["wavelength"], sky["dni"][:, 0] / sky["dni_extra"][:, 0]


def test_water_is_spectrl2s() -> None:
    """A way with 3 cm of water passes what SPECTRL2's atmosphere with 3 cm does, at its own wavelengths."""
    nm, wet = clear_sky(precipitable_water=3.0)
    dry = clear_sky()[1]
    known = (nm >= 570) & (nm <= 1040)
    rig = replace(SHARP, air=Air(vapour_g_per_m3=3e4 / AIR_MASS_M))
    oxygen = transmission(np.array([AIR_MASS_M]), replace(SHARP, air=Air(vapour_g_per_m3=0.0)), nm[known])[0]
    passed = transmission(np.array([AIR_MASS_M]), rig, nm[known])[0] / oxygen
    np.testing.assert_allclose(passed, (wet / dry)[known], rtol=2e-3)


def test_oxygen_is_spectrl2s() -> None:
    """A whole atmosphere's worth of air passes what SPECTRL2's does once the molecules' scattering is divided out."""
    nm, through = clear_sky()
    known = (nm >= 600) & (nm <= 1000)
    micron = nm[known] / 1000
    scattered = np.exp(-1 / (micron**4 * (115.6406 - 1.3366 / micron**2)))  # Rayleigh, Eq. 2-4
    passed = transmission(np.array([AIR_MASS_M]), replace(SHARP, air=Air(vapour_g_per_m3=0.0)), nm[known])[0]
    np.testing.assert_allclose(passed, through[known] / scattered, rtol=2e-3)


def test_by_hand() -> None:
    """300 m at 10 g/m^3 hold 0.3 cm of water: x = 55 * 0.3, exp(-0.2385 x / (1 + 20.07 x)^0.45) = 0.749 at 937 nm."""
    x = 55 * 0.3
    by_hand = math.exp(-0.2385 * x / (1 + 20.07 * x) ** 0.45)
    assert transmission(np.array([300.0]), SHARP, np.array([937.0]))[0, 0] == pytest.approx(by_hand, rel=1e-9)
    assert by_hand == pytest.approx(0.749, abs=5e-4)


def test_bands_smooth_the_line() -> None:
    """The wider the band, the less of oxygen's depth it sees at 762.5 nm; the window at 870 nm passes all."""
    depth = [
        1 - transmission(np.array([300.0]), Rig(optics=Optics(fwhm_nm=fwhm)), np.array([762.5, 870.0]))[0]
        for fwhm in (0.0, 6.0, 40.0)
    ]
    assert depth[0][0] > depth[1][0] > depth[2][0] > 0
    assert max(one[1] for one in depth[:2]) < 1e-3


def test_limits() -> None:
    """No way passes all; an endless one nothing in the bands; more way never passes more."""
    passed = transmission(np.array([0.0, 1.0, 30.0, 300.0, 1e7]), Rig(), WAVELENGTH)
    assert (passed[0] == 1).all()
    assert (np.diff(passed, axis=0) <= 1e-12).all()
    assert passed[-1].min() < 1e-3


def test_tables_are_in_order() -> None:
    """Wavelengths rise and both ends are 0 or next to it."""
    for table in (WATER, OXYGEN):
        assert (np.diff(table[:, 0]) > 0).all()
        assert table[[0, -1], 1].max() < 1e-4


def test_no_distance_no_air() -> None:
    """A scene without a distance is light at the aperture."""
    rig = rig_with()
    assert ABSORPTION.bound(probe_of(rig), rig).value == 0
    assert (ABSORPTION.gain(block_of(rig), "range") == 1).all()


@pytest.mark.parametrize("variant", ["off", "uniform"])
@pytest.mark.parametrize("air", [Air(30.0), Air(300.0), SLOPING, Air(30.0, "step", 5.0, 60.0), Air(math.inf)])
def test_bound_holds_and_is_near(air: Air, variant: str) -> None:
    """The change of any material is within the bound, and the bound within 6 times of it."""
    rig = rig_with(air)
    bound, seen = ABSORPTION.bound(probe_of(rig), rig, variant).value, measured(ABSORPTION, rig, variant)
    assert seen <= 1.2 * bound
    assert seen >= bound / 6


def test_relief_between_knots() -> None:
    """Each sample's own distance gives the transmission of that distance to 1e-4."""
    rig = rig_with(SLOPING)
    block = block_of(rig, range(0, 60, 59), samples=range(3))
    gain = ABSORPTION.gain(block, "range")
    row = block.scan_px / ((block.shape[0] - 1) / 2)
    metres = 1 / (1 / 100 * (1 - row) / 2 + 1 / 10 * (1 + row) / 2)
    assert gain.shape == (2, 3, BANDS)
    np.testing.assert_allclose(gain[:, 1], transmission(metres, rig, WAVELENGTH), atol=1e-4)


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_matter(size: int) -> None:
    """Lines and samples are the same in blocks of any size."""
    rig = rig_with(SLOPING)
    whole = ABSORPTION.gain(block_of(rig, range(20)), "range")
    ranges = [range(start, min(start + size, 20)) for start in range(0, 20, size)]
    parts = [ABSORPTION.gain(block_of(rig, some), "range") for some in ranges]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    some = ABSORPTION.gain(block_of(rig, range(20), samples=range(100, 107)), "range")
    np.testing.assert_array_equal(some, whole[:, 100:107])
