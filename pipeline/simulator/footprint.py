"""The footprint of a sample: slit, pixel and every blur folded into one kernel, as the rays that integrate over it.

Along either axis the kernel is a box (the slit, or the pixel), with it perhaps the positions that the mirror holds, and
a Gaussian with the shift and variance that all blurs have together. The rays are those of Gauss's quadrature for the
kernel in the middle of all bands'; bands share them with weights of their own, which match their moments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
NEGLIGIBLE = 3e-5  # most share of the light that few kernels may misplace: .004 sigma of a full well
_MOST_NODES = 96  # along one axis


@dataclass(frozen=True)
class AxisKernel:
    """A kernel along one axis in each band: a box convolved with a Gaussian. [px]"""

    box: float  # width; 0 is none
    shift: Floats  # (band,) of the Gaussian
    variance: Floats  # (band,) of the Gaussian [px^2]

    def points(self, shift: Floats, variance: Floats, degree: int) -> tuple[Floats, Floats]:
        """Give places (kernel, point) and weights (point,) that integrate polynomials of this degree exactly.

        ``shift`` and ``variance`` are (kernel,): the Gaussians that the box is convolved with.
        """
        count = degree // 2 + 1
        node, share = np.polynomial.legendre.leggauss(count) if self.box > 0 else (np.zeros(1), np.full(1, 2.0))
        wave, part = np.polynomial.hermite_e.hermegauss(count) if variance.any() else (np.zeros(1), np.ones(1))
        beside = np.sqrt(variance)[:, None] * wave
        place = shift[:, None, None] + (node * self.box / 2)[:, None] + beside[:, None]
        return place.reshape(len(shift), -1), np.outer(share / 2, part / part.sum()).ravel()

    def nodes(self, count: int) -> tuple[Floats, Floats]:
        """Give (node,) offsets [px] and (node, band) weights of sum 1; fewer nodes where the kernel is a point.

        Bands of one kernel are integrated right up to polynomials of degree 2 n - 1, others up to n - 1.
        """
        shift, variance = self.shift, self.variance
        apart = (shift.max() - shift.min()) / 2  # the shared rays reach as far as any band's
        middle = (shift.min() + shift.max()) / 2, (variance.min() + variance.max()) / 2 + apart**2
        place, weight = self.points(np.array(middle[:1]), np.array(middle[1:]), 2 * count)
        diagonal, beside = _recurrence(place[0], weight, count)
        node, share = _gauss(diagonal, beside)
        if np.ptp(shift) == np.ptp(variance) == 0:
            return node, np.repeat(share[:, None], len(shift), axis=1)
        basis = _polynomials(diagonal, beside, node)
        place, weight = self.points(shift, variance, count)
        means = _polynomials(diagonal, beside, place) @ weight
        return node, share[:, None] * (basis.T @ means)


@dataclass(frozen=True)
class Footprint:
    """Rays of a sample: offsets in px of the camera, (ray,) each, and (ray, band) weights of sum 1 in each band."""

    across: Floats
    along: Floats
    weight: Floats

    def kernels(self) -> tuple[Floats, Floats]:
        """Part the weights into (ray, kernel) and (kernel, band), with as few kernels as are not negligible."""
        left, size, right = np.linalg.svd(self.weight, full_matrices=False)
        for count in range(1, len(size) + 1):
            rays, bands = left[:, :count] * size[:count], right[:count]
            if np.abs(rays @ bands - self.weight).sum(axis=0).max() <= NEGLIGIBLE:
                break
        return rays, bands


def quadrature(place: Floats, weight: Floats, count: int) -> tuple[Floats, Floats]:
    """Give nodes and weights of Gauss's quadrature for points of sum 1: right up to degree 2 ``count`` - 1."""
    return _gauss(*_recurrence(place, weight, count))


def fold(boxes: tuple[float, float], nodes: tuple[int, int], shift: Floats, variance: Floats) -> Footprint:
    """Fold the boxes of slit and pixel with the moments that all blurs have together.

    Parameters
    ----------
    boxes
        Widths of slit and pixel, 0 for none. [px]
    nodes
        Rays across the slit and along it that integrate the boxes alone; a blur adds as its width does, and takes
        three at least, which hold a variance of their own in every band.
    shift, variance
        (2, band) along the line and along the scan, as ``effect.Moments``: rays start so much further. [px, px^2]
    """
    turn, turn_weight = _axis_nodes(AxisKernel(boxes[0], shift[1], variance[1]), nodes[0])
    run, run_weight = _axis_nodes(AxisKernel(boxes[1], shift[0], variance[0]), nodes[1])
    weight = (turn_weight[:, None] * run_weight[None]).reshape(-1, shift.shape[1])
    return Footprint(np.repeat(turn, len(run)), np.tile(run, len(turn)), weight)


def _axis_nodes(kernel: AxisKernel, nodes: int) -> tuple[Floats, Floats]:
    blur, box = float(kernel.variance.max()), kernel.box**2 / 12
    if blur > 0 or np.ptp(kernel.shift) > 0:
        nodes = max(math.ceil(nodes * math.sqrt((blur + box) / max(box, 1 / 12))), 3)
    return kernel.nodes(min(nodes, _MOST_NODES))


def _recurrence(place: Floats, weight: Floats, count: int) -> tuple[Floats, Floats]:
    """Three-term recurrence of the polynomials orthonormal over points, by Lanczos' iteration (Golub, Welsch, 1969).

    Ends early where the points are used up.
    """
    basis = [np.sqrt(weight)]
    diagonal, beside = [], []
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
    return np.array(diagonal), np.array(beside)


def _gauss(diagonal: Floats, beside: Floats) -> tuple[Floats, Floats]:
    node, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1))
    return node, vectors[0] ** 2


def _polynomials(diagonal: Floats, beside: Floats, place: Floats) -> Floats:
    """Values (polynomial, *place) of the orthonormal polynomials."""
    values = [np.ones_like(place)]
    for order, size in enumerate(beside):
        before = values[order - 1] * beside[order - 1] if order else 0.0
        values.append(((place - diagonal[order]) * values[order] - before) / size)
    return np.stack(values)
