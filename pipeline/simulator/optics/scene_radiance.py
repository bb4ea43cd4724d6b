"""Light that a scene's pixels send through a footprint to samples: components through every kernel, mixed to bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator import compiled_loops
from pipeline.simulator.optics.kernel_fit import Footprint
from pipeline.simulator.optics.rays import RayViews
from pipeline.simulator.optics.tap_sums import Gatherer, ScenePixels
from pipeline.simulator.scenes.scene import THINNED_MARGIN, RasterScene

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
MOST_PARTS = 1_500_000  # components of samples through kernels, at once: few calls, and little memory
LEAST_BANDS = 16  # that are mixed by themselves: fewer cost as much


class _BandProduct(NamedTuple):
    """Bands that follow each other, the nodes that they lie between, and how these are mixed to them."""

    bands: slice
    nodes: slice
    rows: Radiance  # as `compiled_loops.mixing_rows` has them


@dataclass(frozen=True)
class _Mixing:
    """From components through every kernel to bands: kernels are summed to nodes, of which each band is between two."""

    fractions: Radiance  # (node, kernel)
    products: tuple[_BandProduct, ...]

    @staticmethod
    def of(fractions: Radiance, between: Floats, spectra: Radiance) -> _Mixing:
        """Return the mixing of spectra (component, band): bands between the same nodes are made at once."""
        bands, cuts = spectra.shape[1], [0]
        for cut in (np.flatnonzero(np.diff((between > 0).argmax(axis=0))) + 1).tolist():
            if min(cut - cuts[-1], bands - cut) >= LEAST_BANDS:
                cuts.append(cut)
        products = []
        for some in map(slice, cuts, [*cuts[1:], bands]):
            found = np.flatnonzero(between[:, some].any(axis=1))
            nodes = slice(int(found[0]), int(found[-1]) + 1)
            mixing = (between[nodes, None, some] * spectra[:, some]).reshape(-1, some.stop - some.start)
            products.append(_BandProduct(some, nodes, compiled_loops.mixing_rows(mixing.astype(np.float32))))
        return _Mixing(np.ascontiguousarray(fractions), tuple(products))

    def write(self, parts: Radiance, light: Radiance) -> None:
        """Write light (n, band) of components through kernels, (kernel, n, component)."""
        nodes = np.empty((len(self.fractions), *parts.shape[1:]), np.float32)
        if self.fractions.size == 1:
            np.multiply(parts, self.fractions[0, 0], out=nodes)
        else:
            compiled_loops.sum_nodes(parts.reshape(len(parts), -1), self.fractions, nodes.reshape(len(nodes), -1))
        for bands, some, rows in self.products:
            compiled_loops.mix_bands(nodes, some.start, some.stop, rows, bands.start, bands.stop - bands.start, light)


class Looker:
    """Looks at scenes through one footprint, from views whose shape is within a range."""

    def __init__(self, footprint: Footprint, extremes: RayViews) -> None:
        """Take ``extremes``: views spread over all that will be sampled; their places do not matter."""
        self.footprint = footprint
        self._extremes = extremes

    @cached_property
    def gatherers(self) -> list[tuple[int, NDArray[np.intp], Gatherer]]:
        """Return what sums pixels of which level through which kernels."""
        windows, whole = self.footprint.windows(), self.footprint
        return [(level, some, Gatherer(whole.part(level, some), self._extremes)) for level, some in windows]

    def scan_pass(self, scene: RasterScene, steps: Sequence[RayViews], *, along_y: bool, exposures: float) -> Radiance:
        """Return the light (n, band) of samples that look so at each of the held positions. [e-]

        A sample's light does not depend on the others.
        """
        spectra = scene.electrons * np.float32(exposures)
        levels = np.unique(self.footprint.level).tolist()
        rasters = {level: np.ascontiguousarray(scene.raster.thinned(level), np.float32) for level in levels}
        pixels = {level: ScenePixels(raster, along_y) for level, raster in rasters.items()}
        sums = np.ones(self.footprint.kernels)
        for _, some, gatherer in self.gatherers:
            sums[some] = gatherer.parts
        fractions = (self.footprint.fractions / np.reshape(len(steps) * sums, (-1, 1))).T.astype(np.float32)
        count, components, kernels = len(steps[0].along), spectra.shape[0], self.footprint.kernels
        light = np.empty((count, spectra.shape[-1]), np.float32)
        if spectra.ndim == 1:
            gains = ((fractions.T @ self.footprint.between) * spectra).astype(np.float32)
            light[:] = 0
            self._gather(pixels, steps, light[None], np.zeros(kernels, np.intp), gains)
            return light
        gains, mixing = (
            np.ones((kernels, components), np.float32),
            _Mixing.of(fractions, self.footprint.between, spectra),
        )
        at_once = max(MOST_PARTS // (kernels * components), 1)
        for first in range(0, count, at_once):
            chunk = slice(first, min(first + at_once, count))
            parts = np.zeros((kernels, chunk.stop - first, components), np.float32)
            self._gather(pixels, [views[chunk] for views in steps], parts, np.arange(kernels), gains)
            mixing.write(parts, light[chunk])
        return light

    def _gather(
        self,
        pixels: dict[int, ScenePixels],
        steps: Sequence[RayViews],
        out: Radiance,
        numbers: NDArray[np.intp],
        gains: Radiance,
    ) -> None:
        for views in steps:
            for level, some, gatherer in self.gatherers:
                seen = views.thinned(level, THINNED_MARGIN)
                gatherer.gather(pixels[level], seen, out, numbers[some], gains[some])
