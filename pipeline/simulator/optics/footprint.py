"""The footprint of a sample: slit, pixel and every blur folded, as few kernels that all bands share.

A kernel is a box (the slit across the line, the pixel along it) convolved with a Gaussian, of a shift and a variance of
its own. What a band sees is a sum of few of them, with shares that are not negative: see `kernel_fit`. Wide Gaussians,
which stand for the far tails of diffraction, look at every second, fourth, ... pixel of the scene, which is blurred
before: see `SceneRaster.thinned`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.optics.kernel_fit import THINNED, Moments, fit_kernels

Floats = NDArray[np.float64]
_ALIKE_PX = 0.3  # by which widths may differ of kernels that share a window


@dataclass(frozen=True)
class Footprint:
    """Kernels of a footprint and how much each counts in each band. All widths in px of the camera, or of the level.

    ``shift`` and ``variance`` are (2, kernel) along the line and the scan. ``shares`` are (kernel, node) of some bands
    and ``between`` (node, band): a band is one of those, or lies between two. ``parts`` are how many boxes across and
    along stand for one box that lies turned in the scene. ``level`` is (kernel,) of which pixels each looks at: 1 is
    all, 2 every second, and so on.
    """

    box: tuple[float, float]  # across and along; 0 is none
    parts: tuple[int, int]
    held: int  # positions 1 px apart along the scan
    shift: Floats
    variance: Floats
    shares: Floats
    between: Floats
    level: NDArray[np.intp]

    @property
    def kernels(self) -> int:
        """How many there are."""
        return int(self.shift.shape[1])

    @property
    def mixing(self) -> Floats:
        """How much each kernel counts in each band, (kernel, band); of sum 1 in each."""
        return self.shares @ self.between

    def windows(self) -> list[tuple[int, NDArray[np.intp]]]:
        """Give the levels, and numbers of kernels that look at pixels of that level through one window."""
        found = []
        for level in np.unique(self.level):
            there = np.flatnonzero(self.level == level)
            width = np.sqrt(self.variance[:, there]).max(axis=0)
            wide = width > width.min() + _ALIKE_PX
            found += [(int(level), some) for some in (there[~wide], there[wide]) if some.size]
        return found

    def part(self, level: int, which: NDArray[np.intp]) -> Footprint:
        """Give some kernels of a level, in its px. Beyond level 1 boxes lie upright: they are small beside Gaussians.

        What blurs a scene before pixels are left out is taken off the Gaussians.
        """
        some = replace(self, shares=self.shares[which], level=self.level[which])
        shift, variance = self.shift[:, which], self.variance[:, which]
        if level == 1:
            return replace(some, shift=shift, variance=variance)
        variance = variance - THINNED * (level**2 - 1)
        variance[1] += (self.held**2 - 1) / 12
        variance, box = np.maximum(variance, 0.0) / level**2, (self.box[0] / level, self.box[1] / level)
        return replace(some, box=box, parts=(1, 1), held=1, shift=shift / level, variance=variance)


def fold(box: tuple[float, float], parts: tuple[int, int], held: int, blurs: Moments) -> Footprint:
    """Fold boxes and held positions with all blurs together.

    Parameters
    ----------
    box
        Widths of slit and pixel, 0 for none. [px]

    Returns
    -------
    As few kernels as change no wave by more than `kernel_fit.NEGLIGIBLE` of its amplitude.
    """
    kernels, shares, between = fit_kernels(blurs, box, held)
    return Footprint(box, parts, held, kernels.shift, kernels.variance, shares, between, kernels.level)
