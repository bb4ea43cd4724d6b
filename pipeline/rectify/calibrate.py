"""Calibration: raw DN to scene values by the dark and white frames, and which samples may be used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ShapeError
from pipeline.source import References


def reflectance(raw: NDArray[np.uint16], references: References) -> NDArray[np.float32]:
    """Turn raw lines into scene values, ``(raw - dark) / (white - dark) * panel``.

    Parameters
    ----------
    raw
        (line, sample, band) uint16 DN.
    references
        Frames with the binning of ``raw``.

    Returns
    -------
    (line, sample, band) float32, unit of the panel's values; NaN where the white frame is not above the dark one.

    Raises
    ------
    ShapeError : the references do not fit the lines.
    """
    _check_references(raw, references)
    span = references.white - references.dark
    gain = np.full(span.shape, np.nan, np.float32)
    np.divide(np.broadcast_to(references.panel, span.shape), span, out=gain, where=span > 0)
    values = raw.astype(np.float32)
    values -= references.dark
    values *= gain
    return values


def calibrate(
    raw: NDArray[np.uint16], references: References, *, saturated_dn: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Turn raw lines into scene values and say which samples may be used.

    A sample is out when any of its bands is saturated or has no calibration. A band that no sample has a calibration
    for (no light at all) puts none out: it stays NaN everywhere, on its own.

    Parameters
    ----------
    saturated_dn
        Least DN that counts as saturated, for the binning of ``raw``: of a sum of n samples, n times full scale finds
        those saturated throughout.

    Returns
    -------
    (line, sample, band) float32 as of :func:`reflectance`, and (line, sample) bool.
    """
    values = reflectance(raw, references)
    usable = references.white > references.dark
    known = np.all(usable | ~usable.any(axis=0), axis=1)
    valid: NDArray[np.bool_] = known & np.all(raw < saturated_dn, axis=2)
    return values, valid


def _check_references(raw: NDArray[np.uint16], references: References) -> None:
    if raw.ndim != 3:
        raise ShapeError(f"expected raw lines (line, sample, band), got {raw.shape}")
    for name in ("dark", "white"):
        shape = getattr(references, name).shape
        if shape != raw.shape[1:]:
            raise ShapeError(
                f"the lines have {raw.shape[1]} samples and {raw.shape[2]} bands, the {name} frame {shape}; "
                "take references with the binning and the bands of the sweep"
            )
    if references.panel.shape != raw.shape[2:]:
        raise ShapeError(f"the lines have {raw.shape[2]} bands, the panel {references.panel.shape}")
