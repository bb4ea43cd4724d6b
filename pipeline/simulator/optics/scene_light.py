"""Light that a scene's pixels send through a footprint to samples: components through every kernel, mixed to bands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.lazy import deferred
from pipeline.rectify.kernels import tensor_rows
from pipeline.simulator.optics.kernel_fit import Footprint
from pipeline.simulator.optics.rays import RayViews
from pipeline.simulator.optics.tap_sums import Gatherer, ScenePixels
from pipeline.simulator.scenes.scene import THINNED_MARGIN, RasterScene

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
MIXED = 1024  # samples in a product
MOST_PARTS = 1_500_000  # components of samples through kernels, at once: few calls, and little memory
LEAST_COLUMNS = 16  # of a product whose rows come out the same wherever they stand: with 5 or 9 they do not


@dataclass(frozen=True)
class _Bands:
    """From components through every kernel to bands: kernels are summed to nodes, of which each band is between two.

    Products are always of the same shape, so that a sample's light does not depend on the others.
    """

    shares: Light  # (node, kernel)
    mixing: Light  # (node * component, band), or (kernel, band) where every band has a plane of its own
    own_planes: bool

    @staticmethod
    def of(shares: Light, between: Floats, spectra: Light) -> _Bands:
        """Those of spectra (component, band), or (band,)."""
        if spectra.ndim == 1:
            return _Bands(shares, ((shares.T @ between) * spectra).astype(np.float32), own_planes=True)
        mixing = (between[:, None] * spectra).reshape(-1, spectra.shape[1]).astype(np.float32)
        wide = np.pad(mixing, ((0, 0), (0, max(LEAST_COLUMNS - mixing.shape[1], 0))))
        return _Bands(shares, wide, own_planes=False)

    def write(self, parts: Light, light: Light) -> None:
        """Write light (n, band) of the first samples of components (kernel, some times `MIXED`, component)."""
        if self.own_planes:
            np.einsum("knb,kb->nb", parts[:, : len(light)], self.mixing, out=light)
            return
        nodes, kernels = self.shares.shape
        mixing, shares = torch.from_numpy(self.mixing), torch.from_numpy(self.shares)
        columns, wide = torch.from_numpy(parts).view(kernels, -1), parts.shape[2] * MIXED
        for number, first in enumerate(range(0, len(light), MIXED)):
            summed = torch.mm(shares, columns[:, number * wide : (number + 1) * wide]).view(nodes, MIXED, -1)
            table = summed.permute(1, 0, 2).reshape(MIXED, -1)
            into = torch.from_numpy(light[first : first + MIXED])
            if into.shape == (MIXED, mixing.shape[1]):
                torch.mm(table, mixing, out=into)
            else:
                into.copy_(torch.mm(table, mixing)[: into.shape[0], : into.shape[1]])


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
        count, components = len(steps[0].along), spectra.shape[0]
        light = np.empty((count, spectra.shape[-1]), np.float32)
        kernels = self.footprint.kernels
        at_once = MIXED * int(np.clip(MOST_PARTS // (MIXED * kernels * components), 1, -(-count // MIXED)))
        parts, more = (np.zeros((kernels, at_once, components), np.float32) for _ in range(2))
        bands = _Bands.of(shares, self.footprint.between, spectra)
        for first in range(0, count, at_once):
            chunk = slice(first, min(first + at_once, count))
            rows = chunk.stop - first
            for number, views in enumerate(steps):
                into = more if number else parts
                for level, some, gatherer in self.gatherers:
                    gatherer.gather(pixels[level], views[chunk].thinned(level, THINNED_MARGIN), into[:, :rows], some)
                if number:
                    parts[:, :rows] += more[:, :rows]
            bands.write(parts, light[chunk])
        return light


def _pixels(scene: RasterScene, along_y: bool, level: int) -> ScenePixels:
    planes = np.ascontiguousarray(scene.raster.thinned(level), np.float32)
    rows, columns, components = planes.shape
    return ScenePixels(tensor_rows(planes.reshape(-1, components)), (rows, columns), along_y)
