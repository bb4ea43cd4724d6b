"""Choose the bands that show a cube as red, green and blue, and give them the tones of a photograph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

RGB_NM = (640.0, 550.0, 460.0)
FAR_NM = 60.0
MID_GREY = 0.42  # of the median of a picture


def choose_bands(wavelength_nm: NDArray[np.floating]) -> tuple[tuple[int, int, int], str]:
    """Return the bands to show as red, green and blue, and a caption.

    These are those nearest to 640, 550 and 460 nm, if within 60 nm. Otherwise they are the longest, middle and shortest
    wavelength.
    """
    waves = np.asarray(wavelength_nm, np.float64)
    red, green, blue = (int(np.argmin(np.abs(waves - target))) for target in RGB_NM)
    off = max(abs(waves[band] - target) for band, target in zip((red, green, blue), RGB_NM, strict=True))
    if len(waves) == 1:
        return (0, 0, 0), f"grey, {waves[0]:.0f} nm"
    kind = "true colour"
    if len({red, green, blue}) < 3 or off > FAR_NM:
        kind, order = "false colour", np.argsort(waves, kind="stable")
        red, green, blue = (int(order[place]) for place in (-1, (len(order) - 1) // 2, 0))
    return (red, green, blue), f"{kind}, {waves[red]:.0f} / {waves[green]:.0f} / {waves[blue]:.0f} nm"


def stretch(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return the 2nd to 98th percentile of each band as 0..1, (y, x, band) float32.

    NaN becomes light grey, a flat band black.
    """
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
    """Return scene values as a picture (y, x, 3) float32 0..1 in true colours, with one scale for all bands."""
    known = np.asarray(field, np.float32)
    known = known[np.isfinite(known)]
    if not known.size or not (white := float(np.percentile(known, 99))) > 0:
        return stretch(image)
    middle = float(np.clip(np.median(known) / white, 1e-3, 0.999))
    power = float(np.clip(np.log(MID_GREY) / np.log(middle), 0.45, 1.0))
    values = np.asarray(image, np.float32)
    return np.where(np.isfinite(values), np.clip(values / white, 0, 1) ** power, np.float32(0.86))
