"""One track's values at points, from no more raw lines and samples than they need, and their blend with others'.

Raw lines are kept while neighbouring tiles still need them: blocks of whole shards, least recently used out first.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.rectify.calibrate import calibrate
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.placed import TAPS, Placed, member_lines
from pipeline.rectify.resample import merge_lines, resample
from pipeline.rectify.scan_paths import ScanPath
from pipeline.source import SweepLines

BLOCK_LINES = 64  # a shard of a stored sweep: reading one line of it costs as much as reading all
CHUNK_SAMPLES = 32  # likewise across

_Key = tuple[int, int, int, int]  # sweep, block, samples held
Raw = NDArray[np.uint16]
ReadWindow = Callable[[slice, slice], Raw]  # (lines, samples) -> (line, sample, band)
LEAST_EDGE_PX = 1e-3  # the very edge of a sweep counts where nothing else reaches
RUN_ELEMENTS = 250_000  # what one more window costs, in elements (sample and band of a line) calibrated
BLOCK_POINTS = 1024  # what is mixed at once stays in cache


@runtime_checkable
class WindowedLines(Protocol):
    """A sweep that can be read a part of its samples at a time."""

    def read_window(self, lines: slice, samples: slice) -> Raw:
        """Raw numbers of some lines and samples, (line, sample, band)."""


@dataclass
class _Block:
    """One block of one sweep: its raw numbers once read, None before, and what threads wait on for them."""

    lines: SweepLines  # held so that its id stays its own
    raw: Raw | None = None
    reading: threading.Lock = field(default_factory=threading.Lock)


class LineCache:
    """Blocks of 64 raw lines of any number of sweeps, at most ``most_bytes`` of them. Threads may share it.

    Two threads that want the same block wait for one read. ``reads`` counts blocks read, ``bytes_held`` what is kept.
    """

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.reads = 0
        self.bytes_held = 0
        self._blocks: OrderedDict[_Key, _Block] = OrderedDict()
        self._lock = threading.Lock()

    def window(self, lines: SweepLines, wanted: slice, samples: slice, *, likely: slice | None = None) -> Raw:
        """Give raw numbers (line, sample, band) of some lines and samples, read before or now; not to be written to.

        ``likely`` are samples that later calls will want of the same lines: they are read together, and only calls that
        name the same ones share what was read.
        """
        held = held_samples(lines, samples, likely)
        within = slice(samples.start - held.start, samples.stop - held.start)
        parts = []
        for number in line_blocks(wanted):
            origin = number * BLOCK_LINES
            rows = slice(max(wanted.start - origin, 0), min(wanted.stop - origin, BLOCK_LINES))
            parts.append(self._block(lines, number, held)[rows, within])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _block(self, lines: SweepLines, number: int, samples: slice) -> Raw:
        key = (id(lines), number, samples.start, samples.stop)
        with self._lock:
            block = self._blocks.setdefault(key, _Block(lines))
            self._blocks.move_to_end(key)
        with block.reading:
            if block.raw is None:
                rows = slice(number * BLOCK_LINES, min((number + 1) * BLOCK_LINES, len(lines.valid_line)))
                if isinstance(lines, WindowedLines):
                    raw = lines.read_window(rows, samples)
                else:
                    raw = lines.read(rows.start, rows.stop)
                with self._lock:
                    block.raw = raw
                    self.reads += 1
                    self.bytes_held += raw.nbytes
                    for old, held in list(self._blocks.items()):  # the newest and those still being read stay
                        if self.bytes_held > self.most_bytes and old != key and held.raw is not None:
                            self.bytes_held -= held.raw.nbytes
                            del self._blocks[old]
            return block.raw


def line_blocks(lines: slice) -> range:
    """Numbers of the blocks that hold some lines."""
    return range(lines.start // BLOCK_LINES, -(-lines.stop // BLOCK_LINES))


def held_samples(lines: SweepLines, samples: slice, likely: slice | None = None) -> slice:
    """Samples to read and hold: those wanted and likely, in whole chunks; all of a sweep read by whole lines."""
    count = lines.references.dark.shape[0]
    if not isinstance(lines, WindowedLines):
        return slice(0, count)
    other = samples if likely is None else likely
    first, stop = min(samples.start, other.start), max(samples.stop, other.stop)
    return slice(first // CHUNK_SAMPLES * CHUNK_SAMPLES, min(-(-stop // CHUNK_SAMPLES) * CHUNK_SAMPLES, count))


@dataclass(frozen=True)
class MosaicPart:
    """One sweep on the mosaic's pixels: (n, band) values, (n,) weight of the resampling, (n,) distance to its edge.

    A point of weight 0 has no value at all; one of more may still be NaN in single bands.
    """

    values: NDArray[np.float32]
    weight: NDArray[np.float32]
    edge_px: NDArray[np.float64]


def edge_distance(coordinates: NDArray[np.float64], lines: int, samples: int) -> NDArray[np.float64]:
    """Distance of (..., 2) geolocation grid coordinates to the nearest edge of their sweep, (...) [px of it]; NaN off it."""
    line, sample = coordinates[..., 0], coordinates[..., 1]
    down = np.minimum(line + 0.5, lines - 0.5 - line)
    across = np.minimum(sample + 0.5, samples - 0.5 - sample)
    return np.minimum(down, across)


def mosaic(parts: Sequence[MosaicPart]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Blend sweeps, resampled at the same n points, by weights that grow linearly from each sweep's edge.

    The weights are the same for all bands, so every spectrum is a convex mixture of captured ones; only a band that a
    sweep has no value in is the others' alone. One sweep alone comes back unchanged, bit by bit (it may be the very
    array that went in). What a part holds where its weight is 0 does not matter.

    (n, band) float32, NaN where no sweep reached, and (n,) how many sweeps did.
    """
    reached = [part.weight > 0 for part in parts]
    coverage: NDArray[np.intp] = np.sum(reached, axis=0, dtype=np.intp)
    for part, here in zip(parts, reached, strict=True):
        if here.all() and (coverage == 1).all():
            return part.values, coverage
    blended = np.empty(parts[0].values.shape, np.float32)
    blended[coverage == 0] = np.nan
    for part, here in zip(parts, reached, strict=True):
        alone = np.flatnonzero(here & (coverage == 1))
        blended[alone] = part.values[alone]
    _blend_shared(blended, parts, np.flatnonzero(coverage > 1))
    return blended, coverage


def _blend_shared(blended: NDArray[np.float32], parts: Sequence[MosaicPart], points: NDArray[np.intp]) -> None:
    """Write the mixtures at ``points``, which several parts reach."""
    weight = np.stack([part.weight[points] for part in parts])
    edge = np.stack([part.edge_px[points] for part in parts])
    fractions = np.where(weight > 0, weight * np.maximum(np.nan_to_num(edge), LEAST_EDGE_PX), 0.0)
    total = reduce(np.add, fractions)  # part by part: ndarray.sum takes another order where there is one point alone
    weights = (fractions / total).astype(np.float32)
    for first in range(0, len(points), BLOCK_POINTS):
        block = points[first : first + BLOCK_POINTS]
        mixed = np.zeros((len(block), blended.shape[1]), np.float32)
        for part, weight in zip(parts, weights[:, first : first + BLOCK_POINTS], strict=True):
            here = np.flatnonzero(weight)
            mixed[here] += part.values[block[here]] * weight[here, None]
        torn = np.flatnonzero(np.isnan(mixed).any(axis=1))
        if len(torn):
            mixed[torn] = _by_band(parts, weights[:, first + torn], block[torn])
        blended[block] = mixed


def _by_band(
    parts: Sequence[MosaicPart], weights: NDArray[np.floating], points: NDArray[np.intp]
) -> NDArray[np.floating]:
    """Mixtures at points where a part has no value in some bands: there the others count alone."""
    values = np.stack([part.values[points] for part in parts])
    counts = np.where(np.isnan(values), 0, weights[..., None])
    total = reduce(np.add, counts)
    mixed = np.where(counts > 0, values, 0) * counts
    found: NDArray[np.floating] = np.full(total.shape, np.nan)
    np.divide(reduce(np.add, mixed), total, out=found, where=total > 0)
    return found


@dataclass(frozen=True)
class LocatedSweep:
    """A track and the (..., 2) knots and samples at which it saw some points, NaN off it."""

    placed: Placed
    scan_path: ScanPath
    coordinates: NDArray[np.float64]
    read: ReadWindow


def read_part(
    observation: LocatedSweep, coordinates: NDArray[np.float64], camera: LineCamera, kernel: Kernel
) -> MosaicPart | None:
    """Calibrate and resample one track at geolocation grid coordinates (n, 2); None where it reaches none of them.

    Lines that are not valid or that nothing saw, saturated and uncalibrated elements count nothing; where they leave
    less than half of a kernel's weight the point is NaN with weight 0. The result at a point does not depend on the
    other points.
    """
    box = _boxes(coordinates[None])[0]
    if np.isnan(box[0]):
        return None
    lines, scan_path = observation.placed.lines, observation.scan_path
    count = lines.references.dark.shape[0]
    elements = observation.placed.elements
    knots, samples = _span(box[0], box[1], len(scan_path)), elements.alone(_span(box[2], box[3], count))
    members = member_lines(scan_path, knots)
    values, valid = calibrate(
        _raw_of(observation.read, members, samples),
        elements.part(samples),
        saturated_dn=camera.full_scale_dn * lines.sweep.binning,
        position=lines.position[members],
    )
    starts = scan_path.starts[knots] - scan_path.starts[knots.start]
    usable = lines.valid_line[members] & np.repeat(scan_path.seen[knots], np.diff(starts, append=len(members)))
    if not usable.all():
        valid = valid & usable.reshape(-1, *[1] * (valid.ndim - 1))
    if len(starts) < len(members):
        values, valid = merge_lines(values, valid, starts)
    values_at, weight = resample(values, valid, coordinates - np.array([knots.start, samples.start]), kernel)
    return MosaicPart(values_at, weight, edge_distance(coordinates, len(scan_path), count))


def cut_runs(observation: Sequence[NDArray[np.float64]], bands: int) -> list[slice]:
    """Cut groups of points into runs (slices, in order) such that little is calibrated that no point needs.

    Where lines are turned against the grid, the lines and samples behind a long run of pixels are many times as many
    as the pixels; short runs have less beside, but each has a price of its own. ``observation`` holds the (group, n, 2)
    geolocation grid coordinates of each track.
    """
    boxes = np.stack([_boxes(coordinates) for coordinates in observation])

    def price(
        run: slice,
    ) -> float:  # elements to calibrate, and what a run costs by itself; none where no track reaches
        low = np.fmin.reduce(boxes[:, run][:, :, [0, 2]], axis=1)  # NaN aside
        high = np.fmax.reduce(boxes[:, run][:, :, [1, 3]], axis=1)
        return float(np.nansum(np.prod(high - low + 2 * TAPS, axis=1) * bands + RUN_ELEMENTS))

    def cut(run: slice) -> list[slice]:
        if run.stop - run.start == 1:
            return [run]
        middle = (run.start + run.stop) // 2
        # both halves first: one cut may gain nothing by itself, as where two sweeps meet, and those within them much
        parts = cut(slice(run.start, middle)) + cut(slice(middle, run.stop))
        return parts if sum(map(price, parts)) < price(run) else [run]

    return cut(slice(0, boxes.shape[1]))


def _boxes(coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
    """First and last knot, first and last sample of each group, (group, 4); NaN where the track reaches none of it."""
    flat = coordinates.reshape(len(coordinates), -1, 2)
    edges = []
    for place in (flat[..., 0].copy(), flat[..., 1].copy()):  # minima of what lies side by side are ten times as fast
        off = np.isnan(place)
        for extreme, away in ((np.min, np.inf), (np.max, -np.inf)):
            edge = extreme(np.where(off, away, place) if off.any() else place, axis=1)
            edges.append(np.where(np.isinf(edge), np.nan, edge))
    return np.stack(edges, axis=1)


def _span(low: float, high: float, size: int) -> slice:
    """Whole pixels from low to high with the kernel's taps, within 0..size."""
    return slice(max(int(np.floor(low)) - TAPS, 0), min(int(np.ceil(high)) + TAPS + 1, size))


def _raw_of(read: ReadWindow, members: NDArray[np.intp], samples: slice) -> Raw:
    """Raw numbers of the lines ``members``, in their order."""
    first, last = int(members.min()), int(members.max()) + 1
    raw = read(slice(first, last), samples)
    if last - first == len(members):
        if (np.diff(members) == 1).all():
            return raw
        if (np.diff(members) == -1).all():
            return raw[::-1]
    return raw[members - first]
