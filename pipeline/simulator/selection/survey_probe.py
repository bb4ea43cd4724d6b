"""Sums up a scene as a survey is going to see it: a close look at extrema and along lines, and the maxima there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.simulator import compiled_loops
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.line import SLIT, UPRIGHT, box_of, box_parts
from pipeline.simulator.effects.probe import (
    Detail,
    Probe,
    Unit,
    second_difference,
    spectral_differences_between,
    steepest_difference,
    stored_mean,
    unit_at,
)
from pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from pipeline.simulator.optics.rays import middle_normal
from pipeline.simulator.optics.tap_sums import LADDER
from pipeline.simulator.render import EFFECTS, views_all_over
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.adjacency import REACHES, greatest_way_px, reached_cells, seen_widely
from pipeline.simulator.selection.extrema import CHOSEN_BANDS, Extrema, band_groups, find_extrema
from pipeline.simulator.selection.sample_views import (
    SampleViews,
    joined,
    light_seen,
    line_means,
    places_beyond,
    sample_offsets,
    views_of_lines,
    views_of_places,
)

Floats = NDArray[np.float64]
Radiance = NDArray[np.float32]
Way = tuple[float, float]
_DERIVATIVES = ("span", "slope", "curvature", "spectral_slope", "spectral_curvature")
_BY_BAND = ("level", "spread", *_DERIVATIVES, "anywhere", "anywhere_spectral")  # of a probe
_ROUNDING = 2e-6  # of the level: less is rounding of float32
_NEAR, _FAR = 0.25, 0.5  # px by which the footprint is shifted


def _shifts() -> list[tuple[Way, Way]]:
    none = (0.0, 0.0)
    found = [(none, none)]
    for axis in (0, 1):
        both = [(way, 0.0) if axis == 0 else (0.0, way) for way in (-_FAR, -_NEAR, _NEAR, _FAR)]
        found += [(way, none) for way in both] + [(none, way) for way in (both[0], both[3])]
    return found


SHIFTS = tuple(_shifts())  # of rays and of points, (along, scan) px each, that derivatives are taken from


@dataclass(frozen=True)
class ProbedLines:
    """Light (shift, view, band) of the sweeps' own samples, and of places within each reach of them and beyond. [e-]

    ``scale`` is the unit of the tolerance at each stored number of theirs, (number, band) [e-].
    """

    own: Radiance
    around: tuple[Radiance, ...]
    scale: Radiance
    binning: int
    rig: Rig
    unit: Unit

    @staticmethod
    def of(parts: Sequence[Radiance], binning: int, rig: Rig, unit: Unit) -> ProbedLines:
        scale = unit_at(np.asarray(stored_mean(parts[0].min(axis=0), binning), np.float32), rig, unit, binning)
        return ProbedLines(parts[0], tuple(parts[1:]), scale, binning, rig, unit)

    def span_to(self, low: Radiance, high: Radiance) -> Floats:
        """Return the greatest difference of a stored number and light between two ends, (band,), over its unit."""
        least, most = self.own.min(axis=0), self.own.max(axis=0)
        off = np.maximum(most - low, high - least)
        return _greatest(stored_mean(_above(off, np.maximum(np.abs(low), np.abs(high))), self.binning) / self.scale)

    def beside(self, scene: RasterScene, covered: bool) -> dict[str, Any]:
        """Return the probe's values beside the sweeps; ``covered``: sweeps see all of the scene but a px or two."""
        least_unit = self.scale.min(axis=0)[None]
        low, high = self.own.min(axis=(0, 1)), self.own.max(axis=(0, 1))
        own_unit = unit_at(np.minimum(low, high)[None], self.rig, self.unit, self.binning)
        slope, curvature = _derivatives(self.own, self.scale, self.binning)
        nm, unit = np.asarray(scene.wavelength_nm, np.float64), np.minimum(least_unit, own_unit)
        spectral = _spectral_derivatives(self.own[0], nm, self.scale, self.binning)
        found = []
        for reach, seen in zip((*REACHES, np.inf), self.around, strict=True):
            if seen.size:
                low, high = np.minimum(low, seen.min(axis=(0, 1))), np.maximum(high, seen.max(axis=(0, 1)))
            if reach < np.inf:
                if seen.size:
                    steep, bent = _derivatives(seen, unit, self.binning)
                    slope, curvature = np.maximum(slope, steep), np.maximum(curvature, bent)
                    spectral = np.maximum(spectral, _spectral_derivatives(seen[0], nm, unit, self.binning))
                found.append(Detail(reach, self.span_to(low, high), slope, curvature, spectral))
        ends = np.stack([low, high]).astype(np.float64)
        between = {"anywhere_spectral": spectral_differences_between(ends, nm) / unit, "ends_e": ends}
        if covered:
            found[-1] = replace(found[-1], reach_px=np.inf)
            return {"beside": tuple(found), "anywhere": found[-1].span, **between}
        wide = seen_widely(scene, self.rig.camera.exposure_ms)
        afar = Detail(
            np.inf,
            self.span_to(wide.low, wide.high),
            wide.slope / least_unit,
            wide.curvature / least_unit,
            wide.spectral / unit,
        )
        return {"beside": tuple(found), "afar": afar, "anywhere": self.span_to(low, high), **between}


def sum_up_probes(probes: ProbedLines, scene: RasterScene, sweeps: tuple[Sweep, ...], means: Radiance) -> Probe:
    """Turn what samples see, and the means of lines (line,), into the probe's maxima."""
    rig, seen, scale, binning = probes.rig, probes.own, probes.scale, probes.binning
    camera, least, most = rig.camera, seen.min(axis=0), seen.max(axis=0)
    darkest, brightest = stored_mean(least, binning), stored_mean(most, binning)
    slope, curvature = _derivatives(seen, scale, binning)
    spectral = _spectral_derivatives(seen[0], scene.wavelength_nm, scale, binning)
    low, high = least.min(axis=0), most.max(axis=0)
    unit_brightest = unit_at(np.asarray(brightest, np.float32), rig, probes.unit, binning)
    level = np.maximum(np.abs(brightest) / unit_brightest, np.abs(darkest) / scale)
    off_mean = np.maximum(most - means.min(), means.max() - least)
    return Probe(
        unit=probes.unit,
        sweeps=sweeps,
        wavelength_nm=scene.wavelength_nm,
        fwhm_nm=scene.fwhm_nm,
        level=_greatest(level),
        spread=_greatest(stored_mean(_above(off_mean, high), binning) / scale),
        span=probes.span_to(low, high),
        slope=slope,
        curvature=curvature,
        spectral_slope=spectral[0],
        spectral_curvature=spectral[1],
        brightest_e=float(most.max()),
        darkest_e=float(least.min()),
        unit_least_dn=float(scale.min()) / camera.electrons_per_dn,
        lines=sum(sweep.lines for sweep in sweeps),
        seconds=CostModel().seconds(list(sweeps), camera),
        white_e=scene.white_reference_electrons.astype(np.float64) * (camera.exposure_ms / DEFAULT_EXPOSURE_MS),
        own_e=np.stack([low, high]).astype(np.float64),
        binning=binning,
    )


def worst_of_groups(probe: Probe) -> Probe:
    """Return the probe with the worst of each group of neighbouring bands in all of them: one was looked at for each.

    Lights of the groups are the least and the greatest of any of their bands. A level of one band and the span of
    another do not give the least light of a third.
    """
    groups = band_groups(len(probe.wavelength_nm))

    def worst(values: Floats) -> Floats:
        parts = [
            np.broadcast_to(some.max(axis=-1, keepdims=True), some.shape)
            for some in (values[..., one] for one in groups)
        ]
        return np.concatenate(parts, axis=-1)

    def of_detail(one: Detail) -> Detail:
        return Detail(one.reach_px, *map(worst, (one.span, one.slope, one.curvature, one.spectral)))

    def ends(values: Floats | None) -> Floats | None:
        return None if values is None else np.stack([-worst(-values[0]), worst(values[1])])

    values: dict[str, Any] = {name: getattr(probe, name) for name in _BY_BAND}
    values = {name: None if one is None else worst(one) for name, one in values.items()}
    return replace(
        probe,
        **values,
        beside=tuple(map(of_detail, probe.beside)),
        afar=None if probe.afar is None else of_detail(probe.afar),
        own_e=ends(probe.own_e),
        ends_e=ends(probe.ends_e),
    )


def _derivatives(seen: Radiance, scale: Radiance, binning: int) -> tuple[Floats, Floats]:
    """Return the greatest first and second derivatives, (2, band) each over the unit, by differences within half a px.

    A stored number has the mean size over its samples: they may be moved one way or the other.
    """
    level, high = seen[0], np.abs(seen[0]).max(axis=0)

    def size(difference: Radiance) -> Floats:
        return _greatest(stored_mean(_above(np.abs(difference), high), binning) / scale)

    slope, curvature = [], []
    for axis in (0, 1):
        behind, back, ahead, front, before, after = seen[1 + 6 * axis : 7 + 6 * axis]
        near, far = [(behind, back), (back, level), (level, ahead), (ahead, front)], [(before, level), (level, after)]
        triples = [(back, ahead, _NEAR), (behind, front, _FAR), (before, after, _FAR)]
        steps = [size(b - a) / _NEAR for a, b in near] + [size(b - a) / _FAR for a, b in far]
        slope.append(np.max(steps, axis=0))
        curvature.append(np.max([size(a + b - 2 * level) / way**2 for a, b, way in triples], axis=0))
    return np.array(slope), np.array(curvature)


def _spectral_derivatives(level: Radiance, wavelength_nm: Floats, scale: Radiance, binning: int) -> Floats:
    """Return the greatest first and second divided differences over wavelength, (2, band) over the unit.

    0 where there is none.
    """
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros((2, len(nm)))
    both = steepest_difference(level, nm), np.abs(second_difference(level, nm))
    return np.stack([_greatest(stored_mean(one, binning) / scale) for one in both])


def _above(difference: Radiance, high: Radiance) -> Radiance:
    """Return the difference; 0 where it is at most rounding."""
    return np.where(difference > _ROUNDING * np.abs(high), difference, np.float32(0))


def _greatest(values: NDArray[np.floating]) -> Floats:
    return np.asarray(values.max(axis=0).astype(np.float64))


MOST_VALUES = 1_000_000  # samples times bands; each is seen a few times over, a fraction of a px apart
MOST_SAMPLES = 6_000
USUAL_LIGHTS = 101  # quantiles of the light that are kept
FINEST_SAMPLES = 1000  # at which variants of the slit are held against the finest
_LEAST_OF_SWEEP = 50
_LEAST_PLACES = 24  # that are looked at where samples are summed, however many samples that takes
_PROBE, _CLOSE = (2, 1), (3, 1)  # boxes that are looked through, and that tell where variants differ
_ALIKE = 0.02  # share by which blurs may differ and count as one
_OPTICS = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
_LINES_BESIDE = tuple(sign * reach for reach in (0.0, REACHES[-1]) for sign in (-1.0, 1.0))  # whose light may come
_FAR_PLACES = 8  # the brightest and the darkest of what lies beyond
_PHASES = tuple(((along, scan), (0.0, 0.0)) for along in (0.0, 0.5) for scan in (0.0, 0.5))  # at which boxes differ


def probe_survey(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], unit: Unit = "sigma") -> tuple[Probe, ...]:
    """Probe the scene for sweeps of any binning and exposure: one probe for each pair, the smallest binning first.

    Time, lines and the usual light, by the exposure, they have in common.

    Raises SceneError, SettingsError, PoseError as `probe_scene`.
    """
    taken = _taken(sweeps)
    alike: dict[tuple[int, float], list[Sweep]] = {}
    for sweep in taken:
        alike.setdefault((sweep.binning, exposing(rig.camera, sweep).exposure_ms), []).append(sweep)
    each = sorted(alike.items())
    probes = [probe_scene(scene, rig, some, unit) for _, some in each]
    lines, seconds = sum(one.lines for one in probes), CostModel().seconds(list(taken), rig.camera)
    first, usual = each[0][0][1], probes[0].usual_e
    assert usual is not None
    return tuple(
        replace(one, lines=lines, seconds=seconds, usual_e=usual * (exposure_ms / first))
        for one, ((_, exposure_ms), _) in zip(probes, each, strict=True)
    )


def probe_scene(scene: RasterScene, rig: Rig, sweeps: Sequence[Sweep], unit: Unit = "sigma") -> Probe:
    """Look at the scene through the footprint alone where it is steepest, brightest and darkest, and along some lines.

    The places to look are found on the scene's own pixels, so that the maxima hold for the whole image. Sweeps are of
    one binning and exposure. Raises SceneError: the scene holds a number that is not finite; SettingsError: no line to
    take; PoseError: a sweep is out of the mirror's reach.
    """
    taken = _taken(sweeps)
    rig = rig.taking(taken[0])
    binning, camera, bands = taken[0].binning, rig.camera, len(scene.wavelength_nm)
    room = max(min(MOST_VALUES // bands, MOST_SAMPLES), 64)
    lines = views_of_lines(taken, camera, room // 3)
    most = (room - room // 3) // (len(sample_offsets(binning)) * binning * len({sweep.along for sweep in taken}))
    most = max(most, 1 if binning == 1 else _LEAST_PLACES)
    cells = reached_cells(scene.shape, camera, taken)
    counts = (most, *(max(most // 4, 1) for _ in REACHES), _FAR_PLACES)
    places = find_extrema(scene, camera, taken, cells, REACHES, counts)
    own = joined([lines, views_of_places(places.seen, scene, camera, taken)])
    beside = _views_beside(scene, camera, taken, places)
    views = joined([own, *beside])
    seen = light_seen(scene, camera, views, _footprint(SLIT.variants[0], rig, _PROBE, None, scene), SHIFTS)
    ends = np.cumsum([len(one.slope) for one in (own, *beside)])
    probes = ProbedLines.of(np.split(seen, ends[:-1], axis=1), binning, rig, unit)
    summed = sum_up_probes(probes, scene, taken, line_means(scene, camera, taken, _LINES_BESIDE if beside else (0.0,)))
    usual = np.quantile(seen[0, : len(lines.slope)], np.linspace(0, 1, USUAL_LIGHTS)).astype(np.float64)
    found = replace(summed, usual_e=usual, places=places.seen)
    if beside:
        found = replace(found, **probes.beside(scene, cells.covers))
        way_px = greatest_way_px(found, rig, EFFECTS)  # shifts of the image may bring samples to what lies as near
        beside = [one for one, nearer in zip(beside, (0.0, *REACHES), strict=True) if nearer < way_px]
    found = replace(found, slit_errors=_slit_errors(scene, rig, joined([own, *beside]), taken, unit))
    return worst_of_groups(found) if scene.electrons.ndim == 1 and bands > CHOSEN_BANDS else found


def _views_beside(
    scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...], places: Extrema
) -> list[SampleViews]:
    """Return patches beside the sweeps, within each distance and beyond it; none where nothing is there."""
    beyond = places.seen[places_beyond(places.seen, scene, camera, sweeps)]
    near = [np.concatenate([beyond, places.beside[0]]), *places.beside[1:]]
    if not any(map(len, (*near, places.far))):
        return []
    anywhere = float(10 * max(scene.shape))
    return [views_of_places(some, scene, camera, sweeps, anywhere) for some in (*near, places.far)]


def _taken(sweeps: Sequence[Sweep]) -> tuple[Sweep, ...]:
    taken = tuple(sweep for sweep in sweeps if sweep.lines > 0)
    if not taken:
        raise SettingsError("a scene is summed up for the sweeps that look at it; expected lines to take, got none")
    return taken


def _slit_errors(
    scene: RasterScene, rig: Rig, views: SampleViews, sweeps: tuple[Sweep, ...], unit: Unit
) -> dict[str, float]:
    """Return the greatest change by every variant of the slit, over the unit.

    A variant is off, or compared with the finest, with all of the rig's blurs.

    Each sweep is seen through the boxes that a variant takes for it.
    """
    rough = _roughest(scene, rig, views, unit)
    views = views.chosen((rough[:, None] * views.binning + np.arange(views.binning)).ravel())
    sweep_of = views.sweep[:: views.binning]
    whole = [views_all_over(rig, sweep, exact=True) for sweep in sweeps]
    errors = dict.fromkeys((*SLIT.variants[1:], OFF), 0.0)
    for moments in _blurs(rig, scene.wavelength_nm, sweeps):
        boxes = {parts: _footprint(SLIT.variants[0], rig, parts, moments, scene) for parts in LADDER}
        parted, alike = boxes[LADDER[-1]].by_parts()
        sharp = light_seen(scene, rig.camera, views, parted, _PHASES)
        finest = sharp if alike is None else sharp + light_seen(scene, rig.camera, views, alike, _PHASES)
        scale = unit_at(_stored(finest, views), rig, unit, views.binning)
        fewer = {parts: boxes[parts].by_parts()[0] for parts in LADDER[:-1]}
        found = {parts: _changes(scene, rig, views, one, sharp, scale) for parts, one in fewer.items()}
        found[LADDER[-1]] = np.zeros(views.sums)
        for variant in SLIT.variants[1:]:
            taken = [box_parts(variant, rig, one) for one in whole]
            seen = [found.get(parts, found[LADDER[-1]])[sweep_of == number] for number, parts in enumerate(taken)]
            errors[variant] = max(errors[variant], *(float(one.max(initial=0.0)) for one in seen))
        off = _changes(scene, rig, views, _footprint(OFF, rig, (1, 1), moments, scene), finest, scale)
        errors[OFF] = max(errors[OFF], float(off.max(initial=0.0)))
    return errors


def _roughest(scene: RasterScene, rig: Rig, views: SampleViews, unit: Unit) -> NDArray[np.intp]:
    boxes = _footprint(SLIT.variants[0], rig, _CLOSE, None, scene)
    close = light_seen(scene, rig.camera, views, boxes, _PHASES)
    scale, found = unit_at(_stored(close, views), rig, unit, views.binning), []
    sweep_of, count = views.sweep[:: views.binning], max(FINEST_SAMPLES // views.binning, 2 * _LEAST_OF_SWEEP)
    for variant in (OFF, UPRIGHT):
        other = _footprint(variant, rig, (1, 1), None, scene)
        order = np.argsort(-_changes(scene, rig, views, other, close, scale), kind="stable")
        found.append(order[: count // 2])
        numbers = np.unique(sweep_of)
        each = max(count // 2 // len(numbers), _LEAST_OF_SWEEP)
        found += [order[sweep_of[order] == number][:each] for number in numbers]
    return np.unique(np.concatenate(found))


def _changes(
    scene: RasterScene, rig: Rig, views: SampleViews, footprint: Footprint, finest: Radiance, scale: Radiance
) -> Floats:
    """Return the greatest signed change of each stored number by another footprint, over the unit, (number,)."""
    light, greatest = light_seen(scene, rig.camera, views, footprint, _PHASES), np.zeros(views.sums)
    compiled_loops.greatest_changes(light, finest, scale, views.binning, _ROUNDING, greatest)
    return greatest


def _footprint(
    variant: str, rig: Rig, parts: tuple[int, int], moments: Moments | None, scene: RasterScene
) -> Footprint:
    blurs = moments or Moments.together([], len(scene.wavelength_nm))
    return fold(box_of(variant, rig), parts, 1, blurs)


def _blurs(rig: Rig, wavelength_nm: Floats, sweeps: Sequence[Sweep]) -> list[Moments]:
    """Return all blurs and shifts of the rig's optics in the sweeps where they are least and most.

    One where both agree. The slit's variants stand beside all other effects: what leaving out a blur changes is bounded
    for any slit.
    """
    normals = [middle_normal(sweep, rig.camera) for sweep in sweeps]
    all_blurs = [[blur.moments(rig, wavelength_nm, blur.variants[0], one) for blur in _OPTICS] for one in normals]
    found = [Moments.together(blurs, len(wavelength_nm)) for blurs in all_blurs]
    found.sort(key=lambda one: float(_size(one).sum()))
    least, most = found[0], found[-1]
    return [least] if np.allclose(_size(least), _size(most), rtol=_ALIKE) else [least, most]


def _size(blurs: Moments) -> Floats:
    return blurs.spread if blurs.waves is None else blurs.spread + blurs.waves**2


def _stored(values: Radiance, views: SampleViews) -> Radiance:
    """Return the means over the samples of each stored number, (..., number, band)."""
    return np.asarray(stored_mean(values, views.binning), np.float32)
