"""Sums up a scene as a survey is going to see it: a close look at the telling places and along lines of all sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.line import SLIT, UPRIGHT, box_of, box_parts
from pipeline.simulator.effects.probe import Probe, Unit, second_difference, steepest_difference, stored_mean, unit_at
from pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from pipeline.simulator.optics.rays import middle_normal
from pipeline.simulator.optics.tap_sums import LADDER
from pipeline.simulator.render import views_all_over
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.survey_looks import (
    SampleViews,
    joined,
    light_seen,
    line_sums,
    patch_views,
    telling_places,
    views_of_lines,
    views_of_places,
)

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
MOST_VALUES = 1_000_000  # samples times bands; each is seen a few times over, a fraction of a px apart
MOST_SAMPLES = 12_000
USUAL_LIGHTS = 101  # quantiles of the light that are kept
FINEST_SAMPLES = 1000  # at which variants of the slit are held against the finest
_LEAST_OF_SWEEP = 50
_LEAST_PLACES = 24  # that are looked at where samples are summed, however many samples that takes
_LOOK, _CLOSE = (2, 1), (3, 1)  # boxes that are looked through, and that tell where variants differ
_ROUNDING = 2e-6  # of the level: less is rounding of float32
_ALIKE = 0.02  # share by which blurs may differ and count as one
_OPTICS = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
_NEAR, _FAR = 0.25, 0.5  # px by which the footprint is shifted
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

    Where to look is found on the scene's own pixels, so that the maxima hold for the whole image. Raises SceneError:
    the scene holds a number that is not finite; SettingsError: no line to take, or sweeps of several binnings or
    exposures; PoseError: a sweep is out of the mirror's reach.
    """
    taken = _taken(sweeps)
    binnings = {sweep.binning for sweep in taken}
    if len(binnings) > 1:
        raise SettingsError(f"expected sweeps of one binning, got {sorted(binnings)}; probe each of them")
    if len({exposing(rig.camera, sweep) for sweep in taken}) > 1:
        raise SettingsError("expected sweeps of one exposure, got several; probe each of them")
    rig = rig.taking(taken[0])
    binning, camera, bands = binnings.pop(), rig.camera, len(scene.wavelength_nm)
    room = max(min(MOST_VALUES // bands, MOST_SAMPLES), 64)
    lines = views_of_lines(taken, camera, room // 3)
    most = (room - room // 3) // (patch_views(binning) * len({sweep.along for sweep in taken}))
    places = telling_places(scene, camera, taken, max(most, 1 if binning == 1 else _LEAST_PLACES))
    views = joined([lines, views_of_places(places, scene, camera, taken)])
    none = (0.0, 0.0)
    found = [(none, none)]
    for axis in (0, 1):
        both = [(way, 0.0) if axis == 0 else (0.0, way) for way in (-_FAR, -_NEAR, _NEAR, _FAR)]
        found += [(way, none) for way in both] + [(none, way) for way in (both[0], both[3])]
    seen = light_seen(scene, camera, views, _footprint(SLIT.variants[0], rig, _LOOK, None, scene), found)
    means = seen[0, : len(lines.slope)].reshape(-1, line_sums(camera, binning) * binning * bands).mean(axis=1)
    errors = _slit_errors(scene, rig, views, taken, unit)
    usual = np.quantile(seen[0, : len(lines.slope)], np.linspace(0, 1, USUAL_LIGHTS)).astype(np.float64)
    summed = _summed_up(scene, rig, taken, unit, seen, means)
    return replace(summed, slit_errors=errors, usual_e=usual, places=places)


def _taken(sweeps: Sequence[Sweep]) -> tuple[Sweep, ...]:
    taken = tuple(sweep for sweep in sweeps if sweep.lines > 0)
    if not taken:
        raise SettingsError("a scene is summed up for the sweeps that look at it; expected lines to take, got none")
    return taken


def _slit_errors(
    scene: RasterScene, rig: Rig, views: SampleViews, sweeps: tuple[Sweep, ...], unit: Unit
) -> dict[str, float]:
    """Greatest change by every variant of the slit, over the unit: off, or against the finest, beside the rig's blurs.

    Each sweep is seen through the boxes that a variant takes for it.
    """
    views = views.chosen_sums(_roughest(scene, rig, views, unit))
    sweep_of = views.sweep[:: views.binning]
    whole = [views_all_over(rig, sweep, exact=True) for sweep in sweeps]
    errors = dict.fromkeys((*SLIT.variants[1:], OFF), 0.0)
    for moments in _blurs(rig, scene.wavelength_nm, sweeps):
        boxes = {parts: _footprint(SLIT.variants[0], rig, parts, moments, scene) for parts in LADDER}
        finest = light_seen(scene, rig.camera, views, boxes[LADDER[-1]], _PHASES)
        scale = unit_at(_stored(finest, views), rig, unit, views.binning)
        found = {parts: _changes(scene, rig, views, boxes[parts], finest, scale) for parts in LADDER[:-1]}
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
    scene: RasterScene, rig: Rig, views: SampleViews, footprint: Footprint, finest: Light, scale: Light
) -> Floats:
    """Greatest change of each stored number by another footprint, over the unit, (number,): measured, with its sign."""
    change = light_seen(scene, rig.camera, views, footprint, _PHASES) - finest
    change = np.abs(_stored(np.where(np.abs(change) > _ROUNDING * np.abs(finest), change, np.float32(0)), views))
    return np.asarray((change / scale).max(axis=(0, 2)).astype(np.float64))


def _footprint(
    variant: str, rig: Rig, parts: tuple[int, int], moments: Moments | None, scene: RasterScene
) -> Footprint:
    blurs = moments or Moments.together([], len(scene.wavelength_nm))
    return fold(box_of(variant, rig), parts, 1, blurs)


def _blurs(rig: Rig, wavelength_nm: Floats, sweeps: Sequence[Sweep]) -> list[Moments]:
    """All that the rig's optics blur and shift in the sweeps where that is least and most; once where it is the same.

    The slit's variants stand beside all other effects: what leaving out a blur changes is bounded for any slit.
    """
    found = [_moments(rig, wavelength_nm, middle_normal(sweep, rig.camera)) for sweep in sweeps]
    found.sort(key=lambda one: float(_size(one).sum()))
    least, most = found[0], found[-1]
    return [least] if np.allclose(_size(least), _size(most), rtol=_ALIKE) else [least, most]


def _size(blurs: Moments) -> Floats:
    return blurs.variance if blurs.waves is None else blurs.variance + blurs.waves**2


def _moments(rig: Rig, wavelength_nm: Floats, normal: Floats) -> Moments:
    found = [blur.moments(rig, wavelength_nm, blur.variants[0], normal) for blur in _OPTICS]
    return Moments.together(found, len(wavelength_nm))


def _stored(values: Light, views: SampleViews) -> Light:
    """Means over the samples of each stored number, (..., number, band)."""
    return np.asarray(stored_mean(values, views.binning), np.float32)


def _summed_up(scene: RasterScene, rig: Rig, sweeps: tuple[Sweep, ...], unit: Unit, seen: Light, means: Light) -> Probe:
    """Turn light (shift, view, band) and means of lines (line,) into the probe's maxima."""
    camera, binning, least, most = rig.camera, sweeps[0].binning, seen.min(axis=0), seen.max(axis=0)
    darkest, brightest = stored_mean(least, binning), stored_mean(most, binning)
    scale = unit_at(darkest, rig, unit, binning)
    slope, curvature = _derivatives(seen, scale, binning)
    spectral = _spectral_derivatives(seen[0], scene.wavelength_nm, scale, binning)
    low, high = least.min(axis=0), most.max(axis=0)
    level = np.maximum(np.abs(brightest) / unit_at(brightest, rig, unit, binning), np.abs(darkest) / scale)
    off_mean = np.maximum(most - means.min(), means.max() - least)
    off_other = np.maximum(most - low, high - least)
    return Probe(
        unit=unit,
        sweeps=sweeps,
        wavelength_nm=scene.wavelength_nm,
        fwhm_nm=scene.fwhm_nm,
        level=_greatest(level),
        spread=_greatest(stored_mean(_above(off_mean, high), binning) / scale),
        span=_greatest(stored_mean(_above(off_other, high), binning) / scale),
        slope=slope,
        curvature=curvature,
        spectral_slope=spectral[0],
        spectral_curvature=spectral[1],
        brightest_e=float(most.max()),
        darkest_e=float(least.min()),
        unit_least_dn=float(scale.min()) / camera.electrons_per_dn,
        lines=sum(sweep.lines for sweep in sweeps),
        seconds=CostModel().seconds(list(sweeps), camera),
        white_e=scene.panel_electrons.astype(np.float64) * (camera.exposure_ms / DEFAULT_EXPOSURE_MS),
        binning=binning,
    )


def _derivatives(seen: Light, scale: Light, binning: int) -> tuple[Floats, Floats]:
    """Greatest first and second derivatives, (2, band) each over the unit, by differences within half a px.

    Of a stored number the mean size over its samples: they may be moved one way or the other.
    """
    level, high = seen[0], np.abs(seen[0]).max(axis=0)

    def size(difference: Light) -> Floats:
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


def _spectral_derivatives(level: Light, wavelength_nm: Floats, scale: Light, binning: int) -> tuple[Floats, Floats]:
    """Greatest divided differences over wavelength at each band, (band,) each over the unit; 0 where there is none."""
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros(len(nm)), np.zeros(len(nm))
    steep, bend = steepest_difference(level, nm), np.abs(second_difference(level, nm))
    return _greatest(stored_mean(steep, binning) / scale), _greatest(stored_mean(bend, binning) / scale)


def _above(difference: Light, high: Light) -> Light:
    """0 where a difference is no more than rounding."""
    return np.where(difference > _ROUNDING * np.abs(high), difference, np.float32(0))


def _greatest(values: NDArray[np.floating]) -> Floats:
    return np.asarray(values.max(axis=0).astype(np.float64))
