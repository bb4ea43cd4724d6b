"""Light that a scene's pixels send through a footprint to samples: components through every kernel, mixed to bands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.optics.kernel_fit import Footprint
from pipeline.simulator.optics.rays import RayViews
from pipeline.simulator.optics.tap_sums import Gatherer, ScenePixels
from pipeline.simulator.scenes.scene import THINNED_MARGIN, RasterScene

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
MIXED = 1024  # samples in a product
MOST_PARTS = 1_500_000  # components of samples through kernels, at once: few calls, and little memory
LEAST_COLUMNS = 16  # of a product whose rows come out the same wherever they stand: with 5 or 9 they do not


class _BandProduct(NamedTuple):
    """Bands that one product makes, the columns of a table of nodes that it takes, and how they are mixed."""

    bands: slice
    taken: slice
    mixing: Light  # (node * component, band), with bands of nothing where there are few


@dataclass(frozen=True)
class _Mixing:
    """From components through every kernel to bands: kernels are summed to nodes, of which each band is between two.

    Products are always of the same shape, so that a sample's light does not depend on the others.
    """

    shares: Light  # (node, kernel)
    products: tuple[_BandProduct, ...]

    @staticmethod
    def of(shares: Light, between: Floats, spectra: Light) -> _Mixing:
        """That of spectra (component, band): bands that follow each other between the same nodes are made at once."""
        bands, components = spectra.shape[1], spectra.shape[0]
        lower, cuts = (between > 0).argmax(axis=0), [0]
        for cut in (np.flatnonzero(np.diff(lower)) + 1).tolist():
            if min(cut - cuts[-1], bands - cut) >= LEAST_COLUMNS:
                cuts.append(cut)
        products = []
        for some in map(slice, cuts, [*cuts[1:], bands]):
            nodes = np.flatnonzero(between[:, some].any(axis=1))
            near = slice(int(nodes[0]), int(nodes[-1]) + 1)
            mixing = (between[near, None, some] * spectra[:, some]).reshape(-1, some.stop - some.start)
            wide = np.pad(mixing.astype(np.float32), ((0, 0), (0, max(LEAST_COLUMNS - mixing.shape[1], 0))))
            products.append(_BandProduct(some, slice(near.start * components, near.stop * components), wide))
        return _Mixing(shares, tuple(products))

    def write(self, parts: Light, light: Light) -> None:
        """Write light (n, band) of the first samples of components (kernel, some times `MIXED`, component)."""
        for first in range(0, len(light), MIXED):
            table, into = self._table(parts[:, first : first + MIXED]), light[first : first + MIXED]
            for bands, taken, mixing in self.products:
                if len(into) == MIXED and mixing.shape[1] == bands.stop - bands.start:
                    np.matmul(table[:, taken], mixing, out=into[:, bands])
                else:
                    into[:, bands] = (table[:, taken] @ mixing)[: len(into), : bands.stop - bands.start]

    def _table(self, parts: Light) -> Light:
        """Components of `MIXED` samples at every node, (n, node * component)."""
        (kernels, count, components), nodes = parts.shape, len(self.shares)
        if kernels == nodes == 1:
            return np.asarray(parts[0] * self.shares[0, 0])
        summed: Light = self.shares @ parts.reshape(kernels, -1)
        return summed.reshape(nodes, count, components).transpose(1, 0, 2).reshape(count, -1)


class Looker:
    """Looks at scenes through one footprint, from views whose shape is within a range."""

    def __init__(self, footprint: Footprint, extremes: RayViews) -> None:
        """``extremes`` are views all over what will be looked at; their places do not matter."""
        self.footprint = footprint
        self._extremes = extremes

    @cached_property
    def gatherers(self) -> list[tuple[int, NDArray[np.intp], Gatherer]]:
        """What sums pixels of which level through which kernels."""
        windows, whole = self.footprint.windows(), self.footprint
        return [(level, some, Gatherer(whole.part(level, some), self._extremes)) for level, some in windows]

    def look(self, scene: RasterScene, steps: Sequence[RayViews], *, along_y: bool, exposures: float) -> Light:
        """Give the light (n, band) of samples that look so at each of the held positions. [e-]

        A sample's light does not depend on the others: products of matrices are always of the same shape.
        """
        spectra = scene.electrons * np.float32(exposures)
        levels = np.unique(self.footprint.level).tolist()
        pixels = {level: _pixels(scene, along_y, level) for level in levels}
        sums = np.where(self.footprint.level == 1, math.prod(self.footprint.parts), 1)
        shares = (self.footprint.shares / np.reshape(len(steps) * sums, (-1, 1))).T.astype(np.float32)
        count, components, kernels = len(steps[0].along), spectra.shape[0], self.footprint.kernels
        light = np.empty((count, spectra.shape[-1]), np.float32)
        if spectra.ndim == 1:
            gains = ((shares.T @ self.footprint.between) * spectra).astype(np.float32)
            light[:] = 0
            self._gather(pixels, steps, light[None], np.zeros(kernels, np.intp), gains)
            return light
        at_once = MIXED * int(np.clip(MOST_PARTS // (MIXED * kernels * components), 1, -(-count // MIXED)))
        parts, gains = np.empty((kernels, at_once, components), np.float32), np.ones((kernels, components), np.float32)
        mixing = _Mixing.of(shares, self.footprint.between, spectra)
        for first in range(0, count, at_once):
            chunk = slice(first, min(first + at_once, count))
            parts[:] = 0
            self._gather(pixels, [views[chunk] for views in steps], parts, np.arange(kernels), gains)
            mixing.write(parts, light[chunk])
        return light

    def _gather(
        self,
        pixels: dict[int, ScenePixels],
        steps: Sequence[RayViews],
        out: Light,
        numbers: NDArray[np.intp],
        gains: Light,
    ) -> None:
        for views in steps:
            for level, some, gatherer in self.gatherers:
                seen = views.thinned(level, THINNED_MARGIN)
                gatherer.gather(pixels[level], seen, out, numbers[some], gains[some])


def _pixels(scene: RasterScene, along_y: bool, level: int) -> ScenePixels:
    return ScenePixels(np.ascontiguousarray(scene.raster.thinned(level), np.float32), along_y)
