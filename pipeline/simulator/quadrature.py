"""Rays that integrate over a footprint, for scenes without pixels: Gauss's quadrature of box and Gaussian together."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator.footprint import Footprint

Floats = NDArray[np.float64]
_PER_PX = 3  # rays for each px of a box


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
