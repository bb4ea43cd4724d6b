"""Probe a scene for a survey: a close look at its extrema, and the maxima that effects are bounded by.

The whole scene is probed, whatever part of it the sweeps see: blurs and shifts bring light from beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from spectralzoom.pipeline.geometry.scan import CostModel, Floats, Sweep, exposing, scene_to_sweep
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.effect import OFF, Radiance
from spectralzoom.pipeline.simulator.effects.line import BOXES, SLIT, UPRIGHT, box_of
from spectralzoom.pipeline.simulator.effects.probe import Probe, Unit, steepest_difference, unit_at
from spectralzoom.pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from spectralzoom.pipeline.simulator.optics.rays import RayViews, exact_views, middle_normal
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.selection.extrema import CHOSEN_BANDS, band_groups, find_extrema

Way = tuple[float, float]  # along the line and the scan [px]
MOST_VALUES = 1_000_000  # samples times bands; each is seen a few times over, a fraction of a px apart
MOST_SAMPLES = 6_000
FINEST_SAMPLES = 1000  # at which variants of the slit are compared with the finest
_PATCH = np.stack(np.meshgrid(np.arange(-2.0, 3.0), np.arange(-1.0, 2.0)), axis=-1).reshape(-1, 2)  # samples and lines
_PROBE = (2, 1)  # boxes of the probe
_CLOSE = (3, 1)  # boxes that find where variants differ
_ROUNDING = 2e-6  # of the level: less is rounding of float32
_NEAR, _FAR = 0.25, 0.5  # px by which the footprint is shifted
_STILL: Way = (0.0, 0.0)
_PHASES = tuple(((along, scan), _STILL) for along in (0.0, 0.5) for scan in (0.0, 0.5))  # at which boxes are compared
_OPTICS = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
_BY_BAND = ("level", "span", "slope", "curvature", "spectral_slope")  # of a probe


_WAYS = (-_FAR, -_NEAR, _NEAR, _FAR)
SHIFTS = (  # of rays and of points; derivatives are differences between them
    (_STILL, _STILL),
    *(((way, 0.0), _STILL) for way in _WAYS),
    *((_STILL, (way, 0.0)) for way in (-_FAR, _FAR)),
    *(((0.0, way), _STILL) for way in _WAYS),
    *((_STILL, (0.0, way)) for way in (-_FAR, _FAR)),
)


def probe_survey(
    scene: RasterScene,
    rig: Rig,
    sweeps: Sequence[Sweep],
    unit: Unit = "sigma",
    cost: CostModel = CostModel(),  # noqa: B008 - a value
) -> tuple[Probe, ...]:
    """Return a probe for each exposure of the sweeps, the shortest first, with time (by ``cost``) and lines of all.

    Raises SceneError, SettingsError, PoseError as `probe_scene`.
    """
    taken = _taken(sweeps)
    alike: dict[float, list[Sweep]] = {}
    for sweep in taken:
        alike.setdefault(exposing(rig.camera, sweep).exposure_ms, []).append(sweep)
    probes = [probe_scene(scene, rig, some, unit) for _, some in sorted(alike.items())]
    lines = sum(one.lines for one in probes)
    return tuple(replace(one, lines=lines, seconds=cost.seconds(list(taken), rig.camera)) for one in probes)


def probe_scene(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], unit: Unit = "sigma") -> Probe:
    """Return the maxima of the scene through slit and pixel, at its extrema.

    They are found on the scene's own pixels, so that the maxima hold for the whole image. Sweeps are of one exposure.
    Raises SceneError: the scene holds a number that is not finite; SettingsError: no line to take; PoseError: a sweep
    is out of the mirror's reach.
    """
    taken = _taken(sweeps)
    rig = rig.taking(taken[0])
    camera = rig.camera
    bands = len(scene.wavelength_nm)
    room = max(min(MOST_VALUES // bands, MOST_SAMPLES), 64)
    most = room // (len(_PATCH) * len({sweep.along for sweep in taken}))
    places = find_extrema(scene, camera, taken, max(most, 1))
    views = views_of_places(places, scene, camera, taken)
    seen = light_seen(scene, camera, views, _footprint(SLIT.variants[0], rig, _PROBE, None, scene), SHIFTS)
    errors = _slit_errors(scene, rig, views, taken, unit)
    found = replace(_sum_up_light(seen, scene, rig, taken, unit), slit_errors=errors)
    return worst_of_groups(found) if scene.electrons.ndim == 1 and bands > CHOSEN_BANDS else found


def _taken(sweeps: Sequence[Sweep]) -> tuple[Sweep, ...]:
    taken = tuple(sweep for sweep in sweeps if sweep.lines > 0)
    if not taken:
        raise SettingsError("no sweep has a line, so there is nothing to probe; plan at least one line")
    return taken


class SampleViews(NamedTuple):
    """Samples at any place of any sweep, (view,) each: the line's centre and the camera's slope."""

    swath_px: Floats
    scan_px: Floats
    slope: Floats
    along_y: NDArray[np.bool_]

    def chosen(self, which: NDArray[np.intp]) -> SampleViews:
        return SampleViews._make(values[which] for values in self)


def views_of_places(places: Floats, scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...]) -> SampleViews:
    """Return patches about places, in the view of the most oblique sweep of each orientation that sees them.

    For a place that no sweep sees, lines and samples of the least oblique continue.
    """
    centred = places - (np.array(scene.shape) - 1) / 2
    found: list[SampleViews] = []
    for along_y in (False, True):
        numbers = [number for number, sweep in enumerate(sweeps) if (sweep.along == "y") == along_y]
        oblique = sorted(numbers, key=lambda number: -abs(sweeps[number].swath_px))
        along, scan = (centred if along_y else centred[:, ::-1]).T
        seen = _first_seeing(oblique, sweeps, camera, along, scan)
        for number in numbers:
            which = (seen == number) | ((seen < 0) if number == oblique[-1] else False)
            line, sample = scene_to_sweep(_held(sweeps[number]), camera, along[which], scan[which]).T
            reached = np.isfinite(line) & np.isfinite(sample)
            found.append(_patches(sweeps[number], camera, line[reached], sample[reached]))
    return SampleViews._make(map(np.concatenate, zip(*found, strict=True)))


def _first_seeing(
    order: list[int], sweeps: tuple[Sweep, ...], camera: LineCamera, along: Floats, scan: Floats
) -> NDArray[np.intp]:
    """Return the number of the first sweep that sees each place, or nearly; -1 where none does."""
    found = np.full(len(along), -1)
    for number in order:
        left = np.flatnonzero(found < 0)
        held = _held(sweeps[number])
        line, sample = scene_to_sweep(held, camera, along[left], scan[left]).T
        with np.errstate(invalid="ignore"):  # places that no ray reaches
            inside = (line > -2) & (line < held.lines + 1) & (sample > -3) & (sample < camera.samples + 2)
        found[left[inside]] = number
    return found


def _held(sweep: Sweep) -> Sweep:
    return replace(sweep, step=1, lines=sweep.lines * sweep.step)


def _patches(sweep: Sweep, camera: LineCamera, line: Floats, sample: Floats) -> SampleViews:
    numbers = np.rint(sample[:, None] + _PATCH[:, 0]).ravel()
    slopes = np.asarray((numbers - (camera.samples - 1) / 2) * camera.ifov_rad, np.float64)
    count = len(slopes)
    return SampleViews(
        np.full(count, sweep.swath_px),
        sweep.start_px + (line[:, None] + _PATCH[:, 1]).ravel(),
        slopes,
        np.full(count, sweep.along == "y"),
    )


def light_seen(
    scene: RasterScene, camera: LineCamera, views: SampleViews, footprint: Footprint, shifts: Sequence[tuple[Way, Way]]
) -> Radiance:
    """Return light (shift, view, band) through a footprint [e-]; shifts turn rays or move points (along, scan) [px]."""
    from spectralzoom.pipeline.simulator.optics.scene_radiance import SceneSampler

    exposure_ratio = camera.exposure_ms / DEFAULT_EXPOSURE_MS
    ifov = camera.ifov_rad
    light = np.empty((len(shifts), len(views.slope), len(scene.wavelength_nm)), np.float32)
    for along_y in (False, True):
        which = np.flatnonzero(views.along_y == along_y)
        if not which.size:
            continue
        some = views.chosen(which)
        sampler = SceneSampler(footprint, _rays_of(some, camera, _STILL))
        size = scene.shape if along_y else scene.shape[::-1]
        for number, (turned, moved) in enumerate(shifts):
            seen = _rays_of(some, camera, turned)
            along, scan = seen.along / ifov + moved[0], seen.scan / ifov + moved[1]
            at_points = replace(seen, along=along + (size[0] - 1) / 2, scan=scan + (size[1] - 1) / 2)
            light[number, which] = sampler.scan_pass(scene, [at_points], along_y=along_y, exposure_ratio=exposure_ratio)
    return light


def _rays_of(views: SampleViews, camera: LineCamera, turned: Way) -> RayViews:
    """Return the middle rays of samples, moved by (along, across) px of the camera, in tangents."""
    ifov = camera.ifov_rad
    normal = direction_to_normal(scene_to_direction(np.stack([views.swath_px, views.scan_px], axis=-1) * ifov))
    return exact_views(normal, turned[1] * ifov, views.slope + turned[0] * ifov)


def _sum_up_light(seen: Radiance, scene: RasterScene, rig: Rig, sweeps: tuple[Sweep, ...], unit: Unit) -> Probe:
    """Return the maxima of light (shift, view, band) [e-]."""
    camera = rig.camera
    least, most = seen.min(axis=0), seen.max(axis=0)
    scale = unit_at(least, rig, unit)  # of each stored number [e-]
    level = np.maximum(np.abs(most) / unit_at(most, rig, unit), np.abs(least) / scale)
    low, high = least.min(axis=0), most.max(axis=0)
    span = np.maximum(most - low, high - least)
    span[span <= _ROUNDING * np.maximum(np.abs(low), np.abs(high))] = 0  # may be rounding
    slope, curvature = _derivatives(seen, scale)
    return Probe(
        unit=unit,
        sweeps=sweeps,
        wavelength_nm=scene.wavelength_nm,
        fwhm_nm=scene.fwhm_nm,
        level=_greatest(level),
        span=_greatest(span / scale),
        slope=slope,
        curvature=curvature,
        spectral_slope=_greatest(steepest_difference(seen[0], scene.wavelength_nm) / scale),
        brightest_e=float(most.max()),
        darkest_e=float(least.min()),
        unit_least_dn=float(scale.min()) / camera.electrons_per_dn,
        lines=sum(sweep.lines for sweep in sweeps),
        seconds=CostModel().seconds(list(sweeps), camera),
        white_e=scene.white_reference_electrons.astype(np.float64) * (camera.exposure_ms / DEFAULT_EXPOSURE_MS),
    )


def _derivatives(seen: Radiance, scale: Radiance) -> tuple[Floats, Floats]:
    """Return the greatest first and second derivatives, (2, band) each over the unit, within half a px."""
    level = seen[0]
    high = np.abs(level).max(axis=0)

    def size(difference: Radiance) -> Floats:
        shown = np.where(np.abs(difference) > _ROUNDING * high, np.abs(difference), np.float32(0))
        return _greatest(shown / scale)

    slope, curvature = [], []
    for axis in (0, 1):
        behind, back, ahead, front, before, after = seen[1 + 6 * axis : 7 + 6 * axis]
        near, far = [(behind, back), (back, level), (level, ahead), (ahead, front)], [(before, level), (level, after)]
        triples = [(back, ahead, _NEAR), (behind, front, _FAR), (before, after, _FAR)]
        steps = [size(b - a) / _NEAR for a, b in near] + [size(b - a) / _FAR for a, b in far]
        slope.append(np.max(steps, axis=0))
        curvature.append(np.max([size(a + b - 2 * level) / way**2 for a, b, way in triples], axis=0))
    return np.array(slope), np.array(curvature)


def _greatest(values: NDArray[np.floating]) -> Floats:
    return np.asarray(values.max(axis=0).astype(np.float64))


def worst_of_groups(probe: Probe) -> Probe:
    """Return the probe with the worst of each group of neighbouring bands in all of them."""
    groups = band_groups(len(probe.wavelength_nm))
    starts = [one.start for one in groups]
    sizes = [one.stop - one.start for one in groups]
    values: dict[str, Any] = {
        name: np.repeat(np.maximum.reduceat(getattr(probe, name), starts, axis=-1), sizes, axis=-1) for name in _BY_BAND
    }
    return replace(probe, **values)


def _slit_errors(
    scene: RasterScene, rig: Rig, views: SampleViews, sweeps: tuple[Sweep, ...], unit: Unit
) -> dict[str, float]:
    """Return the greatest change from the finest slit, with the rig's blurs, by each other variant and without it."""
    rough = _roughest(scene, rig, views, unit)
    views = views.chosen(rough)
    moments = _least_blurs(rig, scene.wavelength_nm, sweeps)
    boxes = {one: _footprint(one, rig, BOXES.get(one, (1, 1)), moments, scene) for one in (*SLIT.variants, OFF)}
    finest = light_seen(scene, rig.camera, views, boxes.pop(SLIT.variants[0]), _PHASES)
    scale = unit_at(finest, rig, unit)
    return {one: float(_changes(scene, rig, views, box, finest, scale).max(initial=0.0)) for one, box in boxes.items()}


def _roughest(scene: RasterScene, rig: Rig, views: SampleViews, unit: Unit) -> NDArray[np.intp]:
    """Return the samples that the slit, or one upright box in its place, changes most."""
    close = light_seen(scene, rig.camera, views, _footprint(SLIT.variants[0], rig, _CLOSE, None, scene), _PHASES)
    scale = unit_at(close, rig, unit)
    others = [_footprint(variant, rig, (1, 1), None, scene) for variant in (OFF, UPRIGHT)]
    changes = [_changes(scene, rig, views, other, close, scale) for other in others]
    return np.unique([np.argsort(-change, kind="stable")[:FINEST_SAMPLES] for change in changes])


def _changes(
    scene: RasterScene, rig: Rig, views: SampleViews, footprint: Footprint, finest: Radiance, scale: Radiance
) -> Floats:
    """Return the greatest change of each sample by another footprint, over the unit, (sample,)."""
    change = light_seen(scene, rig.camera, views, footprint, _PHASES) - finest
    change[np.abs(change) <= _ROUNDING * np.abs(finest)] = 0
    return np.asarray((np.abs(change) / scale).max(axis=(0, 2), initial=0.0), np.float64)


def _footprint(
    variant: str, rig: Rig, parts: tuple[int, int], moments: Moments | None, scene: RasterScene
) -> Footprint:
    return fold(box_of(variant, rig), parts, 1, moments or Moments.together([], len(scene.wavelength_nm)))


def _least_blurs(rig: Rig, wavelength_nm: Floats, sweeps: Sequence[Sweep]) -> Moments:
    """Return all blurs and shifts of the rig's optics in the sweep where they are least: others hide more."""
    found = []
    for sweep in sweeps:
        normal = middle_normal(sweep, rig.camera)
        blurs = [blur.moments(rig, wavelength_nm, blur.variants[0], normal) for blur in _OPTICS]
        found.append(Moments.together(blurs, len(wavelength_nm)))
    return min(found, key=lambda one: float((one.spread + (0.0 if one.waves is None else one.waves**2)).sum()))
