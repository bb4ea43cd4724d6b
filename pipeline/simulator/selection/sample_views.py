"""Samples of the sweeps, or beside them, at which a survey looks closely, and the light that they see."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from pipeline.geometry.scan import Sweep, points_of_scan, scene_to_sweep
from pipeline.simulator.optics.kernel_fit import Footprint
from pipeline.simulator.optics.rays import RayViews, exact_views
from pipeline.simulator.optics.scene_radiance import Looker
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

Radiance = NDArray[np.float32]
Floats = NDArray[np.float64]
Way = tuple[float, float]
LINE_SAMPLES = 64  # of a line, evenly from end to end, in sums where samples are summed
_LEAST_SUMS = 16  # of a line
_WITHIN = -1.5  # px less than what counts as seen by a sweep, so that half a line beyond its last one is not
_ANYWHERE_PX = 1e6
_BESIDE = 2  # samples to either side of a place; of sums, one


@dataclass(frozen=True)
class SampleViews:
    """Samples at any place of any sweep, (view,) each: the line's centre and the camera's slope.

    ``binning`` in a row are the samples of one stored number.
    """

    swath_px: Floats
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
) -> Radiance:
    """Return light (shift, view, band) through a footprint.

    Rays are turned and points moved (along, scan) by shifts [px].
    """
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
            light[number, which] = looker.scan_pass(scene, [placed], along_y=along_y, exposures=exposures)
    return light


def rays_of(views: SampleViews, camera: LineCamera, turned: Way = (0.0, 0.0)) -> RayViews:
    """Return the middle rays of samples, moved by (along, across) px of the camera, in tangents."""
    ifov = camera.ifov_rad
    tangents = np.stack([views.swath_px, views.scan_px], axis=-1) * ifov
    normal = direction_to_normal(scene_to_direction(tangents))
    return exact_views(normal, turned[1] * ifov, views.slope + turned[0] * ifov)


def line_sums(camera: LineCamera, binning: int) -> int:
    """Return the number of stored numbers that stand for all of a line."""
    return min(camera.samples // binning, max(LINE_SAMPLES // binning, _LEAST_SUMS))


def views_of_lines(sweeps: tuple[Sweep, ...], camera: LineCamera, room: int) -> SampleViews:
    """Return lines spread over all sweeps, the most oblique included, with samples evenly from end to end.

    All sweeps sum as many samples to a number.
    """
    order = {id(sweep): place for place, sweep in enumerate(sweeps)}
    binning = sweeps[0].binning
    numbers = [(sweep, number) for sweep in sweeps for number in {0, sweep.lines // 2, sweep.lines - 1}]
    numbers.sort(key=lambda one: -float(np.hypot(one[0].swath_px, one[0].line_px()[one[1]])))
    most = max(room // (line_sums(camera, binning) * binning), 1)
    kept = numbers[: most // 2 or 1]
    rest = [(sweep, round(fraction * (sweep.lines - 1))) for sweep in sweeps for fraction in (0.25, 0.75)]
    rest += numbers[len(kept) :]
    kept += [rest[round(at)] for at in np.linspace(0, len(rest) - 1, most - len(kept))] if most > len(kept) else []
    sums = np.linspace(0, camera.samples // binning - 1, line_sums(camera, binning)).round().astype(np.intp)
    slopes = camera.pixel_slopes()[_samples_of(sums, binning)]
    count = len(slopes)
    return SampleViews(
        np.repeat([sweep.swath_px for sweep, _ in kept], count).astype(np.float64),
        np.repeat([sweep.line_px()[number] for sweep, number in kept], count),
        np.tile(slopes, len(kept)),
        np.repeat([sweep.along == "y" for sweep, _ in kept], count),
        np.repeat([order[id(sweep)] for sweep, _ in kept], count),
        binning,
    )


def views_of_places(
    places: Floats, scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...], beside_px: float | None = None
) -> SampleViews:
    """Return patches around places, in the view of the finest and the most oblique sweep of each orientation.

    ``beside_px``: patches lie where their places are, up to so far beside what a sweep sees, as if its lines and their
    samples went on; None: a sweep's own samples, the nearest ones. All sweeps sum as many samples to a number.
    """
    centred = places - (np.array(scene.shape) - 1) / 2
    found = []
    for along_y in (False, True):
        numbers = [number for number, sweep in enumerate(sweeps) if (sweep.along == "y") == along_y]
        finest = sorted(numbers, key=lambda number: sweeps[number].step)
        oblique = sorted(numbers, key=lambda number: -abs(sweeps[number].swath_px))
        along, scan = (centred if along_y else centred[:, ::-1]).T
        slack = beside_px or 0.0
        seen = [_first_seeing(order, sweeps, camera, along, scan, slack) for order in (finest, oblique)]
        if beside_px is None:  # what no sweep sees itself, and shows as the scene's repeated edge
            anyhow = _first_seeing(finest, sweeps, camera, along, scan, _ANYWHERE_PX)
            seen = [np.where(one < 0, anyhow, one) for one in seen]
        for number in numbers:
            which = np.flatnonzero((seen[0] == number) | (seen[1] == number))
            line, sample = scene_to_sweep(_held(sweeps[number]), camera, along[which], scan[which]).T
            found.append(_patches(sweeps[number], number, camera, line, sample, held=beside_px is None))
    return joined(found)


def places_beyond(
    places: Floats, scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...]
) -> NDArray[np.bool_]:
    """Return which places no sweep sees itself, (place,): its nearest samples look beside them."""
    centred = places - (np.array(scene.shape) - 1) / 2
    found = np.ones(len(places), np.bool_)
    for along_y in {sweep.along == "y" for sweep in sweeps}:
        numbers = [number for number, sweep in enumerate(sweeps) if (sweep.along == "y") == along_y]
        along, scan = (centred if along_y else centred[:, ::-1]).T
        found &= _first_seeing(numbers, sweeps, camera, along, scan, _WITHIN) < 0
    return found


def _first_seeing(
    order: list[int], sweeps: tuple[Sweep, ...], camera: LineCamera, along: Floats, scan: Floats, slack: float
) -> NDArray[np.intp]:
    """Number of the first sweep that reaches each place, -1 where none does."""
    found = np.full(len(along), -1)
    for number in order:
        left = np.flatnonzero(found < 0)
        held = _held(sweeps[number])
        line, sample = scene_to_sweep(held, camera, along[left], scan[left]).T
        with np.errstate(invalid="ignore"):
            inside = (line > -2 - slack) & (line < held.lines + 1 + slack)
            inside &= (sample > -3 - slack) & (sample < camera.samples + 2 + slack)
        found[left[inside]] = number
    return found


def _held(sweep: Sweep) -> Sweep:
    return replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)


def sample_offsets(binning: int) -> Floats:
    """Return the steps of a patch around a place, (number, 2).

    They are stored numbers along the line and lines along the scan.
    """
    beside = _BESIDE if binning == 1 else 1
    return np.stack(np.meshgrid(np.arange(-beside, beside + 1.0), np.arange(-1.0, 2.0)), axis=-1).reshape(-1, 2)


def _patches(sweep: Sweep, number: int, camera: LineCamera, line: Floats, sample: Floats, *, held: bool) -> SampleViews:
    patch, binning = sample_offsets(sweep.binning), sweep.binning
    middle = sample if binning == 1 else (sample + 0.5) / binning - 0.5
    sums = np.rint(middle[:, None] + patch[:, 0]).ravel()
    lines = (line[:, None] + patch[:, 1]).ravel()
    if held:
        sums = sums.clip(0, camera.samples // binning - 1)
        lines = lines.clip(0, _held(sweep).lines - 1)
    number_of = _samples_of(sums.astype(np.intp), binning).astype(np.float64)
    slopes = (number_of - (camera.samples - 1) / 2) * camera.ifov_rad
    count = len(slopes)
    return SampleViews(
        np.full(count, sweep.swath_px),
        sweep.start_px + np.repeat(lines, binning),
        slopes,
        np.full(count, sweep.along == "y"),
        np.full(count, number, np.intp),
        binning,
    )


def _samples_of(sums: NDArray[np.intp], binning: int) -> NDArray[np.intp]:
    return (sums[:, None] * binning + np.arange(binning)).ravel()


_LINES_AT_ONCE = 256


def line_means(
    scene: RasterScene, camera: LineCamera, sweeps: Sequence[Sweep], beside_px: Sequence[float] = (0.0,)
) -> Radiance:
    """Return the mean over samples and bands of every position that any sweep holds, (position,) [e-].

    Means are those of the pixels that middle rays meet. A slit, and positions that one line holds, give means between
    these. Positions continue beyond a sweep's ends as far as its slit reaches, and as far as ``beside_px``, by which
    lines also lie beside their strip.
    """
    spectra = scene.electrons * np.float32(camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    mean = spectra / spectra.shape[0] if spectra.ndim == 1 else spectra.mean(axis=1)
    grey = (scene.planes.reshape(-1, scene.planes.shape[2]) @ mean.astype(np.float32)).reshape(scene.shape)
    beyond, found = np.ceil(camera.slit_px / 2 + 1) + max(beside_px), []
    held_by = ((one, one.start_px, one.start_px + one.lines * one.step) for one in sweeps if one.lines)
    courses = sorted({(one.along == "y", one.swath_px, start, stop) for one, start, stop in held_by})
    for (along_y, swath, start, stop), beside in itertools.product(courses, beside_px):
        pixels, middle = (grey.T if along_y else grey), (np.array(scene.shape) - 1) / 2
        down, right = middle[::-1] if along_y else middle
        held = np.arange(start - beyond, stop + beyond)
        for first in range(0, len(held), _LINES_AT_ONCE):
            some = held[first : first + _LINES_AT_ONCE]
            along, scan = points_of_scan(swath + beside, camera, some[:, None], camera.pixel_slopes())
            row = np.rint(scan + down).clip(0, pixels.shape[0] - 1).astype(np.intp)
            column = np.rint(along + right).clip(0, pixels.shape[1] - 1).astype(np.intp)
            found.append(pixels[row, column].mean(axis=1))
    return np.concatenate(found)
