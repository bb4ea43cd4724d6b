"""Sums up a scene as a survey is going to see it: a close look at the telling places and along lines of all sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.scan import CostModel, Sweep
from pipeline.simulator.effects.aberration import ABERRATION
from pipeline.simulator.effects.defocus import DEFOCUS
from pipeline.simulator.effects.diffraction import DIFFRACTION
from pipeline.simulator.effects.effect import OFF, Moments
from pipeline.simulator.effects.keystone import KEYSTONE
from pipeline.simulator.effects.slit import SLIT, box_of, box_parts
from pipeline.simulator.footprint import Footprint, fold
from pipeline.simulator.probe import Probe, Unit
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene
from pipeline.simulator.scouting import telling_places
from pipeline.simulator.survey_looks import (
    PATCH_VIEWS,
    SampleViews,
    joined,
    light_seen,
    line_samples,
    rays_of,
    views_of_lines,
    views_of_places,
)

Floats = NDArray[np.float64]
Light = NDArray[np.float32]

MOST_VALUES = 1_000_000  # samples times bands; each is seen a few times over, a fraction of a px apart
MOST_SAMPLES = 12_000
FINEST_SAMPLES = 2000  # at which variants of the slit are held against the finest
_LOOK = "2x1"  # variant of the slit that is looked through
_ROUNDING = 2e-6  # of the level: less is rounding of float32
_NEAR, _FAR = 0.25, 0.5  # px by which the footprint is shifted


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
    seen = light_seen(scene, camera, views, _footprint(_LOOK, rig, bands), _shifts())
    means = seen[0, : len(lines.slope)].reshape(-1, line_samples(camera) * bands).mean(axis=1)
    errors = _slit_errors(scene, rig, views, seen[0], unit)
    return replace(_summed_up(scene, rig, taken, unit, seen, means), slit_errors=errors)


def _slit_errors(scene: Scene, rig: Rig, views: SampleViews, level: Light, unit: Unit) -> dict[str, float]:
    """Greatest change by every variant of the slit, over the unit: off, or against the finest; with blurs and without.

    Off is measured everywhere, all others where the middle ray's light differs most from the footprint's, in half of
    the places weighed by how far the footprint lies turned.
    """
    camera, bands, nm = rig.camera, level.shape[1], scene.wavelength_nm
    ray = light_seen(scene, camera, views, _footprint(OFF, rig, bands))[0]
    off = (_above(np.abs(ray - level), level) / _unit(level, rig, unit)).max(axis=1)
    turned = rays_of(views, camera)
    ranks = [np.argsort(-worth)[: FINEST_SAMPLES // 2] for worth in (off, off * np.abs(turned.along_turn))]
    rough = views.chosen(np.unique(np.concatenate(ranks)))
    errors = {OFF: float(off.max(initial=0.0)), **dict.fromkeys(SLIT.variants[1:], 0.0)}
    for moments in (None, _blurs(rig, nm)):
        finest = light_seen(scene, camera, rough, _footprint(SLIT.variants[0], rig, bands, moments))[0]
        for variant in errors:
            other = light_seen(scene, camera, rough, _footprint(variant, rig, bands, moments))[0]
            change = _above(np.abs(other - finest), finest) / _unit(finest, rig, unit)
            errors[variant] = max(errors[variant], float(change.max(initial=0.0)))
    return errors


def _footprint(variant: str, rig: Rig, bands: int, moments: Moments | None = None) -> Footprint:
    shift, variance = (np.zeros((2, bands)),) * 2 if moments is None else (moments.shift, moments.variance)
    return fold(box_of(variant, rig), box_parts(variant), 1, shift, variance)


def _blurs(rig: Rig, wavelength_nm: Floats) -> Moments:
    """All that the rig's optics blur and shift, with the mirror at rest."""
    blurs = (DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
    found = [blur.moments(rig, wavelength_nm, blur.variants[0]) for blur in blurs]
    none = np.zeros((2, len(wavelength_nm)))
    return Moments(sum((one.shift for one in found), none), sum((one.variance for one in found), none))


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
    bands = len(wavelength_nm)
    slope, curvature = np.zeros(bands), np.zeros(bands)
    if bands < 2:
        return slope, curvature
    step = np.diff(wavelength_nm)
    rise = np.diff(level, axis=1)
    for side in (slice(None, -1), slice(1, None)):
        slope[side] = np.maximum(slope[side], _greatest(np.abs(rise) / scale[:, side]) / np.abs(step))
    if bands > 2:
        bend = np.abs(np.diff(rise / step.astype(np.float32), axis=1)) / scale[:, 1:-1]
        curvature[1:-1] = _greatest(bend) / np.abs((step[1:] + step[:-1]) / 2)
    return slope, curvature


def _above(difference: Light, high: Light) -> Light:
    """0 where a difference is no more than rounding."""
    return np.where(difference > _ROUNDING * np.abs(high), difference, np.float32(0))


def _greatest(values: NDArray[np.floating]) -> Floats:
    greatest: Floats = values.max(axis=0).astype(np.float64)
    return greatest
