"""What stands out in a coarse image whoever looks: saliency without a model, by the two measures of OpenCV's contrib.

Both look at one grey image, the mean of all bands after each was stretched to its own range: neither the brightness of
a band nor the order of bands counts. What is not finite takes its band's median, a band without contrast adds nothing,
and where no band has any, nothing stands out.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError

Pixels = NDArray[np.float64]
LEVELS = 65535  # of a stretched band; whole numbers add up alike in any order
DARK, BRIGHT = 0.1, 99.9  # percentiles between which a band is stretched: one dead pixel is not its range
FLAT = 1e-6  # a range smaller than this share of the values is rounding, not contrast
MOST_PX = 1024  # a side of the image whose spectrum is taken: work and memory of larger ones grow, seats do not show it


def fine_grained(bands: NDArray[np.floating]) -> Pixels:
    """Contrast of each pixel with six of its surroundings, 24 to 224 px wide, (y, x) in 0..1 of (y, x, band).

    Raises
    ------
    SettingsError : OpenCV is missing, or lacks its contrib modules.
    """
    saliency = _opencv().StaticSaliencyFineGrained_create()
    image = grey_image(bands)
    return np.zeros(bands.shape[:2]) if image is None else _compute(saliency, np.rint(255 * image).astype(np.uint8))


def spectral_residual(bands: NDArray[np.floating]) -> Pixels:
    """Where the image is not what its smoothed log spectrum predicts, (y, x) in 0..1 of (y, x, band).

    The spectrum is that of the whole image at its own size, up to 1024 px a side. (At the 64 px of its authors the
    measure finds objects, not the few pixels of a seat.)

    Raises
    ------
    SettingsError : OpenCV is missing, or lacks its contrib modules.
    """
    saliency = _opencv().StaticSaliencySpectralResidual_create()
    saliency.setImageHeight(min(bands.shape[0], MOST_PX))
    saliency.setImageWidth(min(bands.shape[1], MOST_PX))
    image = grey_image(bands)
    return np.zeros(bands.shape[:2]) if image is None else _compute(saliency, (255 * image).astype(np.float32))


def grey_image(bands: NDArray[np.floating]) -> Pixels | None:
    """Mean of the bands, each stretched to its own range, stretched itself: (y, x) in 0..1; None without contrast."""
    total = np.zeros(bands.shape[:2], np.int64)
    for number in range(bands.shape[-1]):
        band = _stretched(bands[..., number].astype(np.float64))
        if band is not None:
            total += np.rint(LEVELS * band).astype(np.int64)
    return _stretched(total.astype(np.float64))


def _stretched(values: Pixels) -> Pixels | None:
    """Bring the 0.1 and 99.9 % percentiles to 0 and 1, and what is not finite to the median; None without contrast."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low, middle, high = np.percentile(finite, (DARK, 50.0, BRIGHT))
    if _is_flat(low, high):  # something small on a plain ground: all that there is to see
        low, high = finite.min(), finite.max()
    if _is_flat(low, high):
        return None
    filled = np.where(np.isfinite(values), values, middle)
    stretched: Pixels = np.clip((filled - low) / (high - low), 0.0, 1.0)
    return stretched


def _is_flat(low: float, high: float) -> bool:
    return bool(high - low <= FLAT * max(abs(low), abs(high)))


def _compute(saliency: Any, image: NDArray[np.generic]) -> Pixels:
    """Let OpenCV measure one image; a number that its logarithm of nothing left behind counts as 0."""
    found = np.asarray(saliency.computeSaliency(np.ascontiguousarray(image))[1], np.float64)
    return np.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0)


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2").saliency
    except (ImportError, AttributeError) as error:
        raise SettingsError(
            "the policies saliency and spectral-residual need OpenCV with its contrib modules;"
            " pip install opencv-contrib-python-headless, or choose another policy"
        ) from error
