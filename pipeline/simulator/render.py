"""The light that a block of lines gathers with the effects chosen; and all effects, in the order of the chain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from spectralzoom.pipeline.geometry.mirror import direction_to_scene, position_to_direction, position_to_normal
from spectralzoom.pipeline.geometry.scan import Floats, Sweep, line_positions, shifted_position
from spectralzoom.pipeline.simulator.effects.air import ABSORPTION, PARALLAX, PATH_RADIANCE, TURBULENCE, WIND
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.counting import GAUSSIAN, READ_NOISE, READOUT, SATURATION, SHOT
from spectralzoom.pipeline.simulator.effects.effect import OFF, Chosen, Effect, Radiance, SweepBlock
from spectralzoom.pipeline.simulator.effects.lighting import BRDF, CLOUD, DRIFT, POLARISATION, VIGNETTING
from spectralzoom.pipeline.simulator.effects.line import BOXES, FOLDED, ROTATION, SLIT, SMEAR, box_of, smeared_positions
from spectralzoom.pipeline.simulator.effects.pointing import HYSTERESIS, JITTER, LAG, STAIRCASE, THERMAL_DRIFT
from spectralzoom.pipeline.simulator.effects.spectrometer import PRNU, RESPONSE, SMILE, STRAY_LIGHT, STRIPING
from spectralzoom.pipeline.simulator.optics.kernel_fit import Moments, fold
from spectralzoom.pipeline.simulator.optics.rays import RayViews, exact_views, middle_normal
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene

if TYPE_CHECKING:
    from spectralzoom.pipeline.simulator.optics.scene_radiance import SceneSampler

PROBES = 17  # lines of a sweep and samples of a line that tell how far a footprint's shape varies


def expected_light(scene: RasterScene, block: SweepBlock, chosen: Chosen) -> Radiance:
    """Return the electrons that the samples of some lines gather on average, before the readout.

    Without effects the camera stands still and its lines lie straight. Returns (line, sample, band) float32. [e-]
    Raises PoseError: a position, with what aims add, is out of the mirror's reach.
    """
    steps = [views.flat() for views in _views(block, chosen, scene.shape)]
    of_the_line = tuple(chosen.get(effect, OFF) for effect in (SLIT, SMEAR, ROTATION))
    sampler = _sampler(block.rig, block.sweep, block.wavelength_nm.tobytes(), _doing(chosen, "moments"), of_the_line)
    ratio = block.rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS
    light = sampler.scan_pass(scene, steps, along_y=block.sweep.along == "y", exposure_ratio=ratio)
    light = light.reshape(len(block.lines), -1, light.shape[1])
    pending: Radiance | None = None
    for effect, variant in chosen.items():
        if hasattr(effect, "gain"):
            gain = effect.gain(block, variant)
            if gain.shape[-1] == 1:
                pending = gain if pending is None else pending * gain
            else:
                light *= gain
        elif hasattr(effect, "change"):
            if pending is not None and not getattr(effect, "within_spectra", False):
                light *= pending
                pending = None
            light = effect.change(light, block, variant)
    if pending is not None:
        light *= pending
    return light


def _doing(chosen: Chosen, action: str) -> tuple[tuple[Any, str], ...]:
    return tuple((effect, variant) for effect, variant in chosen.items() if hasattr(effect, action))


def _views(block: SweepBlock, chosen: Chosen, shape: tuple[int, int]) -> Iterator[RayViews]:
    """Yield where the samples look at each held position, aims included, (line, sample) each. [px of the scene]"""
    position = smeared_positions(block, chosen.get(SMEAR, OFF))
    for aim, variant in _doing(chosen, "aim"):
        shift = aim.aim(block, variant)
        if shift.shape[1] not in (1, position.shape[1]) and block.sweep.positions > 1:  # its course is not followed
            shift = shift.mean(axis=1, keepdims=True)
        position = shifted_position(position, shift, block.rig.camera)
    ifov = block.rig.camera.ifov_rad
    size = shape if block.sweep.along == "y" else shape[::-1]
    for step in range(position.shape[1]):
        views = _tangents(position[:, step, None], block.slopes, exact=chosen.get(ROTATION, OFF) != OFF)
        along, scan = views.along / ifov, views.scan / ifov
        for displacement, variant in _doing(chosen, "displaced"):
            beside = displacement.displaced(block, along, scan, variant)
            along, scan = along + beside[0], scan + beside[1]
        yield replace(views, along=along + (size[0] - 1) / 2, scan=scan + (size[1] - 1) / 2)


def _tangents(position: Floats, slopes: Floats, *, exact: bool) -> RayViews:
    if exact:
        return exact_views(position_to_normal(position), 0.0, slopes)
    centre = direction_to_scene(position_to_direction(position))
    along = centre[..., 0] + slopes  # lines lie straight along their axis
    one, none = np.ones(along.shape), np.zeros(along.shape)
    return RayViews(along, np.broadcast_to(centre[..., 1], along.shape), one, none, none, one)


@lru_cache(maxsize=2)  # its tables take up to 630 MB, in the most oblique sweep of 10 240 px
def _sampler(
    rig: Rig, sweep: Sweep, wavelengths: bytes, blurs: tuple[tuple[Any, str], ...], of_the_line: tuple[str, ...]
) -> SceneSampler:
    from spectralzoom.pipeline.simulator.optics.scene_radiance import SceneSampler

    wavelength = np.frombuffer(wavelengths)
    normal = middle_normal(sweep, rig.camera)
    moments = [blur.moments(rig, wavelength, variant, normal) for blur, variant in blurs]
    slit, smear, rotation = of_the_line
    whole = line_positions(replace(sweep, lines=max(sweep.lines, 1)), rig.camera)
    lines = np.linspace(0, len(whole) - 1, PROBES).round().astype(np.intp)
    slopes = np.linspace(-0.5, 0.5, PROBES) * rig.camera.samples * rig.camera.ifov_rad
    # all over the sweep: the shape of a footprint varies smoothly between these views
    views = _tangents(whole[lines][:, None], slopes, exact=rotation != OFF).flat()
    together = Moments.together(moments, len(wavelength))
    held = sweep.positions if smear == FOLDED else 1  # positions, 1 px apart, that the footprint itself holds
    return SceneSampler(fold(box_of(slit, rig), BOXES.get(slit, (1, 1)), held, together), views)


AIMS: tuple[Effect, ...] = (STAIRCASE, LAG, JITTER, HYSTERESIS, THERMAL_DRIFT, TURBULENCE)
RAYS: tuple[Effect, ...] = (ROTATION, PARALLAX, WIND)
FOOTPRINT: tuple[Effect, ...] = (SLIT, SMEAR, DIFFRACTION, DEFOCUS, ABERRATION, KEYSTONE)
LIGHT: tuple[Effect, ...] = (
    *(DRIFT, CLOUD, BRDF, PATH_RADIANCE, ABSORPTION),
    *(RESPONSE, SMILE, VIGNETTING, POLARISATION, STRAY_LIGHT, PRNU, STRIPING),
)
EFFECTS: tuple[Effect, ...] = (*AIMS, *RAYS, *FOOTPRINT, *LIGHT, *READOUT)
BY_NAME = MappingProxyType({effect.name: effect for effect in EFFECTS})
# effects of any camera behind a mirror: a farm changes by .015 sigma at most beside exact ones
USUAL: dict[Any, str] = {ROTATION: "rays", SLIT: "3x1", SMEAR: FOLDED, VIGNETTING: "held"}
USUAL |= {SHOT: GAUSSIAN, READ_NOISE: "exact", SATURATION: "exact"}
