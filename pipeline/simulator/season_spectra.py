"""Spectra of ``farm@2``: crops at stages of their life, soil between dry and wet, straw fresh and weathered.

Stands are PROSPECT-D and 4SAIL as in ``spectra``, seen from above with the sun 30 degrees from the zenith; the stages'
parameters are this project's: those of living plants lie within the ranges stated at ``spectra.Canopy``, ripe wheat has
next to no chlorophyll or water. Moisture mixes the dry and the wet soil by the exponential law of Lobell and Asner [1]_
with one exponent for all bands, so that bare soil lies on one line.

References
----------
.. [1] Lobell and Asner, "Moisture effects on soil reflectance", Soil Science Society of America Journal 66, 2002.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.simulator.spectra import (
    GRID_NM,
    Canopy,
    SpectralLibrary,
    Spectrum,
    canopy_spectrum,
    known_spectra,
    seen_in_bands,
    twin_factor,
)

MOISTURE_EXPONENT = 5.0  # law of this project; 80 % of the darkening is done at 0.32 by volume
RIPE_CONTRAST = 0.4  # of the twins' contrast, in ripe wheat (law of this project)

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
KEPT = (
    "soil_dry", "soil_wet", "gravel", "water", "straw", "weed_leafy", "weed_red", "volunteer", "grass_green",
    "grass_dry", "tree", "blossom", "shade",
)  # fmt: skip
"""Spectra shared with ``farm@1``."""

_TWINS = {name.replace("wheat_a", "wheat_b"): name for name in STAGES if name.startswith("wheat_a")}
SEASON_MATERIALS: tuple[str, ...] = (*KEPT, *STAGES, *_TWINS, "straw_grey", "twigs")


def wet_share(moisture: ArrayLike) -> NDArray[np.float32]:
    """Share of the wet soil's spectrum by water in the topsoil (by volume), from 0 to below 1."""
    return np.asarray(1 - np.exp(-MOISTURE_EXPONENT * np.maximum(moisture, 0)), np.float32)


@lru_cache(maxsize=16)
def season_library(bands: int, materials: tuple[str, ...] = SEASON_MATERIALS) -> SpectralLibrary:
    """Compute some of ``SEASON_MATERIALS`` in ``bands`` equally spaced bands from 400 to 1000 nm.

    Raises
    ------
    WavelengthError : fewer than 2 bands.
    """
    known = _season_spectra()
    return seen_in_bands(np.stack([known[name] for name in materials]), bands)


@lru_cache(maxsize=1)
def _season_spectra() -> dict[str, Spectrum]:
    shared = known_spectra()
    known = {name: shared[name] for name in KEPT} | {name: canopy_spectrum(stage) for name, stage in STAGES.items()}
    for name, other in _TWINS.items():  # varieties differ by their leaves' green, of which ripe wheat has little left
        known[name] = known[other] * (1 + (RIPE_CONTRAST if name.endswith("ripe") else 1.0) * (twin_factor() - 1))
    return known | {"straw_grey": _weathered(known["straw"]), "twigs": _twigs()}


def _weathered(straw: Spectrum) -> Spectrum:
    """Straw of last year: half as bright, and its slope nearly washed out (law of this project)."""
    return np.asarray(0.06 + 0.30 * straw + 0.10 * (GRID_NM - 400) / 600)


def _twigs() -> Spectrum:
    """Bark: 0.05 at 400 nm, rising straight to 0.29 at 1000 nm (law of this project)."""
    return np.asarray(0.05 + 0.24 * (GRID_NM - 400) / 600)
