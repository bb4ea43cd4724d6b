"""Where a scene is steepest, most curved, brightest and darkest, in a few telling bands: the places worth a close look.

Works on the scene's own pixels, strip by strip, with the slit's box along the scan; it is fast and right to a pixel,
and leaves the exact numbers to whoever looks closer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera, footprint_kernel
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from pipeline.geometry.scan import Sweep, scene_to_sweep
from pipeline.simulator.optics.kernel_fit import Footprint
from pipeline.simulator.optics.rays import RayViews, exact_views
from pipeline.simulator.optics.scene_light import Looker
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands

Light = NDArray[np.float32]
TELLING_BANDS = 4
_TILES = 8192  # at most about so many, each of which offers its best place
_CELLS = 40_000  # at which it is asked whether a sweep looks there
_LEAST_WEIGHT = 1e-3  # of a kernel's tap: enough to find places
Floats = NDArray[np.float64]
Way = tuple[float, float]
LINE_SAMPLES = 64  # of a line, evenly from end to end, in sums where samples are summed
_LEAST_SUMS = 16  # of a line
_BESIDE = 2  # samples to either side of a place; of sums, one


@dataclass(frozen=True)
class _Optics:
    """Kernels of slit and pixel over a scene's pixels, and the part of the noise that light does not change [e-^2]."""

    slit: NDArray[np.float32]
    pixel: NDArray[np.float32]
    fixed_noise: float
    binning: int

    @property
    def halo(self) -> int:
        """How far kernels, differences and sums reach. [px]"""
        return len(self.slit) // 2 + len(self.pixel) // 2 + 1 + self.binning // 2

    def summed(self, values: Light, axis: int) -> Light:
        """Mean over the samples of a stored number about each pixel, along an axis."""
        if self.binning == 1:
            return values
        steps = np.arange(self.binning) - self.binning // 2
        total: Light = sum((np.roll(values, -step, axis) for step in steps.tolist()), np.zeros_like(values))
        total /= np.float32(self.binning)
        return total


def telling_places(
    scene: RasterScene, camera: LineCamera, sweeps: Sequence[Sweep], most: int = 200
) -> NDArray[np.float64]:
    """Find the places where light changes most over its noise, and where there is most and least of it.

    Only where ``sweeps``, all of one binning, look; at most ``most``, each in a tile of its own for one measure and
    band, the worst of every measure first. Returns (place, 2) rows and columns, integers as floats. [px] Raises
    SceneError: the scene holds a number that is not finite.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    bands, fixed = telling_bands(spectra), camera.read_noise_e**2 + camera.electrons_per_dn**2 / 12
    optics = _Optics(_short_kernel(camera.slit_px), _short_kernel(1.0), fixed, sweeps[0].binning)
    turned = tuple(sorted({sweep.along == "y" for sweep in sweeps}))
    reached, cell = _reached(scene.shape, camera, sweeps)
    tile = max(8, math.ceil(math.sqrt(scene.shape[0] * scene.shape[1] / _TILES)))
    best: dict[tuple[int, int], list[tuple[float, int, int]]] = {}
    for first, planes in _strips(scene, tile, optics.halo):
        _check_finite(scene, planes, first - optics.halo)
        rows = np.arange(first, min(first + tile, scene.shape[0])) // cell
        taken = np.repeat(reached[rows], cell, axis=1)[:, : scene.shape[1]]
        if not taken.any():
            continue
        own_planes = spectra.ndim == 1
        some = spectra[bands] if own_planes else np.ascontiguousarray(spectra[:, bands])
        light = to_bands(planes[..., bands] if own_planes else planes, some)
        for sort, worth in enumerate(_worths(light, optics, turned)):
            for band in range(worth.shape[2]):
                shown = np.where(taken, worth[..., band], -np.inf)
                best.setdefault((sort, band), []).extend(_tile_maxima(shown, first, tile))
    ranked = [[one[1:] for one in sorted(places, reverse=True) if one[0] > -np.inf] for places in best.values()]
    found = dict.fromkeys(place for rank in zip_longest(*ranked) for place in rank if place is not None)
    return np.array(list(found)[:most], np.float64).reshape(-1, 2)


def _reached(shape: tuple[int, int], camera: LineCamera, sweeps: Sequence[Sweep]) -> tuple[NDArray[np.bool_], int]:
    """Give which square cells of the scene any sweep sees, and their size [px]."""
    cell = max(2, math.ceil(math.sqrt(shape[0] * shape[1] / _CELLS)))
    y, x = (np.arange(0, size, cell) + (cell - size) / 2 for size in shape)
    reached = np.zeros((len(y), len(x)), np.bool_)
    for sweep in sweeps:
        along, scan = (y[:, None], x[None]) if sweep.along == "y" else (x[None], y[:, None])
        held = replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)
        line, sample = np.moveaxis(scene_to_sweep(held, camera, along, scan), -1, 0)
        slack = 1 + cell / 2
        reached |= (np.abs(line - (held.lines - 1) / 2) <= held.lines / 2 + slack) & (
            np.abs(sample - (camera.samples - 1) / 2) <= camera.samples / 2 + slack
        )
    return reached, cell


def telling_bands(spectra: Light) -> NDArray[np.intp]:
    """Choose the brightest band and those least like the ones chosen, at most ``TELLING_BANDS``."""
    columns = np.atleast_2d(spectra) if spectra.ndim == 2 else spectra[None]
    if spectra.ndim == 1:  # every band has a plane of its own, which says nothing of its kin: spread them
        return np.unique(np.linspace(0, len(spectra) - 1, TELLING_BANDS).round().astype(np.intp))
    chosen = [int(columns.max(axis=0).argmax())]
    for _ in range(min(TELLING_BANDS, columns.shape[1]) - 1):
        gap = np.min([np.abs(columns - columns[:, [one]]).max(axis=0) for one in chosen], axis=0)
        chosen.append(int(gap.argmax()))
    return np.unique(chosen)


def _strips(scene: RasterScene, tile: int, halo: int) -> Iterator[tuple[int, Light]]:
    rows = scene.shape[0]
    for first in range(0, rows, tile):
        down = np.arange(first - halo, min(first + tile, rows) + halo).clip(0, rows - 1)
        inner = scene.planes[down[0] : down[-1] + 1][down - down[0]]
        yield first, np.pad(inner, ((0, 0), (halo, halo), (0, 0)), mode="edge")


def _check_finite(scene: RasterScene, planes: Light, first: int) -> None:
    with np.errstate(invalid="ignore", over="ignore"):  # infinity less infinity: found out below
        if np.isfinite(planes.sum(dtype=np.float64)):
            return
    row, column, component = np.argwhere(~np.isfinite(planes))[0].tolist()
    row = min(max(first + row, 0), scene.shape[0] - 1)
    column = min(max(column - (planes.shape[1] - scene.shape[1]) // 2, 0), scene.shape[1] - 1)
    raise SceneError(
        f"scene {scene.name} is not finite at row {row}, column {column}, component {component};"
        " fill such pixels before it is simulated"
    )


def _worths(light: Light, rig: _Optics, turned: tuple[bool, ...]) -> Iterator[Light]:
    """Measures of the strip without its halo, (row, column, band) each: the higher, the more worth a look.

    Where samples are summed, sizes are averaged along the line, as the probe does.
    """
    inner = (slice(rig.halo, -rig.halo), slice(rig.halo, -rig.halo))
    for along_y in turned:
        line = 0 if along_y else 1
        seen = _blurred(_blurred(light, rig.slit, 1 - line), rig.pixel, line)
        level = rig.summed(seen, line)[inner]
        noise: Light = np.sqrt(np.maximum(level, 0) + np.float32(rig.fixed_noise))
        yield level
        yield -level
        yield rig.summed(np.abs(light - seen), line)[inner] / noise
        for axis in (0, 1):
            ahead, behind = np.roll(seen, -1, axis), np.roll(seen, 1, axis)
            yield rig.summed(np.abs(ahead - behind), line)[inner] / noise
            yield rig.summed(np.abs(ahead + behind - 2 * seen), line)[inner] / noise
        rise: Light = np.roll(seen, -1, 0) - np.roll(seen, 1, 0)
        mixed = np.abs(np.roll(rise, -1, 1) - np.roll(rise, 1, 1))  # what a box that does not lie turned misses
        yield np.divide(rig.summed(mixed, line)[inner], noise)


def _short_kernel(width_px: float) -> NDArray[np.float32]:
    kernel = footprint_kernel(width_px) if width_px > 0 else np.ones(1)
    half = len(kernel) // 2
    reach = int(np.abs(np.flatnonzero(np.abs(kernel) > _LEAST_WEIGHT) - half).max())
    return kernel[half - reach : half + reach + 1].astype(np.float32)


def _blurred(light: Light, kernel: NDArray[np.float32], axis: int) -> Light:
    half = len(kernel) // 2
    total: Light = kernel[half] * light
    for offset in range(1, half + 1):  # kernels are symmetric
        total += kernel[half + offset] * (np.roll(light, offset, axis) + np.roll(light, -offset, axis))
    return total


def _tile_maxima(worth: Light, first: int, tile: int) -> list[tuple[float, int, int]]:
    columns = worth.shape[1]
    best_row = worth.argmax(axis=0)
    ridge = worth[best_row, np.arange(columns)]
    found = []
    for start in range(0, columns, tile):
        column = start + int(ridge[start : start + tile].argmax())
        found.append((float(ridge[column]), first + int(best_row[column]), column))
    return found


@dataclass(frozen=True)
class SampleViews:
    """Samples at any place of any sweep, (view,) each: the line's centre and the camera's slope.

    ``binning`` in a row are the samples of one stored number.
    """

    strip_px: Floats
    scan_px: Floats
    slope: Floats
    along_y: NDArray[np.bool_]
    sweep: NDArray[np.intp]  # number of the sweep
    binning: int = 1

    @property
    def sums(self) -> int:
        return len(self.slope) // self.binning

    def chosen(self, which: NDArray[np.intp]) -> SampleViews:
        some: dict[str, Any] = {name: getattr(self, name)[which] for name in _OF_A_VIEW}
        return replace(self, **some)

    def chosen_sums(self, which: NDArray[np.intp]) -> SampleViews:
        return self.chosen((which[:, None] * self.binning + np.arange(self.binning)).ravel())


_OF_A_VIEW = tuple(one.name for one in fields(SampleViews) if one.name != "binning")


def joined(parts: list[SampleViews]) -> SampleViews:
    """Put views of one binning one after the other."""
    every: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in parts]) for name in _OF_A_VIEW}
    return replace(parts[0], **every)


def light_seen(
    scene: RasterScene,
    camera: LineCamera,
    views: SampleViews,
    footprint: Footprint,
    shifts: Sequence[tuple[Way, Way]] = (((0.0, 0.0), (0.0, 0.0)),),
) -> Light:
    """Light (shift, view, band) through a footprint, with rays turned and points moved (along, scan) by shifts [px]."""
    exposures, ifov = camera.exposure_ms / DEFAULT_EXPOSURE_MS, camera.ifov_rad
    light = np.empty((len(shifts), len(views.slope), len(scene.wavelength_nm)), np.float32)
    for along_y in (False, True):
        which = np.flatnonzero(views.along_y == along_y)
        if not which.size:
            continue
        some = views.chosen(which)
        looker = Looker(footprint, rays_of(some, camera))
        size = scene.shape if along_y else scene.shape[::-1]
        for number, (turned, moved) in enumerate(shifts):
            seen = rays_of(some, camera, turned)
            along, scan = seen.along / ifov + moved[0], seen.scan / ifov + moved[1]
            placed = replace(seen, along=along + (size[0] - 1) / 2, scan=scan + (size[1] - 1) / 2)
            light[number, which] = looker.look(scene, [placed], along_y=along_y, exposures=exposures)
    return light


def rays_of(views: SampleViews, camera: LineCamera, turned: Way = (0.0, 0.0)) -> RayViews:
    """Give the middle rays of samples, moved by (along, across) px of the camera, in tangents."""
    ifov = camera.ifov_rad
    tangents = np.stack([views.strip_px, views.scan_px], axis=-1) * ifov
    normal = direction_to_normal(scene_to_direction(tangents))
    return exact_views(normal, turned[1] * ifov, views.slope + turned[0] * ifov)


def line_sums(camera: LineCamera, binning: int) -> int:
    """Give how many stored numbers of a line stand for all of it."""
    return min(camera.samples // binning, max(LINE_SAMPLES // binning, _LEAST_SUMS))


def patch_views(binning: int) -> int:
    """Give how many samples a patch around a place has."""
    return len(_patch(binning)) * binning


def views_of_lines(sweeps: tuple[Sweep, ...], camera: LineCamera, room: int) -> SampleViews:
    """Lines spread over all sweeps, the most oblique among them, of samples evenly from end to end.

    All sweeps sum as many samples to a number.
    """
    order = {id(sweep): place for place, sweep in enumerate(sweeps)}
    binning = sweeps[0].binning
    numbers = [(sweep, number) for sweep in sweeps for number in {0, sweep.lines // 2, sweep.lines - 1}]
    numbers.sort(key=lambda one: -float(np.hypot(one[0].strip_px, one[0].line_px()[one[1]])))
    most = max(room // (line_sums(camera, binning) * binning), 1)
    kept = numbers[: most // 2 or 1]
    rest = [(sweep, round(share * (sweep.lines - 1))) for sweep in sweeps for share in (0.25, 0.75)]
    rest += numbers[len(kept) :]
    kept += [rest[round(at)] for at in np.linspace(0, len(rest) - 1, most - len(kept))] if most > len(kept) else []
    sums = np.linspace(0, camera.samples // binning - 1, line_sums(camera, binning)).round().astype(np.intp)
    slopes = camera.pixel_slopes()[_samples_of(sums, binning)]
    count = len(slopes)
    return SampleViews(
        np.repeat([sweep.strip_px for sweep, _ in kept], count).astype(np.float64),
        np.repeat([sweep.line_px()[number] for sweep, number in kept], count),
        np.tile(slopes, len(kept)),
        np.repeat([sweep.along == "y" for sweep, _ in kept], count),
        np.repeat([order[id(sweep)] for sweep, _ in kept], count),
        binning,
    )


def views_of_places(places: Floats, scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...]) -> SampleViews:
    """Patches around places, each as the finest and the most oblique sweep of each orientation see it.

    All sweeps sum as many samples to a number.
    """
    centred = places - (np.array(scene.shape) - 1) / 2
    found = []
    for along_y in (False, True):
        numbers = [number for number, sweep in enumerate(sweeps) if (sweep.along == "y") == along_y]
        finest = sorted(numbers, key=lambda number: sweeps[number].step)
        oblique = sorted(numbers, key=lambda number: -abs(sweeps[number].strip_px))
        along, scan = (centred if along_y else centred[:, ::-1]).T
        seen = [_first_seeing(order, sweeps, camera, along, scan) for order in (finest, oblique)]
        for number in numbers:
            which = np.flatnonzero((seen[0] == number) | (seen[1] == number))
            line, sample = scene_to_sweep(_held(sweeps[number]), camera, along[which], scan[which]).T
            found.append(_patches(sweeps[number], number, camera, line, sample))
    return joined(found)


def _first_seeing(
    order: list[int], sweeps: tuple[Sweep, ...], camera: LineCamera, along: Floats, scan: Floats
) -> NDArray[np.intp]:
    """Number of the first sweep that reaches each place, -1 where none does."""
    found = np.full(len(along), -1)
    for number in order:
        left = np.flatnonzero(found < 0)
        held = _held(sweeps[number])
        line, sample = scene_to_sweep(held, camera, along[left], scan[left]).T
        with np.errstate(invalid="ignore"):
            inside = (line > -2) & (line < held.lines + 1) & (sample > -3) & (sample < camera.samples + 2)
        found[left[inside]] = number
    return found


def _held(sweep: Sweep) -> Sweep:
    return replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)


def _patch(binning: int) -> Floats:
    """Steps of a patch around a place: stored numbers along the line and lines along the scan, (number, 2)."""
    beside = _BESIDE if binning == 1 else 1
    return np.stack(np.meshgrid(np.arange(-beside, beside + 1.0), np.arange(-1.0, 2.0)), axis=-1).reshape(-1, 2)


def _patches(sweep: Sweep, number: int, camera: LineCamera, line: Floats, sample: Floats) -> SampleViews:
    patch, binning = _patch(sweep.binning), sweep.binning
    middle = sample if binning == 1 else (sample + 0.5) / binning - 0.5
    sums = np.rint(middle[:, None] + patch[:, 0]).clip(0, camera.samples // binning - 1).astype(np.intp).ravel()
    lines = (line[:, None] + patch[:, 1]).clip(0, _held(sweep).lines - 1).ravel()
    slopes = camera.pixel_slopes()[_samples_of(sums, binning)]
    count = len(slopes)
    return SampleViews(
        np.full(count, sweep.strip_px),
        sweep.start_px + np.repeat(lines, binning),
        slopes,
        np.full(count, sweep.along == "y"),
        np.full(count, number, np.intp),
        binning,
    )


def _samples_of(sums: NDArray[np.intp], binning: int) -> NDArray[np.intp]:
    return (sums[:, None] * binning + np.arange(binning)).ravel()
