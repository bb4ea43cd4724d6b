"""Light through a footprint: for every sample one window of pixels, and for every kernel a weight for each of them.

A footprint that lies turned in the scene is parted across the slit. Each part is a box parallel to the scene's axes, in
its right place. The parts are moved beside their places, and widened, by so much that all together have the second
moments of the turned footprint. There are as few as misplace little of its light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.simulator import compiled_loops
from pipeline.simulator.optics.kernel_fit import TAIL, Footprint, Moments, TapTable, box_weight, disc_points, fold
from pipeline.simulator.optics.rays import RayViews

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
Parts = tuple[int, int]
LADDER: tuple[Parts, ...] = ((1, 1), (2, 1), (3, 1), (5, 2), (9, 3))  # across and along; the last is taken as exact
_FINER = (18, 6)  # than any; what they are held against
_PHASES = (0.0, 0.5)  # of the pixels, along either axis
TABULATED = 2e-5  # fraction of the light, by size, that a table of either axis misplaces at most, but for what follows


@dataclass(frozen=True)
class ScenePixels:
    """A scene's planes (y, x, component), C-contiguous float32, and whether lines lie along y."""

    planes: Radiance
    along_y: bool


class Gatherer:
    """Gathers a scene's components through a footprint at views whose shape is within a range."""

    def __init__(self, footprint: Footprint, views: RayViews) -> None:
        """Take ``views`` that include the extremes of all that will be gathered."""
        self.footprint = footprint
        width, (across, along) = footprint.box, footprint.parts
        variance = footprint.variance + disc_points(footprint.disc)[1][:, None]
        scale, off = place_parts(footprint, views)
        reach = np.abs(off).max(axis=(0, 2, 3), initial=0.0) + 0.02
        ranges = [(float(one.min()), float(one.max())) for one in scale.swapaxes(0, 1)]
        tail = TAIL / float(footprint.fractions.max(initial=0.0) or 1.0)
        self._kernels = kernels_of(footprint)
        self._along = TapTable.of(width[1] / along, variance[0], 1, ranges[0], float(reach[0]), tail)
        self._scan = TapTable.of(width[0] / across, variance[1], footprint.held, ranges[1], float(reach[1]), tail)

    @property
    def parts(self) -> int:
        """Return the number of boxes that each kernel is summed over."""
        return int(self._kernels.place.shape[1])

    def gather(
        self, pixels: ScenePixels, views: RayViews, out: Radiance, numbers: NDArray[np.intp], gains: Radiance
    ) -> None:
        """Add the components that some samples see through every kernel to ``out`` (number, n, component).

        They are sums over the parts, times ``gains`` (kernel, component). ``views`` are in px of the pixels,
        ``numbers`` (kernel,) where in ``out`` kernels belong. A sample's light does not depend on the others.
        """
        (rows, columns, components), along_y = pixels.planes.shape, pixels.along_y
        raster = compiled_loops.PixelTable(columns, rows, components, along_y)
        table = views.table()
        compiled_loops.gather_windows(
            pixels.planes.reshape(-1), raster, table, self._kernels, self._along, self._scan, numbers, gains, out
        )


def kernels_of(footprint: Footprint) -> compiled_loops.PartedKernels:
    """Return a footprint's kernels and the parts of its box as the compiled loops take them."""
    (across, along), (slit, pixel) = footprint.parts, footprint.box
    variance = footprint.variance + np.array([[pixel / along], [slit / across]]) ** 2 / 12
    points, about = disc_points(footprint.disc)
    variance = np.array(variance + about[:, None], order="C")
    between = slit**2 / 12 * (1 - 1 / across**2) + float((points[1] ** 2).mean())
    shift = np.array(footprint.shift, np.float32, order="C")
    return compiled_loops.PartedKernels(shift, variance, between, part_places(footprint))


def place_parts(footprint: Footprint, views: RayViews) -> tuple[Floats, Radiance]:
    """Return the places of the parts of kernels for samples in the middle of a pixel, along and scan.

    Returns scales of one part (kernel, 2, n), and how far beside the pixel parts lie, (kernel, 2, part, n) [px].
    """
    kernels, count = kernels_of(footprint), len(views.along)
    scale = np.empty((footprint.kernels, 2, count))
    off = np.empty((footprint.kernels, 2, kernels.place.shape[1], count), np.float32)
    table, beside = views.table(), np.zeros((2, count), np.float32)
    for kernel in range(footprint.kernels):
        compiled_loops.place_parts(table, beside, kernel, kernels, scale[kernel], off[kernel])
    return scale, off


def part_places(footprint: Footprint) -> Radiance:
    """Return the middles of the parts, (2, part) across and along, in px of the camera: of boxes at a disc's points."""
    across, along = footprint.parts
    turn = ((np.arange(across) + 0.5) / across - 0.5) * footprint.box[0]
    run = ((np.arange(along) + 0.5) / along - 0.5) * footprint.box[1]
    boxes, points = np.stack([np.repeat(turn, along), np.tile(run, across)]), disc_points(footprint.disc)[0][::-1]
    return (boxes[:, :, None] + points[:, None]).reshape(2, -1).astype(np.float32)


def fewest_parts(fraction: float, box: tuple[float, float], views: RayViews) -> Parts:
    """Return the fewest boxes that misplace at most a ``fraction`` of the light where views are turned most.

    ``box`` is across and along [px]. A blur, or held positions, make the fraction smaller.
    """
    turn, run = np.abs(views.along_turn), np.abs(views.scan_run)
    most = {int(one.argmax()) for one in (turn, run, turn * box[0] ** 2 + run * box[1] ** 2)}
    columns = views.along_run, views.scan_run, views.along_turn, views.scan_turn
    shapes = [tuple(float(one[number]) for one in columns) for number in sorted(most)]
    kept = (parts for parts in LADDER if all(misplaced(parts, box, shape) <= fraction for shape in shapes))
    return next(kept, LADDER[-1])


@lru_cache(maxsize=256)
def misplaced(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> float:
    """Return the fraction of light, by size, that so many boxes put elsewhere than the turned footprint does.

    ``shape`` is px of the scene along and scan per px of the camera along the line, then across it. Half of the
    fraction times the range of a scene within the footprint is the most that a sample changes.
    """
    apart = np.abs(_weights(parts, box, shape) - _weights(_FINER, box, shape))
    return float(apart.sum(axis=(1, 2)).max())


def _weights(parts: Parts, box: tuple[float, float], shape: tuple[float, ...]) -> Floats:
    """Return the weights (phase, along, scan) of the pixels around a sample, in closed form."""
    none, views = np.zeros((2, 1)), RayViews(*(np.array([one]) for one in (0.0, 0.0, *shape)))
    footprint: Footprint = fold(box, parts, 1, Moments(none, none))
    scale, places = place_parts(footprint, views)
    along, scan = places[0, :, :, 0].astype(np.float64)
    reach = math.ceil((1 + max(map(abs, shape))) * sum(box)) + 3
    pixel = np.arange(-reach, reach + 1)[:, None]
    widths = box[1] / parts[1] * float(scale[0, 0, 0]), box[0] / parts[0] * float(scale[0, 1, 0])
    runs = [box_weight(pixel + phase - along, widths[0]) for phase in _PHASES]
    turns = [box_weight(pixel + phase - scan, widths[1]) for phase in _PHASES]
    return np.stack([run @ turn.T for run in runs for turn in turns]) / len(along)
