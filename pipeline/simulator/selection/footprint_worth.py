"""How much pixels of a scene are worth a closer look: what slit and pixel show there, over its noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera, footprint_kernel

Light = NDArray[np.float32]
_LEAST_WEIGHT = 1e-3  # of a kernel's tap: enough to find places


@dataclass(frozen=True)
class PixelOptics:
    """Kernels of slit and pixel over a scene's pixels, and the part of the noise that light does not change [e-^2].

    ``turned`` are the orientations of the lines: whether they lie along y.
    """

    slit: NDArray[np.float32]
    pixel: NDArray[np.float32]
    fixed_noise: float
    binning: int
    turned: tuple[bool, ...]

    @staticmethod
    def of(camera: LineCamera, binning: int, turned: tuple[bool, ...]) -> PixelOptics:
        fixed = camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12
        return PixelOptics(_short_kernel(camera.slit_px), _short_kernel(1.0), fixed, binning, turned)

    @property
    def halo(self) -> int:
        """How far kernels, differences and sums reach. [px]"""
        return len(self.slit) // 2 + len(self.pixel) // 2 + 1 + self.binning // 2

    def noise(self, light: Light) -> Light:
        """Give one standard deviation at each light [e-]."""
        noise: Light = np.sqrt(np.maximum(light, 0) + np.float32(self.fixed_noise))
        return noise

    def worths(self, light: Light) -> Iterator[Light]:
        """Measures of light without its halo, (row, column, band) each: the higher, the more worth a look.

        Where samples are summed, sizes are averaged along the line, as the probe does.
        """
        inner = (slice(self.halo, -self.halo), slice(self.halo, -self.halo))
        for along_y in self.turned:
            line = 0 if along_y else 1
            seen = _blurred(_blurred(light, self.slit, 1 - line), self.pixel, line)
            level = self._summed(seen, line)[inner]
            noise = self.noise(level)
            yield level
            yield -level
            yield self._summed(np.abs(light - seen), line)[inner] / noise
            for axis in (0, 1):
                ahead, behind = np.roll(seen, -1, axis), np.roll(seen, 1, axis)
                yield self._summed(np.abs(ahead - behind), line)[inner] / noise
                yield self._summed(np.abs(ahead + behind - 2 * seen), line)[inner] / noise
            rise: Light = np.roll(seen, -1, 0) - np.roll(seen, 1, 0)
            mixed = np.abs(np.roll(rise, -1, 1) - np.roll(rise, 1, 1))  # what a box that does not lie turned misses
            yield np.divide(self._summed(mixed, line)[inner], noise)

    def _summed(self, values: Light, axis: int) -> Light:
        """Mean over the samples of a stored number about each pixel, along an axis."""
        if self.binning == 1:
            return values
        steps = np.arange(self.binning) - self.binning // 2
        total: Light = sum((np.roll(values, -step, axis) for step in steps.tolist()), np.zeros_like(values))
        total /= np.float32(self.binning)
        return total


def _short_kernel(width_px: float) -> NDArray[np.float32]:
    kernel = footprint_kernel(width_px) if width_px > 0 else np.ones(1)
    half = len(kernel) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(kernel) > _LEAST_WEIGHT) - half).max())
    return kernel[half - reach : half + reach + 1].astype(np.float32)


def _blurred(light: Light, kernel: NDArray[np.float32], axis: int) -> Light:
    half = len(kernel) // 2
    total: Light = kernel[half] * light
    for offset in range(1, half + 1):  # kernels are symmetric
        total += kernel[half + offset] * (np.roll(light, offset, axis) + np.roll(light, -offset, axis))
    return total
