"""Light through a footprint: for every sample one window of pixels, and for every kernel a weight for each of them.

A footprint that lies turned in the scene is parted across the slit: each part is a box that does not lie turned, in its
right place. The parts are moved beside their places, and widened, by so much that all together have the second moments
of the turned footprint. There are as few as misplace little of its light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.lazy import deferred
from pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from pipeline.simulator.optics.rays import RayViews

if TYPE_CHECKING:  # a second to import: the functions that use it do so, and a plan of a survey never needs it
    import torch
else:
    torch = deferred("torch")

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
Parts = tuple[int, int]
LADDER: tuple[Parts, ...] = ((1, 1), (2, 1), (3, 1), (5, 2), (9, 3))  # across and along; the last is taken as exact
_FINER = (18, 6)  # than any; what they are held against
_PHASES = (0.0, 0.5)  # of the pixels, along either axis
Weights = NDArray[np.float32]
PER_PX = 128  # rows of a table; between them weights are linear, right to 8e-6 of a kernel's curvature
SCALE_STEP = 1 / 4096  # from one tabulated scale to the next; the nearest is taken
_WORKED_OUT = 16  # every so many of them are worked out, those between are linear: right to 2e-6
TAIL = 5e-6  # share of a kernel's weight that may lie beyond its taps; what is left is scaled to sum 1. No tap beyond
# has more than that either: weights jump by so much where a tap comes in.
TABULATED = 2e-5  # share of the light, by size, that a table of either axis misplaces at most, but for what follows
BETWEEN_ROWS = 1 / (4 * PER_PX**2)  # variance that a kernel gains between two rows at most: half of either [px^2]
_SDS = 6.5  # of a Gaussian: nothing beyond


@dataclass(frozen=True)
class ScenePixels:
    """A scene's planes as rows of a table, and whether lines lie along y."""

    table: torch.Tensor  # (pixel, component)
    shape: tuple[int, int]
    along_y: bool


@dataclass(frozen=True)
class PartShape:
    """How kernels lie in the scene at some samples, (kernel, n) each: second moments of one part, as scales of it."""

    along: Floats
    scan: Floats
    lean: Floats  # px along by which parts are moved per px across, so that all have the footprint's covariance


@dataclass(frozen=True)
class PartOffsets:
    """Where parts of a footprint lie beside the pixel nearest to a sample's view, in float32 from here on."""

    centre: tuple[Light, Light]  # (n,) along and scan [px]
    run: tuple[Light, Light]  # px of the scene per px of the camera along the line
    turn: tuple[Light, Light]  # across it
    lean: tuple[Light, Light]  # across it, with the lean of the parts of each kernel, (kernel or 1, 1, n)

    @staticmethod
    def of(views: RayViews, shape: PartShape, along: Floats | float, scan: Floats | float) -> PartOffsets:
        """Those of some samples, whose views are so far from their pixel."""
        turn = views.along_turn, views.scan_turn
        pairs = (along, scan), (views.along_run, views.scan_run), turn, (turn[0] + shape.lean[:, None], turn[1])
        return PartOffsets(*((np.asarray(one, np.float32), np.asarray(other, np.float32)) for one, other in pairs))

    def parts(self, shift: Floats, places: Light) -> tuple[Light, Light]:
        """Give how far beside the pixel parts of kernels lie, along and scan, (kernel, part, n) each. [px]

        ``shift`` is (2, kernel) along and across, ``places`` (2, part) across and along. [px of the camera]
        """
        runs, turns = np.asarray(shift, np.float32)[:, :, None, None]
        across, along = places[:, :, None]
        first, second = (
            self.run[axis] * (runs + along) + (self.turn[axis] * turns + (self.lean[axis] * across + self.centre[axis]))
            for axis in (0, 1)
        )
        return first, second


class Gatherer:
    """Gathers a scene's components through a footprint at views whose shape is within a range."""

    def __init__(self, footprint: Footprint, views: RayViews) -> None:
        """``views`` are some that hold the extremes of all that will be gathered."""
        self.footprint = footprint
        shape = shape_of(footprint, views)
        self.places = part_places(footprint)
        beside = PartOffsets.of(views, shape, 0.0, 0.0)
        reach = [float(np.abs(off).max(initial=0.0)) + 0.02 for off in beside.parts(footprint.shift, self.places)]
        width, (across, along) = footprint.box, footprint.parts
        ranges = [(float(one.min()), float(one.max())) for one in (shape.along, shape.scan)]
        tail = TAIL / float(footprint.shares.max(initial=0.0) or 1.0)
        self.along = TapTable.of(width[1] / along, footprint.variance[0], 1, ranges[0], reach[0], tail)
        self.scan = TapTable.of(width[0] / across, footprint.variance[1], footprint.held, ranges[1], reach[1], tail)

    @cached_property
    def taps(self) -> int:
        """Pixels of a window."""
        return self.along.taps * self.scan.taps

    def gather(self, pixels: ScenePixels, views: RayViews, out: Light, numbers: NDArray[np.intp] | None = None) -> None:
        """Write the components (number, n, component) that some samples see through every kernel.

        They are sums over the parts. ``views`` are in px of the pixels, ``numbers`` (kernel,) where in ``out`` kernels
        belong: one after the other, if it is None. A sample's light does not depend on the others.
        """
        along, scan = np.rint(views.along), np.rint(views.scan)
        index = self._window(pixels, along, scan)
        shape = shape_of(self.footprint, views)
        rows = self.along.scale_rows(shape.along), self.scan.scale_rows(shape.scan)
        beside = PartOffsets.of(views, shape, views.along - along, views.scan - scan)
        count, starts = len(along), torch.arange(0, index.numel(), self.taps, dtype=index.dtype)
        turned, places = torch.empty((count, self.taps)), index.view(-1)
        off = beside.parts(self.footprint.shift.astype(np.float32), self.places)
        run, turn = self.along.read(off[0], rows[0]), self.scan.read(off[1], rows[1])
        for kernel, number in enumerate(range(self.footprint.kernels) if numbers is None else numbers):
            turned.copy_(torch.from_numpy(_joint(turn[:, kernel], run[:, kernel])).T)
            sums = torch.embedding_bag(pixels.table, places, starts, False, 0, False, turned.view(-1), False)[0]
            out[number] = sums.numpy()

    def _window(self, pixels: ScenePixels, along: Floats, scan: Floats) -> torch.Tensor:
        """Rows of the pixels' table, (n, tap); outside of the scene its edge is repeated."""
        kind = np.int32 if pixels.shape[0] * pixels.shape[1] < 2**31 else np.int64
        rows, columns = pixels.shape
        step, size = ((columns, 1), (rows, columns)) if pixels.along_y else ((1, columns), (columns, rows))
        first = along - self.along.left, scan - self.scan.left
        within = [
            (one >= 0) & (one + table.taps <= many)
            for one, table, many in zip(first, (self.along, self.scan), size, strict=True)
        ]
        offset = np.add.outer(np.arange(self.scan.taps) * step[1], np.arange(self.along.taps) * step[0])
        corner = (first[0] * step[0] + first[1] * step[1]).astype(kind)
        index = corner[:, None] + offset.ravel().astype(kind)
        edge = np.flatnonzero(~(within[0] & within[1]))
        if edge.size:
            x, y = (
                np.clip(one[edge, None] + np.arange(table.taps), 0, many - 1).astype(np.int64)
                for one, table, many in zip(first, (self.along, self.scan), size, strict=True)
            )
            index[edge] = (y[:, :, None] * step[1] + x[:, None] * step[0]).reshape(len(edge), -1)
        return torch.from_numpy(index)


def _joint(turn: Light, run: Light) -> Light:
    """Sum of products (across * along, n) over the parts of weights (across, part, n) and (along, part, n)."""
    joint = np.multiply(turn[:, None, 0], run[None, :, 0])
    total, across, along = (torch.from_numpy(one) for one in (joint, turn, run))
    for number in range(1, turn.shape[1]):
        total.addcmul_(across[:, None, number], along[None, :, number])
    return joint.reshape(-1, turn.shape[2])


def shape_of(footprint: Footprint, views: RayViews) -> PartShape:
    """Give how the parts of a footprint lie so that all have the second moments that rays give it."""
    (across, along), (slit, pixel) = footprint.parts, footprint.box
    run, turn = footprint.variance[:, :, None] + np.array([pixel / along, slit / across])[:, None, None] ** 2 / 12
    a, b, c, d = views.along_run, views.scan_run, views.along_turn, views.scan_turn
    between = slit**2 / 12 * (1 - 1 / across**2)
    lean = np.zeros((footprint.kernels, *a.shape))
    if between > 0:
        lean = (a * b * run + c * d * turn) / (d * between)
    wide = a * a * run + c * c * turn - lean * (2 * c + lean) * between
    high = b * b * run + d * d * turn
    return PartShape(_scale(wide, run), _scale(high, turn), lean)


def _scale(variance: Floats, nominal: Floats) -> Floats:
    found = np.divide(variance, nominal, out=np.ones(variance.shape), where=nominal > 0)
    return np.sqrt(np.maximum(found, 1e-4, out=found), out=found)


def part_places(footprint: Footprint) -> Light:
    """Give the middles of the parts, (2, part) across and along, in px of the camera."""
    across, along = footprint.parts
    turn = ((np.arange(across) + 0.5) / across - 0.5) * footprint.box[0]
    run = ((np.arange(along) + 0.5) / along - 0.5) * footprint.box[1]
    return np.stack([np.repeat(turn, along), np.tile(run, across)]).astype(np.float32)


def fewest_parts(share: float, box: tuple[float, float], views: RayViews) -> Parts:
    """Give the fewest boxes that misplace at most a ``share`` of the light where views are turned most.

    ``box`` is across and along [px]. A blur, or held positions, make the share smaller.
    """
    turn, run = np.abs(views.along_turn), np.abs(views.scan_run)
    most = {int(one.argmax()) for one in (turn, run, turn * box[0] ** 2 + run * box[1] ** 2)}
    columns = views.along_run, views.scan_run, views.along_turn, views.scan_turn
    shapes = [tuple(float(one[number]) for one in columns) for number in sorted(most)]
    kept = (parts for parts in LADDER if all(misplaced(parts, box, shape) <= share for shape in shapes))
    return next(kept, LADDER[-1])


@lru_cache(maxsize=256)
def misplaced(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> float:
    """Give the share of light, by size, that so many boxes put elsewhere than the turned footprint does.

    ``shape`` is px of the scene along and scan per px of the camera along the line, then across it. Half of the share
    times the range of a scene within the footprint is the most that a sample changes.
    """
    apart = np.abs(_weights(parts, box, shape) - _weights(_FINER, box, shape))
    return float(apart.sum(axis=(1, 2)).max())


def _weights(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> Floats:
    """Weights (phase, along, scan) of the pixels around a sample, in closed form."""
    none, views = np.zeros((2, 1)), RayViews(*(np.array([one]) for one in (0.0, 0.0, *shape)))
    footprint: Footprint = fold(box, parts, 1, Moments(none, none))
    scale = shape_of(footprint, views)
    places = PartOffsets.of(views, scale, 0.0, 0.0).parts(footprint.shift, part_places(footprint))
    along, scan = (one[0, :, 0].astype(np.float64) for one in places)
    reach = math.ceil((1 + max(map(abs, shape))) * sum(box)) + 3
    pixel = np.arange(-reach, reach + 1)[:, None]
    widths = box[1] / parts[1] * float(scale.along[0, 0]), box[0] / parts[0] * float(scale.scan[0, 0])
    runs = [box_weight(pixel + phase - along, widths[0]) for phase in _PHASES]
    turns = [box_weight(pixel + phase - scan, widths[1]) for phase in _PHASES]
    return np.stack([run @ turn.T for run in runs for turn in turns]) / len(along)


def box_weight(distance: Floats, width: float, held: int = 1) -> Floats:
    """Give the linear kernel averaged over a box and over ``held`` positions 1 px apart, at distances [px]."""
    places = np.arange(held) - (held - 1) / 2
    total = np.zeros(np.shape(distance))
    for place in places:
        beside = distance - place
        if width > 1e-6:
            total += (_integral(beside + width / 2) - _integral(beside - width / 2)) / width
        else:
            total += np.maximum(1 - np.abs(beside), 0.0)
    return np.maximum(total / held, 0.0)  # differences of integrals round


def blurred_weight(width: float, variance: Floats, held: int = 1, per_px: int = PER_PX) -> tuple[Floats, Floats]:
    """Give distances (place,) from -reach to reach and weights (kernel, place) with Gaussians of variance (kernel,)."""
    reach = math.ceil(1 + width / 2 + (held - 1) / 2 + _SDS * math.sqrt(variance.max(initial=0.0))) + 1
    distance = np.arange(-reach * per_px, reach * per_px + 1) / per_px
    sharp = box_weight(distance, width, held)
    if not variance.any():
        return distance, np.repeat(sharp[None], len(variance), axis=0)
    length = 2 * len(distance)
    wave = np.fft.rfftfreq(length, 1 / per_px)
    passed = np.exp(-2 * np.pi**2 * variance[:, None] * wave**2)
    blurred = np.fft.irfft(np.fft.rfft(sharp, length) * passed, length)[:, : len(distance)]
    return distance, np.where(variance[:, None] > 0, np.maximum(blurred, 0.0), sharp)


@dataclass(frozen=True)
class TapTable:
    """Weights (tap, row) of the taps around a position, row after row, for every kernel and in it for every scale.

    A position is told by its distance ``place`` from the first tap, which lies ``left`` px before the centre's pixel.
    """

    weight: Weights
    left: int
    first: float  # place of the first row of each scale
    least_scale: float
    scales: int
    rows: int  # of one scale

    @staticmethod
    def of(
        width: float, variance: Floats, held: int, scales: tuple[float, float], beside: float, tail: float = TAIL
    ) -> TapTable:
        """Tabulate kernels of a width and variances (kernel,), between two scales, up to ``beside`` px off centre."""
        least = (math.floor(scales[0] / SCALE_STEP) - 1) * SCALE_STEP
        count = math.ceil((scales[1] - least) / SCALE_STEP) + 2
        worked_out = range(0, count + _WORKED_OUT, _WORKED_OUT)
        sizes = [max(least + SCALE_STEP * number, 1e-3) for number in worked_out]
        found = [blurred_weight(width * size, variance * size**2, held) for size in sizes]
        reach = max(_reach(*one, tail) for one in found)
        off = 0.5 + beside
        left = math.floor(reach + off)
        taps = math.ceil(left + off + reach)
        place = left + np.arange(math.floor(-off * PER_PX), math.ceil(off * PER_PX) + 2) / PER_PX
        rows = [_rows(place, taps, reach, one).astype(np.float32) for one in found]
        joined = np.empty((taps, len(variance), count, len(place)), np.float32)
        for number in range(count):
            low, share = divmod(number, _WORKED_OUT)
            between = rows[low] + (rows[low + 1] - rows[low]) * np.float32(share / _WORKED_OUT)
            joined[:, :, number] = between.swapaxes(0, 1)
        return TapTable(joined.reshape(taps, -1), left, float(place[0]), least, count, len(place))

    @property
    def taps(self) -> int:
        """How many pixels along the axis a position reads."""
        return int(self.weight.shape[0])

    def scale_rows(self, scale: NDArray[np.floating]) -> NDArray[np.intp]:
        """Give the first row of the nearest scale of each kernel, (kernel, n) -> (kernel, 1, n)."""
        number = np.clip(np.rint((scale - self.least_scale) * (1 / SCALE_STEP)), 0, self.scales - 1).astype(np.intp)
        number += np.arange(len(scale))[:, None] * self.scales
        number *= self.rows
        return np.asarray(number[:, None])

    def read(self, off: Weights, scale_row: NDArray[np.intp]) -> Weights:
        """Give the weights (tap, kernel, part, n) of positions (kernel, part, n) ``off`` px beside their pixel."""
        row = (off + np.float32(self.left - self.first)) * np.float32(PER_PX)
        np.clip(row, 0, self.rows - 2, out=row)
        index = row.astype(np.intp)
        row -= index
        index += scale_row
        weight, beyond = (np.empty((self.taps, *off.shape), np.float32) for _ in range(2))
        np.take(self.weight, index, axis=1, out=weight, mode="clip")
        index += 1
        np.take(self.weight, index, axis=1, out=beyond, mode="clip")
        torch.from_numpy(weight).lerp_(torch.from_numpy(beyond), torch.from_numpy(row))
        return weight


def _rows(place: Floats, taps: int, reach: float, kernels: tuple[Floats, Floats]) -> Floats:
    """Weights (kernel, tap, place), scaled to sum 1 at every place."""
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
    """Integral of the kernel of linear interpolation from 0 to t."""
    a = np.minimum(np.abs(t), 1.0)
    return np.sign(t) * a * (1 - a / 2)
