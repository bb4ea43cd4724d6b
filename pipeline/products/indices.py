"""Compute spectral indices by name: the bands that each needs, and its values from those of a cube.

Names, formulas and the ranges of bands are those of Awesome Spectral Indices (Montero et al. 2023, doi:
10.1038/s41597-023-02096-0) in the package spyndex.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spectralzoom.pipeline.errors import SettingsError, WavelengthError

Floats = NDArray[np.float32]

SAMPLED = 4  # step in pixels for finding the white level
DARK_FRACTION = 0.01  # of white: pixels with a darker mean of bands have no index
LEAST_REFLECTANCE, MOST_REFLECTANCE = 0.02, 1.5  # of a cube of reflectance the 99th percentile lies between these
LAMBDA = "lambda"  # prefix of a band's wavelength in a formula
CONSTANTS = {"SAVI": {"L": 0.5}}  # instead of a default that belongs to another index
PAPERS_NM = {  # centres of the papers instead of a satellite's
    "MCARI": {"RE1": 700.0, "R": 670.0, "G": 550.0},
    "TCARI": {"RE1": 700.0, "R": 670.0, "G": 550.0},
    "MCARIOSAVI": {"RE1": 700.0, "R": 670.0, "G": 550.0, "N": 800.0},
    "TCARIOSAVI": {"RE1": 700.0, "R": 670.0, "G": 550.0, "N": 800.0},
}


@dataclass(frozen=True)
class IndexBand:
    """A band that an index needs: the one nearest to ``centre_nm`` within ``low_nm`` to ``high_nm``."""

    symbol: str
    title: str
    centre_nm: float
    low_nm: float
    high_nm: float

    def __str__(self) -> str:
        return f"{self.title}, {self.low_nm:g} to {self.high_nm:g} nm"


@dataclass(frozen=True)
class SpectralIndex:
    """One index: its name, bands and formula."""

    name: str
    title: str
    reference: str
    bands: tuple[IndexBand, ...]
    formula: Callable[[Mapping[str, Any]], Any]  # of bands' values and, with "lambda" before the symbol, wavelengths

    @property
    def wants_reflectance(self) -> bool:
        """Return whether the index depends on the scale of the values, as with constants in its formula."""
        rising = {band.symbol: 0.2 + 0.05 * number for number, band in enumerate(self.bands)}
        nm = {LAMBDA + band.symbol: band.centre_nm for band in self.bands}
        twice = {symbol: 2 * value for symbol, value in rising.items()}
        return not np.isclose(self.formula(rising | nm), self.formula(twice | nm), rtol=1e-9, atol=0)


def find_index(name: str) -> SpectralIndex:
    """Return an index by its name, in any case.

    Raises SettingsError: the name is unknown, or the index needs an input that no camera has; lists similar names.
    """
    import spyndex

    listed = {one.lower(): one for one in spyndex.indices}
    if name.lower() not in listed:
        near = get_close_matches(name.lower(), listed, n=3, cutoff=0.5)
        named = ", ".join(listed[one] for one in near) or "NDVI, NDREI, MCARI"
        raise SettingsError(
            f"there is no index {name!r}; like it: {named}. All names: awesome-ee-spectral-indices.readthedocs.io"
        )
    name = listed[name.lower()]
    about = spyndex.indices[name]
    bands: list[IndexBand] = []
    constants: dict[str, float] = {}
    for symbol in about.bands:
        if symbol in spyndex.bands:
            band = spyndex.bands[symbol]
            centre = _centre_nm(name, symbol)
            bands.append(IndexBand(symbol, band.long_name, centre, band.min_wavelength, band.max_wavelength))
        elif symbol.startswith(LAMBDA):  # of a band that the index itself may not want, as red in FDI
            constants[symbol] = _centre_nm(name, symbol.removeprefix(LAMBDA))
        else:
            known = spyndex.constants[symbol].default if symbol in spyndex.constants else None
            value = CONSTANTS.get(name, {}).get(symbol, known)
            if value is None:
                raise SettingsError(f"{name} ({about.long_name}) needs {symbol}, which no camera gives; choose another")
            constants[symbol] = value
    return SpectralIndex(
        name,
        about.long_name,
        about.reference,
        tuple(bands),
        lambda values: spyndex.computeIndex(name, params={**constants, **values}),
    )


def _centre_nm(index: str, symbol: str) -> float:
    """Return the wavelength of an index's band: by its paper, else of Sentinel-2, else the middle of its range."""
    import spyndex

    band = spyndex.bands[symbol]
    satellite = getattr(band, "sentinel2a", None)
    usual = (band.min_wavelength + band.max_wavelength) / 2 if satellite is None else satellite.wavelength
    return float(PAPERS_NM.get(index, {}).get(symbol, usual))


def pick_bands(index: SpectralIndex, wavelength_nm: ArrayLike) -> tuple[int, ...]:
    """Return the number of the band, in a cube of (band,) wavelengths [nm], for each band that an index needs.

    Raises WavelengthError: the cube has no wavelength in the range of one; names it, and the cube's wavelengths.
    """
    there = np.asarray(wavelength_nm, np.float64)
    away = [
        np.where((there >= band.low_nm) & (there <= band.high_nm), np.abs(there - band.centre_nm), np.inf)
        for band in index.bands
    ]
    missing = [band for band, off_nm in zip(index.bands, away, strict=True) if not np.isfinite(off_nm.min())]
    if missing:
        bands = f"bands lie at {', '.join(f'{one:g}' for one in there)} nm"
        if len(there) > 6:
            bands = f"{len(there)} bands lie from {there.min():g} to {there.max():g} nm"
        raise WavelengthError(
            f"{index.name} wants {' and '.join(map(str, missing))}, and the cube has no such band: its {bands}; leave "
            f"{index.name} out of --indices"
        )
    return tuple(int(np.argmin(off_nm)) for off_nm in away)


def index_values(
    index: SpectralIndex, values: NDArray[np.floating], wavelength_nm: Sequence[float], *, white: float = 1.0
) -> Floats:
    """Return an index from the values (..., band) of the bands of `pick_bands`, and their wavelengths [nm].

    It is NaN where a band has no value, and where the mean of the bands is below 1 % of ``white``. So it is where the
    formula has no finite value, as in a division by zero.
    """
    usable: NDArray[np.bool_] = np.isfinite(values).all(axis=-1)
    usable &= np.where(usable, values.mean(axis=-1), -np.inf) >= DARK_FRACTION * white
    planes = {band.symbol: values[..., number].astype(np.float64) for number, band in enumerate(index.bands)}
    nm = {LAMBDA + band.symbol: float(wavelength_nm[number]) for number, band in enumerate(index.bands)}
    with np.errstate(all="ignore"):  # values that are not finite become NaN
        found = np.asarray(index.formula(planes | nm), np.float64)
    return np.asarray(np.where(usable & np.isfinite(found), found, np.nan).astype(np.float32))


def check_white(index: SpectralIndex, white: float, run: str) -> None:
    """Refuse an index that needs reflectance, of values with another white level (SettingsError)."""
    if index.wants_reflectance and white != 1.0:
        raise SettingsError(
            f"{index.name} wants reflectance (0 to 1), and the values of run {run} reach {white:.3g}; choose "
            "an index of ratios, such as NDVI or PRI, or write the factor to reflectance into the scene.toml "
            "beside the scene (scale = 0.0001 if 10000 is white) and survey it again"
        )


def white_level(values: NDArray[np.floating]) -> float:
    """Return the white level of a cube's values: 1 for reflectance, else their 99th percentile."""
    known = values[np.isfinite(values)]
    bright = float(np.percentile(known, 99)) if known.size else 1.0
    return 1.0 if LEAST_REFLECTANCE <= bright <= MOST_REFLECTANCE else bright
