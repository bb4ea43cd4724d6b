"""Sums up a scene as a survey is going to see it: a close look at the telling places and along lines of all sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.scan import CostModel, Sweep
from pipeline.simulator.band_differences import second_difference, steepest_difference
from pipeline.simulator.effects.aberration import ABERRATION
from pipeline.simulator.effects.defocus import DEFOCUS
from pipeline.simulator.effects.diffraction import DIFFRACTION
from pipeline.simulator.effects.effect import OFF, Moments
from pipeline.simulator.effects.keystone import KEYSTONE
from pipeline.simulator.effects.pupil import middle_normal
from pipeline.simulator.effects.slit import SLIT, box_of, box_parts
from pipeline.simulator.effects.turned import UPRIGHT
from pipeline.simulator.footprint import Footprint, fold
from pipeline.simulator.parting import LADDER
from pipeline.simulator.probe import Probe, Unit
from pipeline.simulator.render import views_all_over
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, RasterScene, Scene
from pipeline.simulator.scouting import telling_places
from pipeline.simulator.survey_looks import (
    PATCH_VIEWS,
    SampleViews,
    joined,
    light_seen,
    line_samples,
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
_LOOK, _CLOSE = (2, 1), (3, 1)  # boxes that are looked through, and that tell where variants differ
_ROUNDING = 2e-6  # of the level: less is rounding of float32
_ALIKE = 0.02  # share by which blurs may differ and count as one
_OPTICS = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
_NEAR, _FAR = 0.25, 0.5  # px by which the footprint is shifted
_PHASES = tuple(((along, scan), (0.0, 0.0)) for along in (0.0, 0.5) for scan in (0.0, 0.5))  # at which boxes differ


def noise_electrons(signal: Light, rig: Rig) -> Light:
    """Give one standard deviation of shot noise, read noise and quantisation at each signal; never 0. [e-]"""
    camera, quantised = rig.camera, rig.camera.electrons_per_dn**2 / 12
    if rig.detector.noiseless:
        return np.full_like(signal, np.sqrt(quantised))
    return np.sqrt(np.maximum(signal, 0) + np.float32(camera.read_noise_e**2 + quantised))


def probe_scene(scene: Scene, rig: Rig, sweeps: Sequence[Sweep], unit: Unit = "sigma") -> Probe:
    """Look at the scene through the footprint alone where it is steepest, brightest and darkest, and along some lines.

    Where to look is found on the scene's own pixels (`scouting`), so that the maxima hold for the whole image and not
    for the looks alone.

    Raises
    ------
    SceneError : the scene holds a number that is not finite; the message says where.
    SettingsError : there is no line to take.
    PoseError : a sweep is out of the mirror's reach.
    """
    taken = tuple(sweep for sweep in sweeps if sweep.lines > 0)
    if not taken:
        raise SettingsError("a scene is summed up for the sweeps that look at it; expected lines to take, got none")
    camera, bands = rig.camera, len(scene.wavelength_nm)
    room = max(min(MOST_VALUES // bands, MOST_SAMPLES), 64)
    lines = views_of_lines(taken, camera, room // 3)
    most = (room - room // 3) // (PATCH_VIEWS * len({sweep.along for sweep in taken}))
    places = telling_places(scene, camera, taken, max(most, 1))
    views = joined([lines, views_of_places(places, scene, camera, taken)])
    seen = light_seen(scene, camera, views, _footprint(SLIT.variants[0], rig, _LOOK, None, scene), _shifts())
    means = seen[0, : len(lines.slope)].reshape(-1, line_samples(camera) * bands).mean(axis=1)
    errors = _slit_errors(scene, rig, views, taken, unit)
    usual = np.quantile(seen[0, : len(lines.slope)], np.linspace(0, 1, USUAL_LIGHTS)).astype(np.float64)
    summed = _summed_up(scene, rig, taken, unit, seen, means)
    return replace(summed, slit_errors=errors, usual_e=usual, places=places)


def _slit_errors(scene: Scene, rig: Rig, views: SampleViews, sweeps: tuple[Sweep, ...], unit: Unit) -> dict[str, float]:
    """Greatest change by every variant of the slit, over the unit: off, or against the finest, beside the rig's blurs.

    Each sweep is seen through the boxes that a variant takes for it. Scenes without pixels know no boxes.
    """
    ladder = LADDER if isinstance(scene, RasterScene) else LADDER[-1:]
    views = views.chosen(_roughest(scene, rig, views, unit))
    whole = [views_all_over(rig, sweep, exact=True) for sweep in sweeps]
    errors = dict.fromkeys((*SLIT.variants[1:], OFF), 0.0)
    for moments in _blurs(rig, scene.wavelength_nm, sweeps):
        boxes = {parts: _footprint(SLIT.variants[0], rig, parts, moments, scene) for parts in ladder}
        finest = light_seen(scene, rig.camera, views, boxes[LADDER[-1]], _PHASES)
        scale = _unit(finest, rig, unit)
        found = {parts: _changes(scene, rig, views, boxes[parts], finest, scale) for parts in ladder[:-1]}
        found[LADDER[-1]] = np.zeros(len(views.slope))
        for variant in SLIT.variants[1:]:
            taken = [box_parts(variant, rig, one) for one in whole]
            seen = [found.get(parts, found[LADDER[-1]])[views.sweep == number] for number, parts in enumerate(taken)]
            errors[variant] = max(errors[variant], *(float(one.max(initial=0.0)) for one in seen))
        off = _changes(scene, rig, views, _footprint(OFF, rig, (1, 1), moments, scene), finest, scale)
        errors[OFF] = max(errors[OFF], float(off.max(initial=0.0)))
    return errors


def _roughest(scene: Scene, rig: Rig, views: SampleViews, unit: Unit) -> NDArray[np.intp]:
    """Views where a middle ray, and a box that does not lie turned, differ most: of all, and of every sweep's own."""
    boxes = _footprint(SLIT.variants[0], rig, _CLOSE, None, scene)
    close = light_seen(scene, rig.camera, views, boxes, _PHASES)
    scale, found = _unit(close, rig, unit), []
    for variant in (OFF, UPRIGHT):
        other = _footprint(variant, rig, (1, 1), None, scene)
        order = np.argsort(-_changes(scene, rig, views, other, close, scale), kind="stable")
        found.append(order[: FINEST_SAMPLES // 2])
        numbers = np.unique(views.sweep)
        each = max(FINEST_SAMPLES // 2 // len(numbers), _LEAST_OF_SWEEP)
        found += [order[views.sweep[order] == number][:each] for number in numbers]
    return np.unique(np.concatenate(found))


def _changes(scene: Scene, rig: Rig, views: SampleViews, footprint: Footprint, finest: Light, scale: Light) -> Floats:
    """Greatest change of each view by another footprint, over the unit, (view,)."""
    other = light_seen(scene, rig.camera, views, footprint, _PHASES)
    greatest: Floats = (_above(np.abs(other - finest), finest) / scale).max(axis=(0, 2)).astype(np.float64)
    return greatest


def _footprint(variant: str, rig: Rig, parts: tuple[int, int], moments: Moments | None, scene: Scene) -> Footprint:
    blurs = moments or Moments.together([], len(scene.wavelength_nm))
    return fold(box_of(variant, rig), parts, 1, blurs)


def _blurs(rig: Rig, wavelength_nm: Floats, sweeps: Sequence[Sweep]) -> list[Moments]:
    """All that the rig's optics blur and shift in the sweeps where that is least and most; once where it is the same.

    The slit's variants stand beside all other effects: what leaving out a blur changes is bounded for any slit.
    """
    found = [_moments(rig, wavelength_nm, middle_normal(sweep, rig)) for sweep in sweeps]
    found.sort(key=lambda one: float(_size(one).sum()))
    least, most = found[0], found[-1]
    return [least] if np.allclose(_size(least), _size(most), rtol=_ALIKE) else [least, most]


def _size(blurs: Moments) -> Floats:
    return blurs.variance if blurs.waves is None else blurs.variance + blurs.waves**2


def _moments(rig: Rig, wavelength_nm: Floats, normal: Floats) -> Moments:
    found = [blur.moments(rig, wavelength_nm, blur.variants[0], normal) for blur in _OPTICS]
    return Moments.together(found, len(wavelength_nm))


def _unit(light: Light, rig: Rig, unit: Unit) -> Light:
    """One unit of the tolerance at each light [e-]."""
    return noise_electrons(light, rig) if unit == "sigma" else np.full_like(light, rig.camera.electrons_per_dn)


def _shifts() -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """None first; then along and across in turn: the camera's rays by -far, -near, near, far, points by -far, far."""
    none = (0.0, 0.0)
    found = [(none, none)]
    for axis in (0, 1):
        both = [(way, 0.0) if axis == 0 else (0.0, way) for way in (-_FAR, -_NEAR, _NEAR, _FAR)]
        found += [(way, none) for way in both] + [(none, way) for way in (both[0], both[3])]
    return found


def _summed_up(scene: Scene, rig: Rig, sweeps: tuple[Sweep, ...], unit: Unit, seen: Light, means: Light) -> Probe:
    """Turn light (shift, view, band) and means of lines (line,) into the probe's maxima."""
    camera, level, least, most = rig.camera, seen[0], seen.min(axis=0), seen.max(axis=0)
    scale = _unit(least, rig, unit)
    slope, curvature = _derivatives(seen, scale)
    spectral = _spectral_derivatives(level, scene.wavelength_nm, scale)
    low, high = least.min(axis=0), most.max(axis=0)
    off_mean = np.maximum(most - means.min(), means.max() - least)
    off_other = np.maximum(most - low, high - least)
    return Probe(
        unit=unit, sweeps=sweeps, wavelength_nm=scene.wavelength_nm, fwhm_nm=scene.fwhm_nm,
        level=_greatest(np.abs(most) / _unit(most, rig, unit)),
        spread=_greatest(_above(off_mean, high) / scale),
        span=_greatest(_above(off_other, high) / scale),
        slope=slope, curvature=curvature, spectral_slope=spectral[0], spectral_curvature=spectral[1],
        brightest_e=float(most.max()), darkest_e=float(least.min()),
        unit_least_dn=float(noise_electrons(least, rig).min()) / camera.electrons_per_dn if unit == "sigma" else 1.0,
        lines=sum(sweep.lines for sweep in sweeps), seconds=CostModel().seconds(list(sweeps), camera),
        white_e=scene.panel_electrons.astype(np.float64) * (camera.exposure_ms / DEFAULT_EXPOSURE_MS),
    )  # fmt: skip


def _derivatives(seen: Light, scale: Light) -> tuple[Floats, Floats]:
    """Greatest first and second derivatives, (2, band) each over the unit, by differences within half a px."""
    level, high = seen[0], np.abs(seen[0]).max(axis=0)
    slope, curvature = [], []
    for axis in (0, 1):
        behind, back, ahead, front, before, after = seen[1 + 6 * axis : 7 + 6 * axis]
        pairs = [(behind, back, _NEAR), (back, level, _NEAR), (level, ahead, _NEAR), (ahead, front, _NEAR),
                 (before, level, _FAR), (level, after, _FAR)]  # fmt: skip
        triples = [(back, ahead, _NEAR), (behind, front, _FAR), (before, after, _FAR)]
        slope.append(np.max([_greatest(_above(np.abs(b - a), high) / scale) / way for a, b, way in pairs], axis=0))
        bends = [_greatest(_above(np.abs(a + b - 2 * level), high) / scale) / way**2 for a, b, way in triples]
        curvature.append(np.max(bends, axis=0))
    return np.array(slope), np.array(curvature)


def _spectral_derivatives(level: Light, wavelength_nm: Floats, scale: Light) -> tuple[Floats, Floats]:
    """Greatest divided differences over wavelength at each band, (band,) each over the unit; 0 where there is none."""
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros(len(nm)), np.zeros(len(nm))
    bend = np.abs(second_difference(level, nm)) / scale
    return _greatest(steepest_difference(level, nm) / scale), _greatest(bend)


def _above(difference: Light, high: Light) -> Light:
    """0 where a difference is no more than rounding."""
    return np.where(difference > _ROUNDING * np.abs(high), difference, np.float32(0))


def _greatest(values: NDArray[np.floating]) -> Floats:
    greatest: Floats = values.max(axis=0).astype(np.float64)
    return greatest
