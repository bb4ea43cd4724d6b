"""Samples at any place of any sweep, and the light that they see through the footprint of slit and pixel alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera
from pipeline.mirror import direction_to_normal, scene_to_direction
from pipeline.scan import Sweep, scene_to_sweep
from pipeline.simulator.footprint import Footprint
from pipeline.simulator.rays import Views, exact_views
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene
from pipeline.simulator.scene_light import Looker

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
Way = tuple[float, float]

LINE_SAMPLES = 64  # at most, of a line, evenly from end to end
_PATCH = np.stack(np.meshgrid(np.arange(-2.0, 3.0), np.arange(-1.0, 2.0)), axis=-1).reshape(-1, 2)  # along, scan [px]
PATCH_VIEWS = len(_PATCH)


@dataclass(frozen=True)
class SampleViews:
    """Samples at any place of any sweep, (view,) each: the line's centre and the camera's slope."""

    strip_px: Floats
    scan_px: Floats
    slope: Floats
    along_y: NDArray[np.bool_]
    sweep: NDArray[np.intp]  # number of the sweep

    def chosen(self, which: NDArray[np.intp]) -> SampleViews:
        """Some of the views."""
        return SampleViews(*(getattr(self, one.name)[which] for one in fields(self)))


def joined(parts: list[SampleViews]) -> SampleViews:
    """Put views one after the other."""
    return SampleViews(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(SampleViews)))


def light_seen(
    scene: Scene,
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


def rays_of(views: SampleViews, camera: LineCamera, turned: Way = (0.0, 0.0)) -> Views:
    """Give the middle rays of samples, moved by (along, across) px of the camera, in tangents."""
    ifov = camera.ifov_rad
    tangents = np.stack([views.strip_px, views.scan_px], axis=-1) * ifov
    normal = direction_to_normal(scene_to_direction(tangents))
    return exact_views(normal, turned[1] * ifov, views.slope + turned[0] * ifov)


def line_samples(camera: LineCamera) -> int:
    """Give how many samples of a line stand for all of it."""
    return min(camera.samples, LINE_SAMPLES)


def views_of_lines(sweeps: tuple[Sweep, ...], camera: LineCamera, room: int) -> SampleViews:
    """Lines spread over all sweeps, the most oblique among them, of samples evenly from end to end."""
    order = {id(sweep): place for place, sweep in enumerate(sweeps)}
    numbers = [(sweep, number) for sweep in sweeps for number in {0, sweep.lines // 2, sweep.lines - 1}]
    numbers.sort(key=lambda one: -float(np.hypot(one[0].strip_px, one[0].line_px()[one[1]])))
    most = max(room // line_samples(camera), 1)
    kept = numbers[: most // 2 or 1]
    rest = [(sweep, round(share * (sweep.lines - 1))) for sweep in sweeps for share in (0.25, 0.75)]
    rest += numbers[len(kept) :]
    kept += [rest[round(at)] for at in np.linspace(0, len(rest) - 1, most - len(kept))] if most > len(kept) else []
    samples = np.linspace(0, camera.samples - 1, line_samples(camera)).round().astype(np.intp)
    slopes = camera.pixel_slopes()[samples]
    count = len(samples)
    return SampleViews(
        np.repeat([sweep.strip_px for sweep, _ in kept], count).astype(np.float64),
        np.repeat([sweep.line_px()[number] for sweep, number in kept], count),
        np.tile(slopes, len(kept)),
        np.repeat([sweep.along == "y" for sweep, _ in kept], count),
        np.repeat([order[id(sweep)] for sweep, _ in kept], count),
    )


def views_of_places(places: Floats, scene: Scene, camera: LineCamera, sweeps: tuple[Sweep, ...]) -> SampleViews:
    """Patches around places, each as the finest and the most oblique sweep of each orientation see it."""
    centred = places - (np.array(scene.shape) - 1) / 2
    found = []
    for along_y in (False, True):
        numbers = [number for number, sweep in enumerate(sweeps) if (sweep.along == "y") == along_y]
        finest = sorted(numbers, key=lambda number: sweeps[number].step)
        oblique = sorted(numbers, key=lambda number: -abs(sweeps[number].strip_px))
        along, scan = (centred if along_y else centred[:, ::-1]).T
        seen = [_first_seeing(order, sweeps, camera, along, scan) for order in (finest, oblique)]
        for number in numbers:
            held = _held(sweeps[number])
            which = np.flatnonzero((seen[0] == number) | (seen[1] == number))
            line, sample = scene_to_sweep(held, camera, along[which], scan[which]).T
            found.append(_patches(held, number, camera, line, sample))
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
    """Every position that a sweep holds as a line of its own."""
    return replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)


def _patches(sweep: Sweep, number: int, camera: LineCamera, line: Floats, sample: Floats) -> SampleViews:
    """Views around continuous lines and samples of a sweep, moved to what it has."""
    samples = np.rint(sample[:, None] + _PATCH[:, 0]).clip(0, camera.samples - 1).astype(np.intp).ravel()
    lines = (line[:, None] + _PATCH[:, 1]).clip(0, sweep.lines - 1).ravel()
    count = len(samples)
    slopes = camera.pixel_slopes()[samples]
    turned = np.full(count, sweep.along == "y")
    return SampleViews(
        np.full(count, sweep.strip_px), sweep.start_px + lines, slopes, turned, np.full(count, number, np.intp)
    )
