"""Spectra of the built-in farm: what its materials reflect, and how many electrons that gives in each band.

Plant stands come from PROSPECT-D and 4SAIL [1] [2] (package ``prosail``), seen from above. Soil is the dry and the wet
spectrum of that package, mixed by moisture [3]. Sun and sky come from Bird and Riordan's SPECTRL2 [4] (package
``pvlib``). The rest follows laws of this project, written at each function, as do the stages' parameters and the
camera's quantum efficiency (assumed). Everything is held at 1 nm and seen through Gaussian bands.

[1] Feret et al., "PROSPECT-D: Towards modeling leaf optical properties through a complete lifecycle", Remote
   Sensing of Environment 193, 2017. doi:10.1016/j.rse.2017.03.004
[2] Verhoef, "Light scattering by leaf layers with application to canopy reflectance modeling: the SAIL model",
   Remote Sensing of Environment 16, 1984. doi:10.1016/0034-4257(84)90057-9
[3] Lobell and Asner, "Moisture effects on soil reflectance", Soil Science Society of America Journal 66, 2002.
[4] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted
   planes at the earth's surface for cloudless atmospheres", TR-215-2436, 1984. doi:10.2172/5986936
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import WavelengthError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.scenes.daylight import clear_sky

Spectrum = NDArray[np.float64]

FIRST_NM, LAST_NM = 400.0, 1000.0
FWHM_NM = 6.0  # assumed
WHITE_REFERENCE_REFLECTANCE = 0.99
FILL = 0.95  # of the full well, by a perfect white in the brightest band
TWIN_CENTRE_NM, TWIN_HALF_WIDTH_NM, TWIN_CONTRAST = 715.0, 25.0, 0.10
RIPE_CONTRAST = 0.4  # of the twins' contrast, in ripe wheat (law of this project)
MOISTURE_EXPONENT = 5.0  # law of this project; 80 % of the darkening is done at 0.32 by volume

GRID_NM: Spectrum = np.arange(400.0, 1031.0)  # room for the upper half of the last band
_SUN_ZENITH_DEG = 30.0
DRY_BELOW = 0.7  # fraction of dry soil below plants


@dataclass(frozen=True)
class Canopy:
    """One plant stand for PROSPECT-D and 4SAIL, seen from above with the sun 30 degrees from the zenith.

    Living plants here have structure n 1.3-2.1 and brown pigment 0-1. They have chlorophyll ``cab`` 8-62, carotenoids
    ``car`` 4-14 and anthocyanins ``ant`` 0-6 ug/cm2. Water ``cw`` is 0.004-0.030 cm, dry matter ``cm`` 0.003-0.012
    g/cm2. The leaf area index is 1-6, the mean leaf angle ``lidfa`` 16-72 degrees from the horizontal.
    """

    n: float
    cab: float
    car: float
    ant: float
    cbrown: float
    cw: float
    cm: float
    lai: float
    lidfa: float


# Crops, and leaves of trees in autumn, at the stages of their life. Ripe wheat has next to no chlorophyll or water.
STAGES: dict[str, Canopy] = {
    "maize_young": Canopy(1.40, 36, 8, 0.5, 0.00, 0.014, 0.0040, 1.3, 45),
    "maize_full": Canopy(1.45, 55, 11, 0.5, 0.00, 0.013, 0.0050, 4.5, 52),
    "maize_ripe": Canopy(1.80, 9, 6, 0.5, 0.60, 0.006, 0.0060, 3.2, 55),
    "beet_young": Canopy(1.60, 34, 7, 1.0, 0.00, 0.026, 0.0035, 1.2, 25),
    "beet_full": Canopy(1.75, 42, 8, 0.5, 0.00, 0.026, 0.0040, 4.2, 30),
    "beet_old": Canopy(1.85, 26, 8, 1.5, 0.20, 0.022, 0.0045, 3.2, 38),
    "wheat_a_young": Canopy(1.45, 42, 9, 0.0, 0.03, 0.012, 0.0040, 1.8, 48),
    "wheat_a_full": Canopy(1.55, 52, 11, 0.0, 0.03, 0.010, 0.0050, 5.5, 68),
    "wheat_a_filling": Canopy(1.65, 34, 10, 0.0, 0.15, 0.008, 0.0055, 4.6, 66),
    "wheat_a_ripe": Canopy(2.10, 0.5, 2.5, 0.0, 0.30, 0.002, 0.0070, 3.0, 62),
    "wheat_a_lodged": Canopy(1.65, 36, 10, 0.0, 0.12, 0.008, 0.0055, 5.0, 18),
    "wheat_a_lodged_ripe": Canopy(2.10, 0.5, 2.5, 0.0, 0.50, 0.002, 0.0070, 3.6, 16),
    "tree_autumn": Canopy(2.00, 14, 9, 4.0, 0.45, 0.007, 0.0110, 4.0, 40),
}
# Stands that look alike all year.
OTHERS: dict[str, Canopy] = {
    "weed_leafy": Canopy(1.40, 28, 8, 3.0, 0.00, 0.018, 0.0030, 3.0, 35),
    "weed_red": Canopy(1.50, 24, 9, 6.0, 0.05, 0.014, 0.0040, 2.0, 42),
    "volunteer": Canopy(1.50, 30, 7, 5.0, 0.00, 0.022, 0.0065, 3.5, 40),
    "grass_green": Canopy(1.60, 36, 9, 0.0, 0.15, 0.011, 0.0060, 3.5, 60),
    "grass_dry": Canopy(1.90, 12, 6, 0.0, 0.80, 0.005, 0.0070, 2.5, 60),
    "tree": Canopy(2.10, 62, 14, 1.5, 0.15, 0.009, 0.0120, 6.0, 40),
}
_TWINS = {name.replace("wheat_a", "wheat_b"): name for name in STAGES if name.startswith("wheat_a")}
_LASTING = ("soil_dry", "soil_wet", "gravel", "water", "straw", *OTHERS, "blossom", "shade")
MATERIALS: tuple[str, ...] = (*_LASTING, *STAGES, *_TWINS, "straw_grey", "twigs")


@dataclass(frozen=True)
class SpectralLibrary:
    """Materials as the camera sees them under the stated sun."""

    reflectance: NDArray[np.float64]  # (material, band), weighted in each band by light and response
    light: Spectrum  # (band,) the signal of a perfect white, at most 1 over the bands

    def electrons(self, camera: LineCamera) -> NDArray[np.float32]:
        """Return expected electrons of each pure material in one default exposure, (material, band) [e-].

        Exposure and aperture are such that a perfect white fills 95 % of the full well in the brightest band.
        """
        return (self.reflectance * self.light * FILL * camera.full_scale_e).astype(np.float32)

    def white_reference_electrons(self, camera: LineCamera) -> NDArray[np.float32]:
        """Return expected electrons of the white reference panel, (band,) [e-]."""
        return (WHITE_REFERENCE_REFLECTANCE * self.light * FILL * camera.full_scale_e).astype(np.float32)


def band_centres(bands: int) -> tuple[Spectrum, Spectrum]:
    """Return centres and widths of ``bands`` equally spaced bands from 400 to 1000 nm, (band,) each [nm].

    Raises WavelengthError: fewer than 2 bands.
    """
    if bands < 2:
        raise WavelengthError(f"the farm's spectra need at least 2 bands from 400 to 1000 nm, got {bands}")
    return np.linspace(FIRST_NM, LAST_NM, bands), np.full(bands, FWHM_NM)


@lru_cache(maxsize=16)
def spectral_library(bands: int, materials: tuple[str, ...] = MATERIALS) -> SpectralLibrary:
    """Compute some materials in ``bands`` equally spaced Gaussian bands from 400 to 1000 nm (arrays are read-only).

    Raises WavelengthError: fewer than 2 bands.
    """
    wavelength, fwhm = band_centres(bands)
    # Photons under a clear sky on 21 June at sea level; a silicon sensor behind a grating (assumed).
    nm, sky = clear_sky(_SUN_ZENITH_DEG, 1 / np.cos(np.deg2rad(_SUN_ZENITH_DEG)), 172)
    efficiency = np.interp(GRID_NM, np.arange(400.0, 1101.0, 100.0), [0.34, 0.66, 0.72, 0.62, 0.47, 0.26, 0.09, 0.01])
    response = band_response(wavelength, fwhm) * (np.interp(GRID_NM, nm, sky[:, 0]) * GRID_NM * efficiency)
    light = response.sum(axis=1)
    reflectance = np.stack([_known_spectra()[name] for name in materials]) @ response.T / light
    parts = (reflectance, light / light.max())
    for part in parts:
        part.setflags(write=False)
    return SpectralLibrary(*parts)


def band_response(wavelength_nm: Spectrum, fwhm_nm: Spectrum) -> NDArray[np.float64]:
    """Return the weights of Gaussian bands on the 1 nm grid from 400 to 1030 nm, (band, grid), each row of sum 1.

    A band at 400 nm keeps its upper half: nothing is known below.
    """
    sigma = fwhm_nm[:, None] / np.sqrt(8 * np.log(2))
    weight = np.exp(-0.5 * ((GRID_NM - wavelength_nm[:, None]) / sigma) ** 2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


@lru_cache(maxsize=1)
def _known_spectra() -> dict[str, Spectrum]:
    """Return the reflectance of each of ``MATERIALS`` on the 1 nm grid from 400 to 1030 nm, by models or laws."""
    import prosail

    def stand(one: Canopy) -> Spectrum:
        leaf = (one.n, one.cab, one.car, one.cbrown, one.cw, one.cm)
        light = (_SUN_ZENITH_DEG, 0.0, 0.0)  # seen straight from above
        seen = prosail.run_prosail(
            *leaf, one.lai, one.lidfa, 0.05, *light, ant=one.ant, prospect_version="D", rsoil=1.0, psoil=DRY_BELOW
        )
        return np.asarray(seen[: len(GRID_NM)], dtype=np.float64)

    known = {name: stand(canopy) for name, canopy in (OTHERS | STAGES).items()}
    # Second wheat over the first: 1 + 0.10 cos^2 within 25 nm of 715 nm, else 1, as if the red edge lay 3 nm further to
    # the blue. Ripe wheat has little of the green left by which varieties differ.
    phase = np.clip((GRID_NM - TWIN_CENTRE_NM) / TWIN_HALF_WIDTH_NM, -1, 1) * (np.pi / 2)
    factor = 1 + TWIN_CONTRAST * np.cos(phase) ** 2
    for name, other in _TWINS.items():
        known[name] = known[other] * (1 + (RIPE_CONTRAST if name.endswith("ripe") else 1.0) * (factor - 1))
    iron = 1 - 0.5 / (1 + np.exp((GRID_NM - 545) / 40))  # grey soil to brown loam: 0.5 in the violet, 1 beyond 700 nm
    soils = prosail.spectral_lib.soil
    dry, wet = (iron * soil[: len(GRID_NM)] for soil in (soils.rsoil1, soils.rsoil2))
    hump = 0.020 * np.exp(-(((GRID_NM - 555) / 70) ** 2)) + 0.008 * np.exp(-(((GRID_NM - 705) / 18) ** 2))
    straw = 0.08 + 0.42 / (1 + np.exp(-(GRID_NM - 620) / 90))  # bleached cereal straw: 0.10 at 400 nm to 0.50
    petals = 0.05 + 0.47 / (1 + np.exp(-(GRID_NM - 512) / 9))  # of mustard: they absorb below 510 nm
    return known | {
        "soil_dry": dry,
        "soil_wet": 0.35 * dry + 0.65 * wet,
        "gravel": 0.42 - 0.22 * np.exp(-(GRID_NM - 400) / 220),  # of limestone: 0.20 at 400 nm, rising towards 0.42
        "water": 0.025 * (500 / GRID_NM) ** 2 + hump,  # a ditch: sky on the surface, humps at 555 and 705 nm
        "straw": straw,
        "straw_grey": 0.06 + 0.30 * straw + 0.10 * (GRID_NM - 400) / 600,  # last year's: half as bright, nearly flat
        "twigs": 0.05 + 0.24 * (GRID_NM - 400) / 600,  # bark: 0.05 at 400 nm, rising straight to 0.29 at 1000 nm
        "blossom": 0.5 * petals + 0.5 * known["weed_leafy"],
        "shade": 0.004 + 0.010 * (450 / GRID_NM) ** 4,  # ground that a little blue sky alone lights
    }
