"""The light that a block of lines gathers: rays through mirror and slit to the scene, with the effects chosen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError
from pipeline.mirror import direction_to_scene, position_to_direction, position_to_normal
from pipeline.scan import shifted_position
from pipeline.simulator.block import Block
from pipeline.simulator.effects.effect import OFF, Effect
from pipeline.simulator.effects.pupil import middle_normal
from pipeline.simulator.effects.slit import box_rays
from pipeline.simulator.effects.smear import smeared_positions
from pipeline.simulator.footprint import Footprint, fold
from pipeline.simulator.rays import exact_tangents, straight_tangents
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
_Ray = tuple[Floats, Floats, int, float]  # rows, columns, number and weight of the held position

RAYS_AT_ONCE = 16  # held in memory until they are summed


@dataclass(frozen=True)
class Choice:
    """Effects that are on, each with its variant, in the order of the chain; those of the readout may be among them.

    ``slit``, ``smear`` and ``rotation`` are told by their names, the others by what they do.
    """

    effects: tuple[tuple[Effect, str], ...] = ()

    @staticmethod
    def of(chosen: Mapping[Any, str] | Choice) -> Choice:
        """Take a mapping {effect: variant}, in the order of the chain; effects that are off may be among them.

        Raises
        ------
        SettingsError : an effect has no such variant.
        """
        if isinstance(chosen, Choice):
            return chosen
        for effect, variant in chosen.items():
            if variant not in (*effect.variants, OFF):
                raise SettingsError(f"effect {effect.name} has no variant {variant!r}; choose from {effect.variants}")
        return Choice(tuple((effect, variant) for effect, variant in chosen.items() if variant != OFF))

    def variant(self, name: str) -> str:
        """Give the variant of an effect by its name; off where it is not chosen."""
        return next((variant for effect, variant in self.effects if effect.name == name), OFF)

    def doing(self, action: str) -> Iterator[tuple[Any, str]]:
        """Give the effects that have this action, as (effect, variant) in the order of the chain."""
        return ((effect, variant) for effect, variant in self.effects if hasattr(effect, action))


def expected_light(scene: Scene, block: Block, chosen: Mapping[Any, str] | Choice) -> Light:
    """Give the electrons that the samples of some lines gather on average, before the readout.

    Parameters
    ----------
    chosen
        The effects that are on, in the order of the chain, each with its variant; none is a camera of rays that
        stands still and whose lines lie straight.

    Returns
    -------
    (line, sample, band) float32, the block's samples. [e-]

    Raises
    ------
    PoseError : a position, with what aims add, is out of the mirror's reach.
    SettingsError : an effect has no such variant.
    """
    choice = Choice.of(chosen)
    light = _seen(scene, block, choice)
    for effect, variant in choice.effects:
        if hasattr(effect, "gain"):
            light *= effect.gain(block, variant)
        elif hasattr(effect, "change"):
            light = effect.change(light, block, variant)
    return light


def folded_footprint(block: Block, choice: Choice) -> Footprint:
    """Fold slit, pixel and the blurs that are on into the rays that each sample of a sweep takes."""
    rig, bands, normal = block.rig, len(block.wavelength_nm), middle_normal(block.sweep, block.rig)
    shift, variance = np.zeros((2, bands)), np.zeros((2, bands))
    for blur, variant in choice.doing("moments"):
        moments = blur.moments(rig, block.wavelength_nm, variant, normal)
        shift, variance = shift + moments.shift, variance + moments.variance
    slit = choice.variant("slit")
    boxes = (0.0, 0.0) if slit == OFF else (rig.camera.slit_px, 1.0)
    return fold(boxes, box_rays(slit, rig.camera.slit_px), shift, variance)


def held_positions(block: Block, choice: Choice) -> tuple[Floats, Floats]:
    """Give what the mirror holds in each exposure, aims included, (line, step, 2), and (step,) weights of sum 1."""
    position, weight = smeared_positions(block, choice.variant("smear"))
    for aim, variant in choice.doing("aim"):
        shift = aim.aim(block, variant)
        if shift.shape[1] not in (1, position.shape[1]) and block.sweep.step > 1:  # the mirror's course is not followed
            shift = shift.mean(axis=1, keepdims=True)
        position = shifted_position(position, shift, block.rig.camera)
    steps = position.shape[1]
    return position, weight if len(weight) == steps else np.full(steps, 1 / steps)


def _seen(scene: Scene, block: Block, choice: Choice) -> Light:
    """Light of the block through the folded footprint, (line, sample, band)."""
    footprint = folded_footprint(block, choice)
    spectra = scene.electrons * np.float32(block.rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    size = (len(block.lines), len(block.columns))
    points = _points(block, choice, footprint, scene.shape)
    if spectra.ndim == 1:  # every band has a plane of its own, and so weights of its own
        light = np.zeros((size[0] * size[1], len(spectra)), np.float32)
        for y, x, ray, weight in points:
            light += scene.sample(y, x) * (footprint.weight[ray] * weight).astype(np.float32)
        light *= spectra
        return light.reshape(*size, len(spectra))
    rays, bands = footprint.kernels()
    parts = _parted(scene, points, rays.astype(np.float32), size[0] * size[1], len(spectra))
    mixing = bands.astype(np.float32)[:, None] * spectra  # (kernel, component, band)
    mixed: Light = parts @ mixing.reshape(-1, mixing.shape[2])
    return mixed.reshape(*size, mixing.shape[2])


def _parted(scene: Scene, points: Iterable[_Ray], rays: Light, count: int, components: int) -> Light:
    """Sum the components along all rays under each kernel, (point, kernel * component)."""
    parts = np.zeros((rays.shape[1], count * components), np.float32)
    met = iter(points)
    while some := list(islice(met, RAYS_AT_ONCE)):
        weight = np.stack([rays[ray] * np.float32(held) for _, _, ray, held in some], axis=1)
        parts += weight @ np.stack([scene.sample(y, x).reshape(-1) for y, x, _, _ in some])
    return parts.reshape(-1, count, components).transpose(1, 0, 2).reshape(count, -1)


def _points(block: Block, choice: Choice, footprint: Footprint, shape: tuple[int, int]) -> Iterator[_Ray]:
    """Rows and columns of the scene that every ray of every held position meets, its number and its position's weight.

    Each is (line * sample,).
    """
    position, weights = held_positions(block, choice)
    displacements = list(choice.doing("displaced"))
    exact = choice.variant("rotation") != OFF
    pose = position_to_normal(position) if exact else direction_to_scene(position_to_direction(position))
    ifov = block.rig.camera.ifov_rad
    meet = exact_tangents if exact else straight_tangents
    for step, weight in enumerate(weights):
        for ray, (turn, run) in enumerate(zip(footprint.across, footprint.along, strict=True)):
            along, scan = meet(pose[:, step, None], turn * ifov, block.slopes + run * ifov)
            along, scan = along / ifov, scan / ifov
            for displacement, variant in displacements:
                beside = displacement.displaced(block, along, scan, variant)
                along, scan = along + beside[0], scan + beside[1]
            y, x = (scan, along) if block.sweep.along == "x" else (along, scan)
            yield (y + (shape[0] - 1) / 2).ravel(), (x + (shape[1] - 1) / 2).ravel(), ray, float(weight)
