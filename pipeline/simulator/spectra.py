"""Spectra of the built-in farm: what its materials reflect, and how many electrons that gives in each band.

Plant stands come from PROSPECT-D and 4SAIL [1]_ [2]_ (package ``prosail``), soil from the dry and the wet spectrum of
that package, sun and sky from Bird and Riordan's SPECTRL2 [3]_ (package ``pvlib``). What those do not give follows
laws of this project, written at each function; so does the camera's quantum efficiency (assumed). Everything is held
at 1 nm and seen through Gaussian bands.

References
----------
.. [1] Feret et al., "PROSPECT-D: Towards modeling leaf optical properties through a complete lifecycle", Remote
   Sensing of Environment 193, 2017. doi:10.1016/j.rse.2017.03.004
.. [2] Verhoef, "Light scattering by leaf layers with application to canopy reflectance modeling: the SAIL model",
   Remote Sensing of Environment 16, 1984. doi:10.1016/0034-4257(84)90057-9
.. [3] Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance on horizontal and tilted
   planes at the earth's surface for cloudless atmospheres", TR-215-2436, 1984. doi:10.2172/5986936
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import WavelengthError
from pipeline.geometry.camera import LineCamera

Spectrum = NDArray[np.float64]

FIRST_NM, LAST_NM = 400.0, 1000.0
FWHM_NM = 6.0  # assumed
PANEL_REFLECTANCE = 0.99
FILL = 0.95  # of the full well, by a perfect white in the brightest band
TWIN_CENTRE_NM, TWIN_HALF_WIDTH_NM, TWIN_CONTRAST = 715.0, 25.0, 0.10

GRID_NM: Spectrum = np.arange(400.0, 1031.0)  # room for the upper half of the last band
_SUN_ZENITH_DEG = 30.0


@dataclass(frozen=True)
class Canopy:
    """One plant stand for PROSPECT-D and 4SAIL, seen from above with the sun 30 degrees from the zenith.

    Ranges used here: structure n 1.3-2.1; chlorophyll ``cab`` 8-62, carotenoids ``car`` 4-14 and anthocyanins ``ant``
    0-6 ug/cm2; brown pigment 0-1; water ``cw`` 0.004-0.030 cm; dry matter ``cm`` 0.003-0.012 g/cm2; leaf area index
    1-6; mean leaf angle ``lidfa`` 25-72 degrees from the horizontal; ``dry_soil`` is the share of dry soil below.
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
    dry_soil: float = 0.7


CANOPIES: dict[str, Canopy] = {
    "maize_dense": Canopy(1.45, 55, 11, 0.5, 0.00, 0.013, 0.0050, 4.5, 52),
    "maize_sparse": Canopy(1.45, 44, 9, 0.5, 0.02, 0.012, 0.0050, 1.5, 48),
    "beet_dense": Canopy(1.75, 40, 8, 0.5, 0.00, 0.026, 0.0040, 4.0, 30),
    "beet_sparse": Canopy(1.75, 34, 7, 1.0, 0.00, 0.024, 0.0040, 1.4, 28),
    "wheat_a_dense": Canopy(1.55, 50, 11, 0.0, 0.05, 0.010, 0.0050, 5.5, 70),
    "wheat_a_sparse": Canopy(1.55, 42, 10, 0.0, 0.10, 0.010, 0.0050, 2.0, 68),
    "weed_leafy": Canopy(1.40, 28, 8, 3.0, 0.00, 0.018, 0.0030, 3.0, 35),
    "weed_red": Canopy(1.50, 24, 9, 6.0, 0.05, 0.014, 0.0040, 2.0, 42),
    "volunteer": Canopy(1.50, 30, 7, 5.0, 0.00, 0.022, 0.0065, 3.5, 40),
    "grass_green": Canopy(1.60, 36, 9, 0.0, 0.15, 0.011, 0.0060, 3.5, 60),
    "grass_dry": Canopy(1.90, 12, 6, 0.0, 0.80, 0.005, 0.0070, 2.5, 60),
    "tree": Canopy(2.10, 62, 14, 1.5, 0.15, 0.009, 0.0120, 6.0, 40),
}
"""Dense and sparse stands: a field mixes the two, which is how its vigour varies."""

MATERIALS: tuple[str, ...] = (
    "soil_dry", "soil_wet", "gravel", "water", "straw", *CANOPIES, "wheat_b_dense", "wheat_b_sparse",
    "blossom", "shade",
)  # fmt: skip


@dataclass(frozen=True)
class SpectralLibrary:
    """Materials as the camera sees them under the stated sun.

    ``reflectance`` is (material, band), weighted in each band by light and response; ``light`` is (band,), the signal
    of a perfect white, at most 1 over the bands.
    """

    wavelength_nm: Spectrum
    fwhm_nm: Spectrum
    reflectance: NDArray[np.float64]
    light: Spectrum

    def electrons(self, camera: LineCamera) -> NDArray[np.float32]:
        """Expected electrons of each pure material in one default exposure, (material, band) [e-].

        Exposure and aperture are such that a perfect white fills 95 % of the full well in the brightest band.
        """
        return (self.reflectance * self.light * FILL * camera.full_well_e).astype(np.float32)

    def panel_electrons(self, camera: LineCamera) -> NDArray[np.float32]:
        """Expected electrons of the white reference panel, (band,) [e-]."""
        return (PANEL_REFLECTANCE * self.light * FILL * camera.full_well_e).astype(np.float32)


def band_centres(bands: int) -> tuple[Spectrum, Spectrum]:
    """Centres and widths of ``bands`` equally spaced bands from 400 to 1000 nm, (band,) each [nm].

    Raises
    ------
    WavelengthError : fewer than 2 bands.
    """
    if bands < 2:
        raise WavelengthError(f"the farm's spectra need at least 2 bands from 400 to 1000 nm, got {bands}")
    return np.linspace(FIRST_NM, LAST_NM, bands), np.full(bands, FWHM_NM)


@lru_cache(maxsize=16)
def spectral_library(bands: int) -> SpectralLibrary:
    """Compute every material in ``bands`` equally spaced Gaussian bands from 400 to 1000 nm (arrays are read-only).

    Raises
    ------
    WavelengthError : fewer than 2 bands.
    """
    return seen_in_bands(_reflectance_1nm(), bands)


def seen_in_bands(reflectance_1nm: Spectrum, bands: int) -> SpectralLibrary:
    """See spectra on the 1 nm grid, (material, grid), in ``bands`` equally spaced bands; WavelengthError below 2."""
    wavelength, fwhm = band_centres(bands)
    response = band_response(wavelength, fwhm) * (_photons() * _quantum_efficiency())
    light = response.sum(axis=1)
    reflectance = reflectance_1nm @ response.T / light
    parts = (wavelength, fwhm, reflectance, light / light.max())
    for part in parts:
        part.setflags(write=False)
    return SpectralLibrary(*parts)


def band_response(wavelength_nm: Spectrum, fwhm_nm: Spectrum) -> NDArray[np.float64]:
    """Weights of Gaussian bands on the 1 nm grid from 400 to 1030 nm, (band, grid), each row of sum 1.

    A band at 400 nm keeps its upper half: nothing is known below.
    """
    sigma = fwhm_nm[:, None] / np.sqrt(8 * np.log(2))
    weight = np.exp(-0.5 * ((GRID_NM - wavelength_nm[:, None]) / sigma) ** 2)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _photons() -> Spectrum:
    """Relative global photon flux on level ground: SPECTRL2 under a clear sky on 21 June at sea level."""
    from pvlib.spectrum import spectrl2  # half a second of pandas: only for whoever needs the farm

    sky = spectrl2(
        apparent_zenith=_SUN_ZENITH_DEG,
        aoi=_SUN_ZENITH_DEG,
        surface_tilt=0.0,
        ground_albedo=0.2,
        surface_pressure=101325.0,
        relative_airmass=1 / np.cos(np.deg2rad(_SUN_ZENITH_DEG)),
        precipitable_water=1.5,  # cm
        ozone=0.31,  # atm cm
        aerosol_turbidity_500nm=0.1,
        dayofyear=172,
    )
    return np.asarray(np.interp(GRID_NM, sky["wavelength"], sky["poa_global"][:, 0]) * GRID_NM)


def _quantum_efficiency() -> Spectrum:
    """Silicon sensor behind a grating, assumed: straight lines between values every 100 nm."""
    return np.interp(GRID_NM, np.arange(400.0, 1101.0, 100.0), [0.34, 0.66, 0.72, 0.62, 0.47, 0.26, 0.09, 0.01])


@lru_cache(maxsize=1)
def _reflectance_1nm() -> NDArray[np.float64]:
    """Reflectance of every material on the 1 nm grid, (material, grid)."""
    known = known_spectra()
    return np.stack([known[name] for name in MATERIALS])


@lru_cache(maxsize=1)
def known_spectra() -> dict[str, Spectrum]:
    """Give the reflectance of each of ``MATERIALS`` on the 1 nm grid from 400 to 1030 nm; not to be written to."""
    from prosail import spectral_lib

    size = len(GRID_NM)
    iron = _iron_oxide()
    dry, wet = iron * spectral_lib.soil.rsoil1[:size], iron * spectral_lib.soil.rsoil2[:size]
    known: dict[str, Spectrum] = {name: canopy_spectrum(canopy) for name, canopy in CANOPIES.items()}
    for stand in ("dense", "sparse"):
        known[f"wheat_b_{stand}"] = known[f"wheat_a_{stand}"] * twin_factor()
    known |= {"soil_dry": dry, "soil_wet": 0.35 * dry + 0.65 * wet, "gravel": _gravel(), "water": _water()}
    known |= {"straw": _straw(), "blossom": _blossom(known["weed_leafy"]), "shade": _shade()}
    return known


def canopy_spectrum(canopy: Canopy) -> Spectrum:
    """Bidirectional reflectance of a stand, seen straight from above."""
    from prosail import run_prosail

    spectrum = run_prosail(
        canopy.n, canopy.cab, canopy.car, canopy.cbrown, canopy.cw, canopy.cm, canopy.lai, canopy.lidfa,
        0.05, _SUN_ZENITH_DEG, 0.0, 0.0, ant=canopy.ant, prospect_version="D", rsoil=1.0, psoil=canopy.dry_soil,
    )  # fmt: skip
    return np.asarray(spectrum[: len(GRID_NM)], dtype=np.float64)


def twin_factor() -> Spectrum:
    """Second wheat over the first: 1 + 0.10 cos^2 within 25 nm of 715 nm, else 1 (law of this project).

    As if the red edge lay about 3 nm further to the blue: a variety of the same stature with a little less
    chlorophyll, and nothing else to tell it by.
    """
    phase = np.clip((GRID_NM - TWIN_CENTRE_NM) / TWIN_HALF_WIDTH_NM, -1, 1) * (np.pi / 2)
    return np.asarray(1 + TWIN_CONTRAST * np.cos(phase) ** 2)


def _iron_oxide() -> Spectrum:
    """Grey soil to brown loam: a factor of 0.5 in the violet, 1 beyond 700 nm (law of this project)."""
    return np.asarray(1 - 0.5 / (1 + np.exp((GRID_NM - 545) / 40)))


def _gravel() -> Spectrum:
    """Limestone gravel: 0.20 at 400 nm, rising towards 0.42 with a scale of 220 nm (law of this project)."""
    return np.asarray(0.42 - 0.22 * np.exp(-(GRID_NM - 400) / 220))


def _water() -> Spectrum:
    """Ditch: sky on the surface, 0.025 (500 / wavelength)^2; humps at 555 and 705 nm (law of this project)."""
    hump = 0.020 * np.exp(-(((GRID_NM - 555) / 70) ** 2)) + 0.008 * np.exp(-(((GRID_NM - 705) / 18) ** 2))
    return np.asarray(0.025 * (500 / GRID_NM) ** 2 + hump)


def _straw() -> Spectrum:
    """Bleached cereal straw: 0.10 at 400 nm to 0.50 by a logistic about 620 nm, 90 nm wide (law of this project)."""
    return np.asarray(0.08 + 0.42 / (1 + np.exp(-(GRID_NM - 620) / 90)))


def _blossom(leaves: Spectrum) -> Spectrum:
    """Mustard in flower: half petals that absorb below 510 nm, half the leaves beneath (law of this project)."""
    petals = 0.05 + 0.47 / (1 + np.exp(-(GRID_NM - 512) / 9))
    return np.asarray(0.5 * petals + 0.5 * leaves)


def _shade() -> Spectrum:
    """Ground lit by a little blue sky alone: 0.004 + 0.010 (450 / wavelength)^4 (law of this project)."""
    return np.asarray(0.004 + 0.010 * (450 / GRID_NM) ** 4)
