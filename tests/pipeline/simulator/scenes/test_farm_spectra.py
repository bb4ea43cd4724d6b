"""Spectra of the farm's materials: what remote sensing knows of them must hold in any bands."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import WavelengthError
from pipeline.geometry.camera import LineCamera, digitise
from pipeline.simulator.scenes.farm.spectra import FWHM_NM, MATERIALS, OTHERS, STAGES, band_response, spectral_library

LEAFY = [name for name in (*OTHERS, *STAGES) if not name.endswith(("dry", "ripe", "autumn", "old"))]


def at(name: str, nm: float) -> float:
    """Reflectance of a material in the band nearest a wavelength."""
    library = spectral_library(270)
    return float(library.reflectance[MATERIALS.index(name), np.abs(library.wavelength_nm - nm).argmin()])


def test_reflectance_is_physical() -> None:
    """Every material reflects between nothing and everything in every band."""
    reflectance = spectral_library(270).reflectance
    assert reflectance.shape == (len(MATERIALS), 270)
    assert reflectance.min() > 0
    assert reflectance.max() < 0.75


@pytest.mark.parametrize("name", LEAFY)
def test_canopies_show_a_red_edge(name: str) -> None:
    """Green plants have an NDVI above 0.6 and a green peak."""
    near, red = at(name, 800), at(name, 670)
    assert (near - red) / (near + red) > 0.6
    assert at(name, 552) > max(at(name, 480), red)


def test_water_and_shade_are_dark() -> None:
    """Water and shade reflect less than 6 % anywhere, and water next to nothing in the near infrared."""
    dark = spectral_library(270).reflectance[[MATERIALS.index("water"), MATERIALS.index("shade")]]
    assert dark.max() < 0.06
    assert at("water", 900) < 0.02


def test_wet_soil_is_darker_than_dry() -> None:
    """Moisture darkens soil in every band."""
    reflectance = spectral_library(270).reflectance
    wet, dry = reflectance[MATERIALS.index("soil_wet")], reflectance[MATERIALS.index("soil_dry")]
    assert (wet < 0.7 * dry).all()


@pytest.mark.parametrize("stand", ["young", "full", "filling", "lodged"])
def test_twins_differ_at_the_red_edge_alone(stand: str) -> None:
    """The two wheats differ by more than 5 % about 715 nm, and by less than 0.1 % outside 680-750 nm."""
    library = spectral_library(270)
    ratio = (
        library.reflectance[MATERIALS.index(f"wheat_b_{stand}")]
        / library.reflectance[MATERIALS.index(f"wheat_a_{stand}")]
    )
    off = np.abs(library.wavelength_nm - 715)
    assert (ratio[off < 8] > 1.05).all()
    assert np.abs(ratio[off > 35] - 1).max() < 1e-3


@pytest.mark.parametrize("bands", [2, 4, 15, 200, 270, 939])
def test_any_number_of_bands(bands: int) -> None:
    """Band counts from 2 to 939 span 400 to 1000 nm, with the brightest band of a white at 1."""
    library = spectral_library(bands)
    assert library.wavelength_nm[[0, -1]].tolist() == [400.0, 1000.0]
    assert library.reflectance.shape == (len(MATERIALS), bands)
    assert library.light.max() == 1
    assert library.light.min() > 0


def test_one_band_is_refused() -> None:
    """A single band is refused with the number that came."""
    with pytest.raises(WavelengthError, match=r"at least 2 bands .* got 1"):
        spectral_library(1)


def test_band_response_keeps_a_line_in_place() -> None:
    """Bands weigh a straight line to its value at their centre and have the stated width at half maximum."""
    centre, grid = np.array([500.0, 700.0]), np.arange(400.0, 1031.0)
    weight = band_response(centre, np.full(2, FWHM_NM))
    np.testing.assert_allclose(weight @ grid, centre, rtol=1e-9)
    np.testing.assert_allclose(weight[0, 103] / weight[0, 100], 0.5, rtol=1e-9)


def test_sunlight_shows_oxygen() -> None:
    """The light has the O2-A dip near 760 nm that any spectrometer sees under the sun."""
    library = spectral_library(270)
    light = np.interp([748.0, 762.0, 778.0], library.wavelength_nm, library.light)
    assert light[1] < 0.9 * min(light[0], light[2])


def test_white_panel_never_saturates() -> None:
    """The panel stays six standard deviations of shot and read noise below the full well, and so in DN."""
    camera = LineCamera()
    panel = spectral_library(270).panel_electrons(camera)
    assert (panel + 6 * np.sqrt(panel + camera.read_noise_e**2)).max() < camera.full_well_e
    assert digitise(panel, camera, np.random.default_rng(0)).max() < camera.full_scale_dn


def test_panel_and_materials_share_one_light() -> None:
    """Electrons over the panel's, times its reflectance, give back every material."""
    camera, library = LineCamera(), spectral_library(32)
    back = library.electrons(camera) / library.panel_electrons(camera) * 0.99
    np.testing.assert_allclose(back, library.reflectance, rtol=1e-5)


def test_library_cannot_be_changed() -> None:
    """The cached spectra are read-only: one scene cannot spoil another's."""
    library = spectral_library(4)
    assert library is spectral_library(4)
    with pytest.raises(ValueError, match="read-only"):
        library.reflectance[0, 0] = 1
