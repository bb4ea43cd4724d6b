"""The footprint of a sample: slit, pixel and every blur folded, as few kernels that all bands share.

A kernel is a box (the slit across the line, the pixel along it) convolved with a Gaussian that has the shift and
variance of all blurs together. Bands differ in shift and variance, smoothly: each is a sum of few kernels, whose
moments lie among those of the bands, as a polynomial is of its values at few nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.tap_tables import blurred_weight

Floats = NDArray[np.float64]
NEGLIGIBLE = 3e-4  # share of the light, by size, that few kernels may misplace: .02 sigma of a full well's contrast
_MOST_NODES = 12  # along the curve of moments; more are chosen among the bands
_PER_PX = 4  # phases at which kernels are compared
_FINE = 32


@dataclass(frozen=True)
class Footprint:
    """Kernels of a footprint and how much each counts in each band. All widths in px of the camera.

    ``shift`` and ``variance`` are (2, kernel) along the line and the scan, ``mixing`` (kernel, band) of sum 1 in each
    band. ``parts`` are how many boxes across and along stand for one box that lies turned in the scene.
    """

    box: tuple[float, float]  # across and along; 0 is none
    parts: tuple[int, int]
    held: int  # positions 1 px apart along the scan
    shift: Floats
    variance: Floats
    mixing: Floats

    @property
    def kernels(self) -> int:
        """How many there are."""
        return int(self.shift.shape[1])


def fold(box: tuple[float, float], parts: tuple[int, int], held: int, shift: Floats, variance: Floats) -> Footprint:
    """Fold boxes and held positions with the moments that all blurs have together.

    Parameters
    ----------
    box
        Widths of slit and pixel, 0 for none. [px]
    shift, variance
        (2, band) along the line and along the scan, as ``effect.Moments``. [px, px^2]

    Returns
    -------
    As few kernels as misplace no more than `NEGLIGIBLE` of any band's light, whatever the sample's place.
    """
    moments = np.concatenate([shift, variance])
    distinct, band = np.unique(moments, axis=1, return_inverse=True)
    nodes, mixing = _few(distinct, box, held)
    return Footprint(box, parts, held, nodes[:2], nodes[2:], mixing[:, band.ravel()])


def _few(moments: Floats, box: tuple[float, float], held: int) -> tuple[Floats, Floats]:
    """Nodes (4, kernel) and mixing (kernel, band) for bands of moments (4, band), no two alike."""
    bands = moments.shape[1]
    if bands == 1:
        return moments, np.ones((1, 1))
    reach = _reaches(moments, box, held)
    wanted = _compared(moments, box, held, reach)
    for count in range(1, min(bands, _MOST_NODES + 1)):
        nodes = _along_curve(moments, count)
        mixing, error = _fitted(_compared(nodes, box, held, reach), wanted)
        if error <= NEGLIGIBLE:
            return nodes, mixing
    return moments, np.eye(bands)


def _reaches(moments: Floats, box: tuple[float, float], held: int) -> tuple[int, int]:
    """How many px along and across hold all kernels but for what does not count; even numbers."""
    sharp = np.array([box[1] / 2, box[0] / 2 + (held - 1) / 2]) + 2
    widest = sharp + np.abs(moments[:2]).max(axis=1) + 4 * np.sqrt(moments[2:].max(axis=1))
    along, scan = (2 * np.ceil(widest / 2)).astype(int).tolist()
    return along, scan


def _along_curve(moments: Floats, count: int) -> Floats:
    """Moments at Chebyshev's nodes of the curve along which those of the bands lie, (4, count)."""
    size = np.concatenate([moments[:2], np.sqrt(moments[2:])])
    centred = size - size.mean(axis=1, keepdims=True)
    place = np.linalg.svd(centred, full_matrices=False)[2][0]
    order = np.argsort(place)
    low, high = place[order[[0, -1]]]
    at = (low + high) / 2 - (high - low) / 2 * np.cos((np.arange(count) + 0.5) * np.pi / count)
    return np.stack([np.interp(at, place[order], one[order]) for one in moments])


def _compared(moments: Floats, box: tuple[float, float], held: int, reach: tuple[int, int]) -> Floats:
    """Kernels (phase, tap, kernel) over the scene's pixels at a few phases of either axis."""
    along = _sampled(blurred_weight(box[1], moments[2], 1, _FINE), moments[0], reach[0])
    scan = _sampled(blurred_weight(box[0], moments[3], held, _FINE), moments[1], reach[1])
    both = scan[:, None, :, None] * along[None, :, None, :]
    return both.reshape(_PER_PX**2, -1, moments.shape[1])


def _sampled(kernels: tuple[Floats, Floats], shift: Floats, reach: int) -> Floats:
    """Weights (phase, tap, kernel) of one axis."""
    distance, weight = kernels
    place = np.arange(-reach * _PER_PX, reach * _PER_PX) / _PER_PX
    rows = [np.interp(place - way, distance, one, 0.0, 0.0) for way, one in zip(shift, weight, strict=True)]
    return np.stack(rows, axis=-1).reshape(2 * reach, _PER_PX, -1).swapaxes(0, 1)


def _fitted(kernels: Floats, wanted: Floats) -> tuple[Floats, float]:
    """Mixing (kernel, band) by least squares, of sum 1, and the greatest share of light that it misplaces."""
    count, bands = kernels.shape[2], wanted.shape[2]
    columns = kernels.reshape(-1, count)
    heavy = 1e3 * np.abs(columns).max()
    system = np.concatenate([columns, np.full((1, count), heavy)])
    right = np.concatenate([wanted.reshape(-1, bands), np.full((1, bands), heavy)])
    mixing: Floats = np.linalg.lstsq(system, right, rcond=None)[0]
    mixing /= mixing.sum(axis=0)
    missed = np.abs(kernels @ mixing - wanted).sum(axis=1)
    return mixing, float(missed.max())
