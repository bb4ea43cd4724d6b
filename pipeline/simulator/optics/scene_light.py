"""Light that a scene sends through a footprint to samples: components through every kernel, mixed to bands.

Scenes of pixels are summed by weights (`tap_sums`); for others rays integrate, by Gauss's quadrature of box and
Gaussian together.
"""

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
from pipeline.simulator.scenes.scene import RasterScene, Scene

if TYPE_CHECKING:
    import torch
else:
    torch = deferred("torch")

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
MIXED = 1024  # samples in a product
MOST_PARTS = 1_500_000  # components of samples through kernels, at once: few calls, and little memory
LEAST_COLUMNS = 16  # of a product whose rows come out the same wherever they stand: with 5 or 9 they do not
_PER_PX = 3  # rays for each px of a box


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

    def look(self, scene: Scene, steps: Sequence[RayViews], *, along_y: bool, exposures: float) -> Light:
        """Give the light (n, band) of samples that look so at each of the held positions. [e-]

        A sample's light does not depend on the others: products of matrices are always of the same shape.
        """
        spectra = scene.electrons * np.float32(exposures)
        levels = np.unique(self.footprint.level).tolist()
        pixels = {level: _pixels(scene, along_y, level) for level in levels} if isinstance(scene, RasterScene) else {}
        sums = np.where(self.footprint.level == 1, math.prod(self.footprint.parts), 1) if bool(pixels) else 1
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
                if not pixels:
                    self._sampled(scene, views[chunk], along_y, into[:, :rows])
                for level, some, gatherer in self.gatherers if pixels else ():
                    gatherer.gather(pixels[level], views[chunk].thinned(level), into[:, :rows], some)
                if number:
                    parts[:, :rows] += more[:, :rows]
            bands.write(parts, light[chunk])
        return light

    def _sampled(self, scene: Scene, views: RayViews, along_y: bool, out: Light) -> None:
        out[:] = 0
        for kernel in range(self.footprint.kernels):
            for turn, run, weight in self._rays[kernel]:
                along = views.along + views.along_run * run + views.along_turn * turn
                scan = views.scan + views.scan_run * run + views.scan_turn * turn
                seen = scene.sample(along, scan) if along_y else scene.sample(scan, along)
                out[kernel] += seen * np.float32(weight)

    @cached_property
    def _rays(self) -> list[list[tuple[float, float, float]]]:
        return [footprint_rays(self.footprint, kernel) for kernel in range(self.footprint.kernels)]


def _pixels(scene: RasterScene, along_y: bool, level: int) -> ScenePixels:
    planes = np.ascontiguousarray(scene.raster.thinned(level), np.float32)
    rows, columns, components = planes.shape
    return ScenePixels(tensor_rows(planes.reshape(-1, components)), (rows, columns), along_y)


def footprint_rays(footprint: Footprint, kernel: int) -> list[tuple[float, float, float]]:
    """Give the rays of one kernel: px across and along, of the camera, and weights of sum 1."""
    level = int(footprint.level[kernel])
    turns = _axis(footprint.box[0], footprint.variance[1, kernel], footprint.held, level)
    runs = _axis(footprint.box[1], footprint.variance[0, kernel], 1, level)
    beside = footprint.shift[:, kernel]
    return [
        (float(turn + beside[1]), float(run + beside[0]), float(one * other))
        for turn, one in zip(*turns, strict=True)
        for run, other in zip(*runs, strict=True)
    ]


def quadrature(place: Floats, weight: Floats, count: int) -> tuple[Floats, Floats]:
    """Give nodes and weights of Gauss's quadrature for points of sum 1: right up to degree 2 ``count`` - 1.

    By the recurrence of the polynomials orthonormal over the points (Golub, Welsch, 1969); fewer nodes where the points
    are used up.
    """
    basis = [np.sqrt(weight)]
    diagonal: list[float] = []
    beside: list[float] = []
    reach = np.abs(place).max() + 1e-300
    for _ in range(count):
        following = place * basis[-1]
        diagonal.append(float(following @ basis[-1]))
        for _ in range(2):  # twice is enough
            following = following - np.stack(basis).T @ (np.stack(basis) @ following)
        size = float(np.linalg.norm(following))
        if size < 1e-9 * reach or len(diagonal) == count:
            break
        beside.append(size)
        basis.append(following / size)
    node, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1))
    return node, vectors[0] ** 2


def _axis(width: float, variance: float, held: int, level: int) -> tuple[Floats, Floats]:
    """Nodes and weights of a box, a Gaussian and held positions 1 px apart; fewer for what looks at few pixels."""
    spread = width + held - 1 + 4 * math.sqrt(variance)
    count = math.ceil(_PER_PX * spread / level) + 1
    node, share = np.polynomial.legendre.leggauss(count) if width > 0 else (np.zeros(1), np.full(1, 2.0))
    wave, part = np.polynomial.hermite_e.hermegauss(count) if variance > 0 else (np.zeros(1), np.ones(1))
    place = np.add.outer(node * width / 2, wave * math.sqrt(variance))
    weight = np.multiply.outer(share / 2, part / part.sum())
    steps = np.arange(held) - (held - 1) / 2
    return quadrature(np.add.outer(steps, place).ravel(), np.tile(weight.ravel(), held) / held, count)
