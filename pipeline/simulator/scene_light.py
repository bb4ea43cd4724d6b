"""Light that a scene sends through a footprint to samples: components through every kernel, mixed to bands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.rectify.kernels import tensor_rows
from pipeline.simulator.footprint import Footprint
from pipeline.simulator.quadrature import footprint_rays
from pipeline.simulator.rays import Views
from pipeline.simulator.scene import RasterScene, Scene
from pipeline.simulator.tap_sums import AT_ONCE, Gatherer, Pixels

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
LEAST_COLUMNS = 16  # of a product whose rows come out the same wherever they stand: with 5 or 9 they do not


class Looker:
    """Looks at scenes through one footprint, from views whose shape is within a range."""

    def __init__(self, footprint: Footprint, extremes: Views) -> None:
        """``extremes`` are views all over what will be looked at; their places do not matter."""
        self.footprint = footprint
        self._extremes = extremes

    @cached_property
    def gatherer(self) -> Gatherer:
        """What sums pixels."""
        return Gatherer(self.footprint, self._extremes)

    def look(self, scene: Scene, steps: Sequence[Views], *, along_y: bool, exposures: float) -> Light:
        """Give the light (n, band) of samples that look so at each of the held positions. [e-]

        A sample's light does not depend on the others: products of matrices are always of the same shape.
        """
        import torch

        spectra = scene.electrons * np.float32(exposures)
        pixels = _pixels(scene, along_y)
        mixing = self._mixing(spectra, len(steps) * (math.prod(self.footprint.parts) if pixels else 1))
        count, components = len(steps[0].along), spectra.shape[0]
        light = np.empty((count, spectra.shape[-1]), np.float32)
        parts, more = (np.zeros((AT_ONCE, self.footprint.kernels, components), np.float32) for _ in range(2))
        wide = mixing.shape[1]
        spare, table = torch.empty((AT_ONCE, wide)), torch.from_numpy(parts).view(AT_ONCE, -1)
        for first in range(0, count, AT_ONCE):
            chunk = slice(first, min(first + AT_ONCE, count))
            rows = chunk.stop - first
            for number, views in enumerate(steps):
                into = more if number else parts
                if pixels is None:
                    self._sampled(scene, views[chunk], along_y, into[:rows])
                else:
                    self.gatherer.gather(pixels, views[chunk], into[:rows])
                if number:
                    parts[:rows] += more[:rows]
            if spectra.ndim == 1:
                np.einsum("nkb,kb->nb", parts[:rows], mixing, out=light[chunk])
                continue
            whole = torch.from_numpy(light[chunk]) if rows == AT_ONCE and wide == light.shape[1] else spare
            torch.mm(table, torch.from_numpy(mixing), out=whole)
            if whole is spare:
                light[chunk] = spare.numpy()[:rows, : light.shape[1]]
        return light

    def _mixing(self, spectra: Light, sums: int) -> Light:
        """(kernel * component, band), or (kernel, band) where every band has a plane of its own."""
        share = self.footprint.mixing / sums
        if spectra.ndim == 1:
            return (share * spectra).astype(np.float32)
        mixing = (share[:, None] * spectra).reshape(-1, spectra.shape[1])
        return np.pad(mixing.astype(np.float32), ((0, 0), (0, max(LEAST_COLUMNS - mixing.shape[1], 0))))

    def _sampled(self, scene: Scene, views: Views, along_y: bool, out: Light) -> None:
        """Components of a scene without pixels, by rays."""
        out[:] = 0
        for kernel in range(self.footprint.kernels):
            for turn, run, weight in self._rays[kernel]:
                along = views.along + views.along_run * run + views.along_turn * turn
                scan = views.scan + views.scan_run * run + views.scan_turn * turn
                seen = scene.sample(along, scan) if along_y else scene.sample(scan, along)
                out[:, kernel] += seen * np.float32(weight)

    @cached_property
    def _rays(self) -> list[list[tuple[float, float, float]]]:
        return [footprint_rays(self.footprint, kernel) for kernel in range(self.footprint.kernels)]


def _pixels(scene: Scene, along_y: bool) -> Pixels | None:
    """A scene's pixels, None where it has none."""
    if not isinstance(scene, RasterScene):
        return None
    planes = np.ascontiguousarray(scene.planes, np.float32)
    return Pixels(tensor_rows(planes.reshape(-1, planes.shape[2])), scene.shape, along_y)
