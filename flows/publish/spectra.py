"""Mean spectra of the mapped classes, as curves that stop where bands were removed."""

from __future__ import annotations

import io
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from flows.publish.panels import PAPER, STYLE, class_palette, save_png, webp
from storage.arrays.class_maps import ClassMap
from storage.arrays.mosaics import Mosaic

COLOURS = 256  # of the picture: half the bytes
DPI = 110
DOTS: Any = {"marker": ".", "markersize": 2.4, "markeredgewidth": 0}  # which show a band between two gaps
LEAST_BANDS = 5  # of a curve
GAP = 1.75  # times the usual distance of bands on its two sides, from which on bands were removed there
CONTIGUOUS_NM = 20.0  # median distance of bands up to which they cover a spectrum; a satellite's few lie apart anyway
BESIDE = 5  # distances on either side that tell the usual one


def draw_spectra(mosaic: Mosaic, found: ClassMap) -> bytes | None:
    """Draw the mean spectrum of each mapped class as WebP; None for fewer than `LEAST_BANDS` bands, or no value."""
    spectra = class_spectra(mosaic, found.classes, len(found.names))
    if len(mosaic.wavelength_nm) < LEAST_BANDS or not np.isfinite(spectra).any():
        return None
    names = [name.replace("_", " ") for name in found.names]
    palette = class_palette(found.colours)
    with mpl.rc_context({**STYLE, "font.size": 9}):
        figure = Figure(figsize=(9, 3.6), dpi=DPI, layout="constrained", facecolor=PAPER)
        axes = figure.subplots()
        axes.set_facecolor(PAPER)
        for name, spectrum, colour in zip(names, spectra, palette, strict=False):
            if (known := np.isfinite(spectrum)).any():
                nm, curve = curve_with_gaps(mosaic.wavelength_nm[known], spectrum[known])
                axes.plot(nm, curve, color=colour, linewidth=1.2, label=name, **DOTS)
        axes.set(xlabel="wavelength [nm]", ylabel="value of the scene")
        axes.legend(loc="best", ncols=2, fontsize=7, frameon=False)
        drawn = io.BytesIO()
        save_png(figure, drawn)
    with Image.open(drawn) as opened:
        flat = opened.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    return webp(flat.convert("RGB"), lossless=True)


def class_spectra(mosaic: Mosaic, classes: NDArray[np.integer], count: int) -> NDArray[np.float32]:
    """Return the mean spectra (class, band) of ``count`` classes; NaN for one that no pixel of the mosaic shows.

    ``classes`` (y, x) are of the fine grid; under a pixel of the mosaic counts the one at its centre.
    """
    half, step = mosaic.factor // 2, mosaic.factor
    sums, pixels, top = np.zeros((count, len(mosaic.components))), np.zeros(count), 0
    for scores in mosaic.row_blocks():
        rows = np.minimum(np.arange(top, top + len(scores)) * step + half, classes.shape[0] - 1)
        columns = np.minimum(np.arange(scores.shape[1]) * step + half, classes.shape[1] - 1)
        under, seen = classes[np.ix_(rows, columns)], np.isfinite(scores).all(axis=2)
        for number in range(count):
            here = scores[seen & (under == number)]
            sums[number] += here.sum(axis=0, dtype=np.float64)
            pixels[number] += len(here)
        top += len(scores)
    means = np.where(pixels[:, None] > 0, sums / np.maximum(pixels, 1)[:, None], np.nan)
    spectra = mosaic.spectra(means.astype(np.float32))
    spectra[pixels == 0] = np.nan
    return spectra


def curve_with_gaps(
    wavelength_nm: NDArray[np.floating], values: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a curve (band,) in the order of wavelengths, with a NaN wherever bands were removed.

    Bands were removed between two that are `GAP` times as far apart as usual among the bands on both their sides. Of
    bands that do not cover the spectrum (`CONTIGUOUS_NM`) none counts as removed.
    """
    order = np.argsort(wavelength_nm, kind="stable")
    nm, curve = np.asarray(wavelength_nm, np.float64)[order], np.asarray(values, np.float64)[order]
    apart = np.diff(nm)
    contiguous = len(apart) > 0 and float(np.median(apart)) <= CONTIGUOUS_NM
    breaks = [place + 1 for place in range(len(apart)) if contiguous and apart[place] > GAP * _usual(apart, place)]
    return np.insert(nm, breaks, np.nan), np.insert(curve, breaks, np.nan)


def _usual(apart: NDArray[np.float64], place: int) -> float:
    """The larger of the median distances before and after one; infinite where there are none."""
    sides = (apart[max(place - BESIDE, 0) : place], apart[place + 1 : place + 1 + BESIDE])
    return max((float(np.median(side)) for side in sides if len(side)), default=np.inf)
