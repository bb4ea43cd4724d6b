"""Light that a scene's pixels send through a footprint to samples: components through every kernel, mixed to bands.

For every sample there is one window of pixels, and for every kernel a weight for each of them. A footprint that lies
turned in the scene is parted across the slit. Each part is a box parallel to the scene's axes, in its right place. The
parts are moved and widened so that all together have the second moments of the turned footprint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator import compiled_loops
from spectralzoom.pipeline.simulator.optics.kernel_fit import TAIL, Floats, Footprint, TapTable, disc_points
from spectralzoom.pipeline.simulator.optics.rays import RayViews
from spectralzoom.pipeline.simulator.scenes.scene import THINNED_MARGIN, RasterScene

Radiance = NDArray[np.float32]
MOST_PARTS = 1_500_000  # components of samples through kernels, at once: few calls, and little memory
LEAST_BANDS = 16  # that are mixed by themselves: fewer cost as much


@dataclass(frozen=True)
class _Mixing:
    """From components through every kernel to bands: kernels are summed to nodes, of which each band is between two."""

    fractions: Radiance  # (node, kernel)
    # bands that follow each other, the nodes that they lie between, and rows as `compiled_loops.mixing_rows` has them
    products: tuple[tuple[slice, slice, Radiance], ...]

    @staticmethod
    def of(fractions: Radiance, between: Floats, spectra: Radiance) -> _Mixing:
        """Return the mixing of spectra (component, band): bands between the same nodes are made at once."""
        bands = spectra.shape[1]
        cuts = [0]
        for cut in (np.flatnonzero(np.diff((between > 0).argmax(axis=0))) + 1).tolist():
            if min(cut - cuts[-1], bands - cut) >= LEAST_BANDS:
                cuts.append(cut)
        products = []
        for some in map(slice, cuts, [*cuts[1:], bands]):
            found = np.flatnonzero(between[:, some].any(axis=1))
            nodes = slice(int(found[0]), int(found[-1]) + 1)
            mixing = (between[nodes, None, some] * spectra[:, some]).reshape(-1, some.stop - some.start)
            products.append((some, nodes, compiled_loops.mixing_rows(mixing.astype(np.float32))))
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


class SceneSampler:
    """Sample scenes through one footprint, from views whose shape is within a range."""

    def __init__(self, footprint: Footprint, extremes: RayViews) -> None:
        """Take ``extremes``: views spread over all that will be sampled; their places do not matter."""
        self.footprint = footprint
        self._extremes = extremes

    @cached_property
    def tables(self) -> list[tuple[int, NDArray[np.intp], KernelTables]]:
        """Return through which kernels pixels of which level are summed, and the tables of these."""
        whole = self.footprint
        return [(level, some, KernelTables(whole.part(level, some), self._extremes)) for level, some in whole.windows()]

    def scan_pass(
        self, scene: RasterScene, steps: Sequence[RayViews], *, along_y: bool, exposure_ratio: float
    ) -> Radiance:
        """Return the light (n, band) of samples that look so at each held position, whatever the others see. [e-]"""
        spectra = scene.electrons * np.float32(exposure_ratio)
        levels = np.unique(self.footprint.level).tolist()
        planes = {level: np.ascontiguousarray(scene.raster.thinned(level), np.float32) for level in levels}
        kernels = self.footprint.kernels
        sums = np.ones(kernels)
        for _, some, tables in self.tables:
            sums[some] = tables.parts
        fractions = (self.footprint.fractions / np.reshape(len(steps) * sums, (-1, 1))).T.astype(np.float32)
        count = len(steps[0].along)
        light = np.empty((count, spectra.shape[-1]), np.float32)
        if spectra.ndim == 1:
            gains = ((fractions.T @ self.footprint.between) * spectra).astype(np.float32)
            light[:] = 0
            self._gather(planes, steps, light[None], np.zeros(kernels, np.intp), gains, along_y=along_y)
            return light
        components = spectra.shape[0]
        gains = np.ones((kernels, components), np.float32)
        mixing = _Mixing.of(fractions, self.footprint.between, spectra)
        at_once = max(MOST_PARTS // (kernels * components), 1)
        for first in range(0, count, at_once):
            chunk = slice(first, min(first + at_once, count))
            parts = np.zeros((kernels, chunk.stop - first, components), np.float32)
            some_steps = [views[chunk] for views in steps]
            self._gather(planes, some_steps, parts, np.arange(kernels), gains, along_y=along_y)
            mixing.write(parts, light[chunk])
        return light

    def _gather(
        self,
        planes: dict[int, Radiance],
        steps: Sequence[RayViews],
        out: Radiance,
        numbers: NDArray[np.intp],
        gains: Radiance,
        *,
        along_y: bool,
    ) -> None:
        """Add what samples see through kernels, times gains (kernel, component), to ``out`` (number, n, component).

        ``planes`` (y, x, component), by level, are C-contiguous; ``numbers`` (kernel,) are the places in ``out``.
        """
        for views in steps:
            for level, some, one in self.tables:
                pixels = planes[level]
                rows, columns, components = pixels.shape
                raster = compiled_loops.PixelTable(columns, rows, components, along_y)
                seen = views.thinned(level, THINNED_MARGIN).table()
                compiled_loops.gather_windows(
                    pixels.reshape(-1), raster, seen, one.kernels, one.along, one.scan, numbers[some], gains[some], out
                )


class KernelTables:
    """A footprint's kernels and tables of their weights, for views whose shape is within a range."""

    def __init__(self, footprint: Footprint, views: RayViews) -> None:
        """Take ``views`` that include the extremes of all that will be sampled."""
        self.kernels = kernels_of(footprint)
        self.parts = int(self.kernels.place.shape[1])  # boxes that each kernel is summed over
        table = views.table()
        beside = np.zeros((2, len(views.along)), np.float32)  # all look at the middle of a pixel
        scale = np.empty((footprint.kernels, 2, len(views.along)))  # of one part
        off = np.empty((footprint.kernels, 2, self.parts, len(views.along)), np.float32)  # of parts from it [px]
        for kernel in range(footprint.kernels):
            compiled_loops.place_parts(table, beside, kernel, self.kernels, scale[kernel], off[kernel])
        reach = np.abs(off).max(axis=(0, 2, 3), initial=0.0) + 0.02
        ranges = [(float(one.min()), float(one.max())) for one in scale.swapaxes(0, 1)]
        tail = TAIL / float(footprint.fractions.max(initial=0.0) or 1.0)
        slit, pixel = footprint.box
        across, along = footprint.parts
        variance = footprint.variance + disc_points(footprint.disc)[1][:, None]
        self.along = TapTable.of(pixel / along, variance[0], 1, ranges[0], float(reach[0]), tail)
        self.scan = TapTable.of(slit / across, variance[1], footprint.held, ranges[1], float(reach[1]), tail)


def kernels_of(footprint: Footprint) -> compiled_loops.PartedKernels:
    """Return a footprint's kernels and the parts of its box as the compiled loops take them."""
    across, along = footprint.parts
    slit, pixel = footprint.box
    variance = footprint.variance + np.array([[pixel / along], [slit / across]]) ** 2 / 12
    points, about = disc_points(footprint.disc)
    variance = np.array(variance + about[:, None], order="C")
    between = slit**2 / 12 * (1 - 1 / across**2) + float((points[1] ** 2).mean())
    turn = ((np.arange(across) + 0.5) / across - 0.5) * slit
    run = ((np.arange(along) + 0.5) / along - 0.5) * pixel
    boxes = np.stack([np.repeat(turn, along), np.tile(run, across)])  # across and along, in px of the camera
    parts = (boxes[:, :, None] + points[::-1, None]).reshape(2, -1).astype(np.float32)  # boxes at a disc's points
    return compiled_loops.PartedKernels(np.array(footprint.shift, np.float32, order="C"), variance, between, parts)
