"""Sums up a scene as a survey is going to see it: a close look at the telling places and along lines of all sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep, exposing
from pipeline.lazy import deferred
from pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.line import SLIT, UPRIGHT, box_of, box_parts
from pipeline.simulator.effects.probe import Probe, Unit, stored_mean, unit_at
from pipeline.simulator.effects.registry import EFFECTS
from pipeline.simulator.optics.kernel_fit import Footprint, Moments, fold
from pipeline.simulator.optics.rays import middle_normal
from pipeline.simulator.optics.tap_sums import LADDER
from pipeline.simulator.render import views_all_over
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene
from pipeline.simulator.selection.brought_light import greatest_way_px
from pipeline.simulator.selection.light_maxima import SHIFTS, LinesLooked, sum_up_looks, worst_of_groups
from pipeline.simulator.selection.line_means import line_means
from pipeline.simulator.selection.reached_cells import reached_cells
from pipeline.simulator.selection.sample_views import (
    SampleViews,
    joined,
    light_seen,
    patch_views,
    places_beyond,
    views_of_lines,
    views_of_places,
)
from pipeline.simulator.selection.surroundings import REACHES
from pipeline.simulator.selection.telling_places import TELLING_BANDS, TellingPlaces, telling_places

if TYPE_CHECKING:
    from pipeline.simulator.selection import change_loops
else:
    change_loops = deferred("pipeline.simulator.selection.change_loops")

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
MOST_VALUES = 1_000_000  # samples times bands; each is seen a few times over, a fraction of a px apart
MOST_SAMPLES = 6_000
USUAL_LIGHTS = 101  # quantiles of the light that are kept
FINEST_SAMPLES = 1000  # at which variants of the slit are held against the finest
_LEAST_OF_SWEEP = 50
_LEAST_PLACES = 24  # that are looked at where samples are summed, however many samples that takes
_LOOK, _CLOSE = (2, 1), (3, 1)  # boxes that are looked through, and that tell where variants differ
_ROUNDING = 2e-6  # of the level: less is rounding of float32
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
    most = max(most, 1 if binning == 1 else _LEAST_PLACES)
    cells = reached_cells(scene.shape, camera, taken)
    counts = (most, *(max(most // 4, 1) for _ in REACHES), _FAR_PLACES)
    places = telling_places(scene, camera, taken, cells, REACHES, counts)
    own = joined([lines, views_of_places(places.seen, scene, camera, taken)])
    beside = _views_beside(scene, camera, taken, places)
    views = joined([own, *beside])
    seen = light_seen(scene, camera, views, _footprint(SLIT.variants[0], rig, _LOOK, None, scene), SHIFTS)
    ends = np.cumsum([len(one.slope) for one in (own, *beside)])
    looks = LinesLooked.of(np.split(seen, ends[:-1], axis=1), binning, rig, unit)
    summed = sum_up_looks(looks, scene, taken, line_means(scene, camera, taken, _LINES_BESIDE if beside else (0.0,)))
    usual = np.quantile(seen[0, : len(lines.slope)], np.linspace(0, 1, USUAL_LIGHTS)).astype(np.float64)
    found = replace(summed, usual_e=usual, places=places.seen)
    if beside:
        found = replace(found, **looks.beside(scene, cells.covers))
    moved_to = _within(beside, greatest_way_px(found, rig, EFFECTS)) if beside else []
    found = replace(found, slit_errors=_slit_errors(scene, rig, joined([own, *moved_to]), taken, unit))
    return worst_of_groups(found) if scene.electrons.ndim == 1 and bands > TELLING_BANDS else found


def _within(beside: Sequence[SampleViews], way_px: float) -> list[SampleViews]:
    """Those of the views beside the sweeps to which shifts of the image may bring its samples."""
    return [one for one, nearer in zip(beside, (0.0, *REACHES), strict=True) if nearer < way_px]


def _views_beside(
    scene: RasterScene, camera: LineCamera, sweeps: tuple[Sweep, ...], places: TellingPlaces
) -> list[SampleViews]:
    """Patches beside the sweeps, within each reach of them and farther; none where nothing is."""
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
    """Greatest change by every variant of the slit, over the unit: off, or against the finest, beside the rig's blurs.

    Each sweep is seen through the boxes that a variant takes for it.
    """
    views = views.chosen_sums(_roughest(scene, rig, views, unit))
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
    scene: RasterScene, rig: Rig, views: SampleViews, footprint: Footprint, finest: Light, scale: Light
) -> Floats:
    """Greatest change of each stored number by another footprint, over the unit, (number,): measured, with its sign."""
    light, greatest = light_seen(scene, rig.camera, views, footprint, _PHASES), np.zeros(views.sums)
    change_loops.greatest_changes(light, finest, scale, views.binning, _ROUNDING, greatest)
    return greatest


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
    return blurs.spread if blurs.waves is None else blurs.spread + blurs.waves**2


def _moments(rig: Rig, wavelength_nm: Floats, normal: Floats) -> Moments:
    found = [blur.moments(rig, wavelength_nm, blur.variants[0], normal) for blur in _OPTICS]
    return Moments.together(found, len(wavelength_nm))


def _stored(values: Light, views: SampleViews) -> Light:
    """Means over the samples of each stored number, (..., number, band)."""
    return np.asarray(stored_mean(values, views.binning), np.float32)
