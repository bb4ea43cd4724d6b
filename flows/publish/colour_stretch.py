"""From bands to grey and colour: which bands to show, and values as tones. No figure is drawn here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from storage.arrays.quicklooks import picture_bands

MID_GREY = 0.42


def choose_bands(wavelength_nm: NDArray[np.floating]) -> tuple[tuple[int, int, int], str]:
    """Bands to show as red, green, blue, and a caption: those nearest 640, 550, 460 nm, else false colour or grey."""
    waves = np.asarray(wavelength_nm, np.float64)
    bands, kind = picture_bands(waves, len(waves))
    named = f"{waves[bands[0]]:.0f}" if kind == "grey" else " / ".join(f"{waves[band]:.0f}" for band in bands)
    return bands, f"{kind}, {named} nm"


def stretch(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Each band's 2nd to 98th percentile to 0..1, (y, x, band) float32; NaN becomes light grey, a flat band black."""
    values = np.asarray(image, np.float32)
    shown = np.full(values.shape, 0.86, np.float32)
    for band in range(values.shape[-1]):
        plane = values[..., band]
        known = np.isfinite(plane)
        if known.any():
            low, high = np.percentile(plane[known], (2, 98))
            span = high - low if high > low else np.inf
            shown[..., band] = np.where(known, np.clip((plane - low) / span, 0, 1), 0.86)
    return shown


def develop(image: NDArray[np.generic], field: NDArray[np.generic]) -> NDArray[np.float32]:
    """Scene values as a photograph, (y, x, 3) float32 0..1: one scale for all bands, so that colours stay true.

    White is the 99th percentile of ``field``; mid tones are lifted (power 0.45 to 1) until its median is medium grey.
    """
    known = np.asarray(field, np.float32)
    known = known[np.isfinite(known)]
    if not known.size or not (white := float(np.percentile(known, 99))) > 0:
        return stretch(image)
    middle = float(np.clip(np.median(known) / white, 1e-3, 0.999))
    power = float(np.clip(np.log(MID_GREY) / np.log(middle), 0.45, 1.0))
    values = np.asarray(image, np.float32)
    return np.where(np.isfinite(values), np.clip(values / white, 0, 1) ** power, np.float32(0.86))
