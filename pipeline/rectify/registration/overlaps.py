"""Find overlaps of neighbouring sweeps: broad-band images of sweeps, and the windows that two of them share.

Places are (along, scan) in px from the undeflected direction, as in ``pipeline.geometry.scan``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import cuts
from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, shifted_position
from spectralzoom.pipeline.rectify.geolocation import path_geolocation
from spectralzoom.pipeline.rectify.resample import resample
from spectralzoom.pipeline.rectify.scan_paths import ScanPath, make_scan_paths
from spectralzoom.pipeline.signal.components import broad_weights
from spectralzoom.pipeline.signal.lines import BLOCK_LINES, CondensedLines

LEAST_OVERLAP_PX = 64.0  # of the smaller side of a window, after the largest shift; below it errors grow fast
EDGE_LINES = 16  # a sweep's edges are computed at every 16th line; they bend by 1e-3 px between


@dataclass(frozen=True)
class BroadSweep:
    """A sweep for registration: one image, the mean of 16 bands spread over all."""

    sweep: Sweep
    position: Floats  # (line, 2) mirror X and Y as reported
    usable: NDArray[np.bool_]  # (line,)
    image: NDArray[np.float32]  # (line, sample), NaN where a band is not valid

    @classmethod
    def read(cls, lines: CondensedLines, *, usable: NDArray[np.bool_]) -> BroadSweep:
        """Read a sweep's scores, 64 lines at a time; ``usable`` (line,) are lines with a trusted position."""
        usable = usable & np.isfinite(lines.position).all(axis=1)
        weights, offset = broad_weights(lines.components)
        image = np.full(lines.usable.shape, np.nan, np.float32)
        for part in cuts(len(usable), BLOCK_LINES):
            scores = lines.read(part.start, part.stop).astype(np.float32) * np.float32(lines.step)
            image[part] = np.where(lines.usable[part] & usable[part, None], scores @ weights + offset, np.nan)
        return cls(lines.sweep, lines.position, usable, image)


@dataclass(frozen=True)
class PlacedImage:
    """A broad-band image and the corrected places of its lines."""

    broad: BroadSweep
    camera: LineCamera
    shift_px: Floats  # (line, 2)

    @cached_property
    def position(self) -> Floats:
        """Return (usable line, 2) corrected mirror positions."""
        usable = self.broad.usable
        return shifted_position(self.broad.position[usable], self.shift_px[usable], self.camera)

    @cached_property
    def scan_paths(self) -> tuple[tuple[ScanPath, NDArray[np.float32]], ...]:
        """Return every scan path with its image, (knot, sample); lines at one place are averaged."""
        found = []
        for scan_path in make_scan_paths(
            self.broad.position,
            self.camera,
            usable=self.broad.usable,
            shift_px=self.shift_px,
            binning=self.broad.sweep.binning,
            step_px=self.broad.sweep.step,
        ):
            values: NDArray[np.float32] = self.broad.image[scan_path.lines]
            if len(scan_path.starts) < len(scan_path.lines):
                count = np.diff(scan_path.starts, append=len(scan_path.lines))
                values = (np.add.reduceat(values, scan_path.starts, axis=0) / count[:, None]).astype(np.float32)
            found.append((scan_path, np.where(scan_path.seen[:, None], values, np.float32(np.nan))))
        return tuple(found)

    def seen_at(self, along_px: Floats, scan_px: Floats) -> NDArray[np.float32]:
        """Rectify a window, (scan, along) float32; NaN where nothing was seen."""
        seen = np.full(len(scan_px) * len(along_px), np.nan, np.float32)
        for _, image, at in self._geolocations(along_px, scan_px):
            values, _ = resample(image[..., None], np.isfinite(image), at)
            seen = np.where(np.isnan(seen), values[:, 0], seen)
        return seen.reshape(len(scan_px), len(along_px))

    def _geolocations(
        self, along_px: Floats, scan_px: Floats
    ) -> Iterator[tuple[ScanPath, NDArray[np.float32], Floats]]:
        """Yield every scan path, its image, and the knot and sample of the places of a window, row by row."""
        sweep = self.broad.sweep
        scan, line = (values.ravel() for values in np.meshgrid(scan_px, along_px, indexing="ij"))
        points = np.stack([scan, line] if sweep.along == "x" else [line, scan], axis=-1)
        for scan_path, image in self.scan_paths:
            at = path_geolocation(scan_path, self.camera, points, along=sweep.along, binning=sweep.binning)
            yield scan_path, image, at

    def line_and_turn(self, along_px: float, scan_px: float) -> tuple[float, Floats] | None:
        """Return the line that sees a place, and the place's derivative (2, 2) by its centre; None off the sweep."""
        for scan_path, _, (at,) in self._geolocations(np.array([along_px]), np.array([scan_px])):
            if np.isfinite(at).all():
                line = int(scan_path.lines[scan_path.starts[int(np.clip(np.rint(at[0]), 0, len(scan_path.scan) - 1))]])
                return float(line), self._turn(line, float(at[1]))
        return None

    @cached_property
    def turn_at_middle(self) -> Floats:
        """Return the derivative (2, 2) of the place of the middle sample of the middle line by the line's centre."""
        usable = np.flatnonzero(self.broad.usable)
        return self._turn(int(usable[len(usable) // 2]), (self.broad.image.shape[1] - 1) / 2)

    def _turn(self, line: int, sample: float) -> Floats:
        slope = (sample + 0.5) * self.broad.sweep.binning - self.camera.samples / 2
        steps = np.array([[0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
        position = shifted_position(self.broad.position[line], self.shift_px[line] + steps, self.camera)
        seen = places_seen(position, np.array([slope]) * self.camera.ifov_rad, self.camera)[:, 0]
        return np.stack([seen[0] - seen[1], seen[2] - seen[3]], axis=1)

    @cached_property
    def edges(self) -> Floats:
        """Return the places of both ends of every 16th line, (end, line, 2) along and scan, by ascending scan [px]."""
        count = len(self.position)
        lines = np.unique(np.append(np.arange(0, count, EDGE_LINES), max(count - 1, 0)))[:count]
        half = self.camera.samples // self.broad.sweep.binning * self.broad.sweep.binning
        ends = (np.array([0.0, half]) - self.camera.samples / 2) * self.camera.ifov_rad
        seen = places_seen(self.position[lines], ends, self.camera).swapaxes(0, 1)
        return np.stack([end[np.argsort(end[:, 1], kind="stable")] for end in seen])


@dataclass(frozen=True)
class Window:
    """A rectangle that two sweeps should both have seen, after the largest possible shift."""

    reference: int
    moving: int
    along_px: tuple[float, float]
    scan_px: tuple[float, float]

    @property
    def width_px(self) -> float:
        """Return the smaller side."""
        return min(self.along_px[1] - self.along_px[0], self.scan_px[1] - self.scan_px[0])


def places_seen(position: Floats, slopes: Floats, camera: LineCamera) -> Floats:
    """Return places along and scan of rays with some slopes from some mirror positions, (position, slope, 2) [px]."""
    rays = np.stack([np.zeros_like(slopes), slopes, np.ones_like(slopes)], axis=-1)
    return direction_to_scene(reflect(rays, position_to_normal(position)[:, None])) / camera.ifov_rad


def overlap_windows(images: Sequence[PlacedImage], *, window_px: float) -> list[Window]:
    """Cut the overlaps of all pairs of sweeps into windows of at most ``window_px`` along the scan.

    A window is as wide as both sweeps reach along all of it; narrow ones are included.
    """
    seen = [number for number, image in enumerate(images) if image.broad.usable.any()]
    return [
        window
        for place, one in enumerate(seen)
        for other in seen[place + 1 :]
        if images[one].broad.sweep.along == images[other].broad.sweep.along
        for window in _pair_windows(images, one, other, window_px)
    ]


def _pair_windows(images: Sequence[PlacedImage], one: int, other: int, window_px: float) -> Iterator[Window]:
    edges = [images[number].edges for number in (one, other)]
    low = max(float(edge[..., 1].min()) for edge in edges)
    high = min(float(edge[..., 1].max()) for edge in edges)
    cuts = np.linspace(low, high, max(int(np.ceil((high - low) / window_px)), 0) + 1)
    for start, stop in zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True):
        probes = np.linspace(start, stop, 5)
        reach = [[np.interp(probes, end[:, 1], end[:, 0]) for end in edge] for edge in edges]
        left = max(float(ends[0].max()) for ends in reach)
        right = min(float(ends[1].min()) for ends in reach)
        if right > left:
            yield Window(one, other, (left, right), (start, stop))
