"""Footprints: slit, pixel and every blur folded to few kernels that all bands share; tables of their weights.

A kernel is a box convolved with a Gaussian of its own shift and variance. The box is the slit across the line and the
pixel along it. Gaussians of a ladder of sizes, at a few of the bands' shifts, stand for all bands. The waves that a sum
passes are compared with the optical transfer function behind the footprint of slit, pixel and scene. Wide ones look at
every second, fourth, ... pixel of the scene, blurred before: see `SceneRaster.thinned`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from spectralzoom.pipeline.simulator.optics.rays import pupil_contrast

Floats = NDArray[np.float64]
Axes = tuple[float, float]
# Radii over the disc's of rings of 6, 12, 18 points about one in the middle, and up to which diameter they stand for it
# behind slit and pixel: fitted, no wave is off by more than 2e-3 of its amplitude.
_FITTED = ((0.6, ()), (1.7, (0.72,)), (3.3, (0.433, 0.811)), (5.0, (0.312, 0.578, 0.864)))  # diameter [px], radii
_PX_A_RING = 1.7  # of the diameter, where there are more rings
_MOST_RINGS = 9
_SMOOTH = 0.6  # sd of the Gaussian about each point over the distance of rings, where these are as many as may be


def disc_contrast(along: Floats, scan: Floats, axes: Axes) -> Floats:
    """Return the transmission of waves [1/px] by an even elliptic disc of diameters ``axes`` [px]: 2 J1(v) / v."""
    v = np.pi * np.hypot(axes[0] * along, axes[1] * scan)
    return np.asarray(np.where(v > 1e-6, 2 * scipy.special.j1(v) / np.maximum(v, 1e-6), 1.0))


@lru_cache(maxsize=64)
def disc_points(axes: Axes) -> tuple[Floats, Floats]:
    """Return points (2, point) along line and scan [px], and the variance (2,) of a Gaussian about each [px^2].

    All count alike, and with the Gaussians have the disc's mean and variance, a sixteenth of its diameters squared.
    Small discs are one Gaussian; of very wide ones the edge is blurred.
    """
    radii = _rings(max(axes))
    counts = [1, *(6 * (ring + 1) for ring in range(len(radii)))]
    radius = np.repeat([0.0, *radii], counts)
    turn = np.concatenate([np.arange(count) * (2 * np.pi / count) + 0.3 * ring for ring, count in enumerate(counts)])
    size = np.array(axes) / 2
    found: Floats = size[:, None] * radius * np.stack([np.cos(turn), np.sin(turn)])
    return found, np.maximum(size**2 * (0.25 - (radius**2).mean() / 2), 0.0)


def _rings(diameter: float) -> tuple[float, ...]:
    """Return the radii over the disc's, one ring in the middle of each equal part of its area, or nearly."""
    for most, radii in _FITTED:
        if diameter <= most:
            return radii
    wanted = math.ceil(diameter / _PX_A_RING)
    rings = min(wanted, _MOST_RINGS)
    ends = np.array([3 * ring * (ring + 1) + 1 for ring in range(rings + 1)], np.float64)
    middle = (ends[:-1] + ends[1:]) / 2 / ends[-1]
    left = 0.5 / ends[-1]
    if wanted > rings:
        left = max(left, 2 * (_SMOOTH / (rings + 0.5)) ** 2)
    return tuple(np.sqrt(np.maximum(middle - left, 0.0)).tolist())


Transfer = NDArray[np.complex128]
NEGLIGIBLE = 1.5e-3  # of a wave's amplitude, that kernels may pass too much or too little: .07 sigma of a full well's
THINNED = 5 / 6  # variance that a thinned scene gains, over what its pixels' size squared grows
_SHARPEST = 0.16  # least size on the ladder, over the widest wave's
_CORE = 0.4  # of a pattern, over its wave's: the ladder reaches down to that of the narrowest
_RATIOS = (4.1, 2.6, 1.9)  # of sizes on the ladder's lower part
_FAINT = 0.14  # variance of what looks at a level, beyond that [px^2 of it]: images are then too faint to tell
_FARTHEST = 64  # px, or waves: the widest Gaussian
_SHIFTED_PX = (0.5, 2.0)  # sizes above which the ends of the bands' shifts are enough, and one shift
_NODES = (1, 2, 3, 4, 6, 8, 12, 16)  # along the curve of the bands' moments
_MOST_NODES = 8  # beside a pupil's ladder
_ENOUGH = 1.25  # times the least error: of what comes near it, the fewest kernels are taken
_OWN = 4  # bands at most that have a kernel each, where there is no diffraction
_JUDGED = 9  # bands on which a choice of kernels is judged
_BASIS = (2, 3, 5, 7, 9, 13, 17, 25, 33, 65)  # bands that are fitted: the others are between two of them
_LESS = 0.09  # of the square of the nodes' steps, by which each is narrower
_SUM = 30.0  # weight of the sum of 1 in the fit
_RADII = np.concatenate([np.geomspace(0.002, 0.1, 10), np.linspace(0.13, 1.3, 18)])  # waves [1/px]
_TURNS = (np.arange(8) + 0.5) * np.pi / 8
_ALONG = np.concatenate([np.outer(_RADII, np.cos(_TURNS)).ravel(), _RADII, 0 * _RADII])
_SCAN = np.concatenate([np.outer(_RADII, np.sin(_TURNS)).ravel(), 0 * _RADII, _RADII])
# Errors of waves longer than 20 px add up over wide fields: they count up to three times.
_STRICT = 1 + 2 / (1 + (np.hypot(_ALONG, _SCAN) / 0.05) ** 2)
_ALIKE_PX = 0.2  # by which widths may differ of kernels that share a window


@dataclass(frozen=True)
class Kernels:
    """Gaussians, (2, kernel) shift and variance, and the level at which each looks: 1, or every ``level``-th pixel."""

    shift: Floats
    variance: Floats
    level: NDArray[np.intp]


@lru_cache(maxsize=64)
def _fit(packed: bytes, bands: int, box: tuple[float, float], held: int, disc: Axes) -> tuple[Kernels, Floats, Floats]:
    """Return kernels and their fractions for bands (6, band), no two alike: shift, variance and waves."""
    moments = np.frombuffer(packed).reshape(6, bands)
    if bands <= _OWN and not moments[4:].any():
        return Kernels(moments[:2], moments[2:4], np.ones(bands, np.intp)), np.eye(bands), np.eye(bands)
    size = np.concatenate([moments[:2], np.sqrt(moments[2:4]), moments[4:]])
    place = np.linalg.svd(size - size.mean(axis=1, keepdims=True), full_matrices=False)[2][0]
    order = np.argsort(place)
    smeared = np.cos(2 * np.pi * np.outer(_SCAN, np.arange(held) - (held - 1) / 2)).mean(axis=1)
    own = np.sinc(_ALONG * box[1]) * np.sinc(_SCAN * box[0]) * smeared  # what slit, pixel and held positions pass
    own *= disc_contrast(_ALONG, _SCAN, disc)
    own *= _STRICT
    judged = _some(order, _JUDGED)
    wanted = _wanted(moments[:, judged], own)
    tried: list[tuple[Kernels, float]] = []
    for kernels in _candidates(moments, place):
        tried.append((kernels, _error(_passed(kernels, own), wanted)))
        if tried[-1][1] <= NEGLIGIBLE:
            break
    enough = max(_ENOUGH * min(error for _, error in tried), NEGLIGIBLE)
    chosen = next(kernels for kernels, error in tried if error <= enough)
    passed = _passed(chosen, own)
    kept = list(range(passed.shape[1]))
    while len(kept) > 1:  # as many as are needed
        without = [[one for one in kept if one != left] for left in kept]
        errors = [_error(passed[:, some], wanted) for some in without]
        least = int(np.argmin(errors))
        if errors[least] > enough:
            break
        kept = without[least]
    chosen = Kernels(chosen.shift[:, kept], chosen.variance[:, kept], chosen.level[kept])
    passed = _passed(chosen, own)
    for count in _BASIS:
        fitted = _some(order, count)
        fractions = _fractions(passed, _wanted(moments[:, fitted], own))
        between = np.stack([np.interp(place, place[fitted], one) for one in np.eye(len(fitted))])
        if np.abs(passed @ (fractions @ between[:, judged]) - wanted).max() <= enough or count >= bands:
            break
    return chosen, fractions, between


def _error(passed: Transfer, wanted: Transfer) -> float:
    return float(np.abs(passed @ _fractions(passed, wanted) - wanted).max())


def _some(order: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    return np.asarray(order[np.unique(np.linspace(0, len(order) - 1, min(len(order), most)).round().astype(int))])


def _candidates(moments: Floats, place: Floats) -> Iterator[Kernels]:
    waves = moments[4:]
    widest = waves[:, waves[0].argmax()]
    ladders = [_ladder(widest, _CORE * float(waves.min()), ratio) for ratio in _RATIOS] if waves.any() else [[(0.0, 1)]]
    stretch = widest**2 / widest.min() ** 2 if waves.any() else np.ones(2)
    for count in _NODES:
        if waves.any() and count > _MOST_NODES:
            return
        for ladder in ladders:
            found = []
            for size, level in ladder:
                few = count if size <= _SHIFTED_PX[0] else min(count, 2 if size <= _SHIFTED_PX[1] else 1)
                nodes = _nodes(moments[:4], place, few)
                # Light between two nodes is wider than either: each is the narrower, the farther they are apart.
                step = np.abs(np.diff(nodes[:2], axis=1)).max(axis=1, keepdims=True, initial=0.0)
                wide = (size**2 * stretch)[:, None] - _LESS * step**2
                variance = np.maximum(nodes[2:] + np.where(level == 1, wide, (size**2 * stretch)[:, None]), 0.0)
                found.append((nodes[:2], variance, np.full(nodes.shape[1], level, np.intp)))
            shift, variance, level_of = (np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True))
            yield Kernels(shift, variance, level_of)
        if count >= moments.shape[1]:
            return


def _ladder(widest: Floats, core: float, ratio: float) -> list[tuple[float, int]]:
    """Return the sizes [px, the smaller of along and scan] and the pyramid levels used for them."""
    wave = float(widest.min())
    least = min(_SHARPEST * wave, core)
    afar = 2 * _size_at(2)
    steps = max(math.ceil(math.log(afar / least) / math.log(ratio)), 0)
    sizes = [(float(size), 1) for size in np.geomspace(least, afar, steps + 1)[:-1]]
    level = 2
    while level == 2 or level <= _FARTHEST * max(wave, 1.0):
        sizes.append((level * _size_at(level), level))
        level *= 2
    return sizes


def _size_at(level: int) -> float:
    return math.sqrt(THINNED * (1 - 1 / level**2) + _FAINT)


def _nodes(moments: Floats, place: Floats, count: int) -> Floats:
    """Return the moments (4, count) at even steps along the bands' curve, with both ends; one node is its middle."""
    order = np.argsort(place)
    if count >= len(place):
        return moments[:, order]
    low, high = place[order[[0, -1]]]
    at = np.linspace(low, high, count) if count > 1 else np.array([(low + high) / 2])
    return np.stack([np.interp(at, place[order], one[order]) for one in moments])


def _seen_at(level: int) -> Floats:
    """Return the transmission of waves by the pixels of a level, linear between each other, (wave,)."""
    passed: Floats = (np.sinc(level * _ALONG) * np.sinc(level * _SCAN)) ** 2
    while level > 1:
        level //= 2
        passed *= (np.cos(np.pi * level * _ALONG) * np.cos(np.pi * level * _SCAN)) ** 8  # the binomial kernel
    return passed


def _gaussian(shift: Floats, variance: Floats) -> Transfer:
    """Return the transmission of waves by Gaussians, (wave, kernel), with their phases."""
    turned = np.outer(_ALONG, shift[0]) + np.outer(_SCAN, shift[1])
    spread = np.outer(_ALONG**2, variance[0]) + np.outer(_SCAN**2, variance[1])
    return np.exp(-2j * np.pi * turned - 2 * np.pi**2 * spread)


def _passed(kernels: Kernels, own: Floats) -> Transfer:
    """Return the transmission of waves by kernels behind slit and pixel, (wave, kernel)."""
    seen = {level: _seen_at(level) for level in set(kernels.level.tolist())}
    through = own[:, None] * np.stack([seen[level] for level in kernels.level.tolist()], axis=1)
    return through * _gaussian(kernels.shift, kernels.variance - THINNED * (kernels.level**2 - 1))


def _wanted(moments: Floats, own: Floats) -> Transfer:
    """Return the transmission of waves by bands, (wave, band), for moments (6, band)."""
    across = np.hypot(np.outer(_ALONG, moments[4]), np.outer(_SCAN, moments[5]))
    return (own * _seen_at(1))[:, None] * _gaussian(moments[:2], moments[2:4]) * pupil_contrast(across)


def _fractions(passed: Transfer, wanted: Transfer) -> Floats:
    """Return the fractions (kernel, band), none negative and of sum 1: a least squares fit of the waves passed."""
    system = np.concatenate([passed.real, passed.imag, np.full((1, passed.shape[1]), _SUM)])
    right = np.concatenate([wanted.real, wanted.imag, np.full((1, wanted.shape[1]), _SUM)])
    basis, triangle = np.linalg.qr(system)
    fractions: Floats = np.stack([scipy.optimize.nnls(triangle, one)[0] for one in (basis.T @ right).T], axis=1)
    fractions /= fractions.sum(axis=0)
    return fractions


@dataclass(frozen=True)
class Moments:
    """Moments of a blur in each band, (2, band) each: along the line and the scan.

    They are a shift [px] and a Gaussian's variance [px^2]. ``waves`` is for diffraction at an elliptic pupil, whose
    pattern has no variance: the wavelength over the pupil's widths [px], None without any. ``disc`` are the diameters
    along line and scan of what a point out of focus is imaged to, in all bands alike [px].
    """

    shift: Floats
    variance: Floats
    waves: Floats | None = None
    disc: Axes = (0.0, 0.0)

    @property
    def spread(self) -> Floats:
        """Return variance of Gaussian and disc, (2, band). [px^2]"""
        return self.variance + np.array(self.disc)[:, None] ** 2 / 16

    @staticmethod
    def together(blurs: Sequence[Moments], bands: int) -> Moments:
        """Return the moments of blurs in sequence. At most one of them is diffraction, and one a disc."""
        none = np.zeros((2, bands))
        shift, variance = sum((one.shift for one in blurs), none), sum((one.variance for one in blurs), none)
        waves = next((one.waves for one in blurs if one.waves is not None), None)
        return Moments(shift, variance, waves, next((one.disc for one in blurs if any(one.disc)), (0.0, 0.0)))


@dataclass(frozen=True)
class Footprint:
    """Kernels of a footprint and how much each counts in each band. All widths in px of the camera, or of the level."""

    box: tuple[float, float]  # across and along; 0 is none
    parts: tuple[int, int]  # boxes across and along that stand for one that lies turned
    held: int  # positions 1 px apart along the scan
    shift: Floats  # (2, kernel) along the line and the scan
    variance: Floats  # (2, kernel)
    fractions: Floats  # (kernel, node), of some bands
    between: Floats  # (node, band): between which two of these each band lies
    level: NDArray[np.intp]  # (kernel,) which pixels each looks at: 1 is all, 2 every second, and so on
    disc: Axes  # diameters along line and scan of a disc that blurs each kernel

    @property
    def kernels(self) -> int:
        return int(self.shift.shape[1])

    def windows(self) -> list[tuple[int, NDArray[np.intp]]]:
        """Return the levels, and numbers of kernels that look at pixels of that level through one window."""
        found = []
        for level in np.unique(self.level):
            there = np.flatnonzero(self.level == level)
            width = np.sqrt(self.variance[:, there]).max(axis=0)
            while there.size:
                alike = width <= width.min() + _ALIKE_PX
                found.append((int(level), there[alike]))
                there, width = there[~alike], width[~alike]
        return found

    def part(self, level: int, which: NDArray[np.intp]) -> Footprint:
        """Return some kernels in px of a level, without the blur of left-out pixels; beyond 1 boxes lie upright."""
        some = replace(self, fractions=self.fractions[which], level=self.level[which])
        shift, variance = self.shift[:, which], self.variance[:, which]
        if level == 1:
            return replace(some, shift=shift, variance=variance)
        variance = variance - THINNED * (level**2 - 1)
        variance[1] += (self.held**2 - 1) / 12
        variance = np.maximum(variance, 0.0) / level**2
        box = (self.box[0] / level, self.box[1] / level)
        disc = (self.disc[0] / level, self.disc[1] / level)
        return replace(some, box=box, parts=(1, 1), held=1, shift=shift / level, variance=variance, disc=disc)


def fold(box: tuple[float, float], parts: tuple[int, int], held: int, blurs: Moments) -> Footprint:
    """Fold a box, held positions and the blurs of all bands into few kernels that the bands share (see `Footprint`).

    Returns the fewest kernels that change no wave of any band by more than `NEGLIGIBLE` of its amplitude, or the best
    that were tried. No share is below 0, and they sum to 1.
    """
    waves = blurs.waves if blurs.waves is not None and blurs.waves.any() else np.zeros_like(blurs.shift)
    moments, band = np.unique(np.concatenate([blurs.shift, blurs.variance, waves]), axis=1, return_inverse=True)
    kernels, fractions, between = _fit(moments.tobytes(), moments.shape[1], box, held, blurs.disc)
    between = between[:, band.ravel()]
    return Footprint(box, parts, held, kernels.shift, kernels.variance, fractions, between, kernels.level, blurs.disc)


PER_PX = 128  # rows of a table; between them weights are linear, right to 8e-6 of a kernel's curvature
SCALE_STEP = 1 / 4096  # from one tabulated scale to the next; the nearest is taken
_WORKED_OUT = 16  # every so many of them are worked out, those between are linear: right to 2e-6
# Fraction of a kernel's weight that may lie beyond its taps; what is left is scaled to sum 1. No tap beyond has more
# than that either: weights jump by so much where a tap comes in.
TAIL = 5e-6
TABULATED = 2e-5  # fraction of the light, by size, that a table of either axis misplaces at most, but for what follows
BETWEEN_ROWS = 1 / (4 * PER_PX**2)  # variance that a kernel gains between two rows at most: half of either [px^2]
_SDS = 6.5  # of a Gaussian: nothing beyond


def box_weight(distance: Floats, width: float, held: int = 1) -> Floats:
    """Return the linear kernel averaged over a box and over ``held`` positions 1 px apart, at distances [px]."""
    total = np.zeros(np.shape(distance))
    for place in np.arange(held) - (held - 1) / 2:
        beside = distance - place
        if width > 1e-6:
            total += (_integral(beside + width / 2) - _integral(beside - width / 2)) / width
        else:
            total += np.maximum(1 - np.abs(beside), 0.0)
    return np.maximum(total / held, 0.0)  # differences of integrals round


def blurred_weight(width: float, variance: Floats, held: int = 1) -> tuple[Floats, Floats]:
    """Return distances (place,) from -reach to reach and Gaussian weights (kernel, place) of variance (kernel,)."""
    reach = math.ceil(1 + width / 2 + (held - 1) / 2 + _SDS * math.sqrt(variance.max(initial=0.0))) + 1
    distance = np.arange(-reach * PER_PX, reach * PER_PX + 1) / PER_PX
    sharp = box_weight(distance, width, held)
    if not variance.any():
        return distance, np.repeat(sharp[None], len(variance), axis=0)
    length = 2 * len(distance)
    passed = np.exp(-2 * np.pi**2 * variance[:, None] * np.fft.rfftfreq(length, 1 / PER_PX) ** 2)
    blurred = np.fft.irfft(np.fft.rfft(sharp, length) * passed, length)[:, : len(distance)]
    return distance, np.where(variance[:, None] > 0, np.maximum(blurred, 0.0), sharp)


class TapTable(NamedTuple):
    """Weights (row, tap) of the taps around a position, row after row, for every kernel and in it for every scale.

    A position is given by its distance ``place`` from the first tap, which lies ``left`` px before the centre's pixel.
    """

    weight: NDArray[np.float32]
    left: int
    first: float  # place of the first row of each scale
    least_scale: float
    scales: int
    rows: int  # of one scale
    per_px: int = PER_PX
    per_scale: float = 1 / SCALE_STEP

    @staticmethod
    def of(
        width: float, variance: Floats, held: int, scales: tuple[float, float], beside: float, tail: float = TAIL
    ) -> TapTable:
        """Tabulate kernels of a width and variances (kernel,), between two scales, up to ``beside`` px off centre."""
        least = (math.floor(scales[0] / SCALE_STEP) - 1) * SCALE_STEP
        count = math.ceil((scales[1] - least) / SCALE_STEP) + 2
        sizes = [max(least + SCALE_STEP * number, 1e-3) for number in range(0, count + _WORKED_OUT, _WORKED_OUT)]
        found = [blurred_weight(width * size, variance * size**2, held) for size in sizes]
        reach = max(_reach(*one, tail) for one in found)
        off = 0.5 + beside
        left = math.floor(reach + off)
        taps = math.ceil(left + off + reach)
        place = left + np.arange(math.floor(-off * PER_PX), math.ceil(off * PER_PX) + 2) / PER_PX
        rows = [_rows(place, taps, reach, one).astype(np.float32) for one in found]
        joined = np.empty((len(variance), count, len(place), taps), np.float32)
        for number in range(count):
            low, fraction = divmod(number, _WORKED_OUT)
            between = rows[low] + (rows[low + 1] - rows[low]) * np.float32(fraction / _WORKED_OUT)
            joined[:, number] = between.swapaxes(1, 2)
        return TapTable(joined.reshape(-1, taps), left, float(place[0]), least, count, len(place))


def _rows(place: Floats, taps: int, reach: float, kernels: tuple[Floats, Floats]) -> Floats:
    """Return the weights (kernel, tap, place), scaled to sum 1 at every place."""
    distance, weight = kernels
    apart = place[None, :] - np.arange(taps)[:, None]
    rows: Floats = np.stack([np.interp(apart, distance, one, left=0.0, right=0.0) for one in weight])
    rows *= np.abs(apart) < reach + 1 / PER_PX
    rows /= rows.sum(axis=1, keepdims=True)
    return rows


def _reach(distance: Floats, weight: Floats, tail: float) -> float:
    half = len(distance) // 2
    size = weight.max(axis=0)
    both = size[half:] + size[half::-1]
    beyond = both[::-1].cumsum()[::-1] * (distance[1] - distance[0])
    counts = (beyond > tail) | (both > 2 * tail)
    return float(distance[half:][counts][-1]) if counts.any() else 0.0


def _integral(t: Floats) -> Floats:
    """Return the integral of the kernel of linear interpolation from 0 to t."""
    a = np.minimum(np.abs(t), 1.0)
    return np.sign(t) * a * (1 - a / 2)
