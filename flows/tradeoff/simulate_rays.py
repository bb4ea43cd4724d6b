"""Trade-off of the footprint of slit and pixel: boxes in closed form against so many rays per px, summed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Setting, register
from flows.tradeoff.simulate import FOOTPRINT
from flows.tradeoff.simulated_lines import Against, FarmLines, Light, look_at_lines
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.lazy import Once
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.effects.registry import RAYS
from pipeline.simulator.render import expected_light
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, to_bands

LINES = 2  # of each block
RAYS_PER_PX = (1, 2, 4, 8)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Beside:
    """A ray beside the middle of the footprint, along the line and across, over the mirror. [px of the camera]"""

    run: float
    turn: float

    name = "beside"
    variants = ("rays",)

    def displaced(self, block: SweepBlock, along_px: Floats, scan_px: Floats, variant: str) -> tuple[Floats, Floats]:
        """Give how far from the middle ray it meets the scene. [px]"""
        ifov, normal = block.rig.camera.ifov_rad, position_to_normal(block.middle)[:, None]
        rays = np.stack(np.broadcast_arrays(self.turn * ifov, block.slopes + self.run * ifov, 1.0), axis=-1)
        met = direction_to_scene(reflect(rays, normal)) / ifov
        return met[..., 0] - along_px, met[..., 1] - scan_px


@dataclass(frozen=True)
class Rough:
    """Lines of a farm, their light through slit and pixel alone, and the scene with a band for each component."""

    lines: FarmLines
    against: Against
    components: RasterScene


def _prepare(seed: int) -> Rough:
    lines = look_at_lines(seed)
    few = replace(lines, blocks=tuple(replace(one, lines=one.lines[:LINES]) for one in lines.blocks))
    exact = few.light(_box_alone(few, SLIT.variants[0]))
    return Rough(few, Against.of(exact, few.rig), _as_components(few.scene))


def _box_alone(lines: FarmLines, variant: str) -> dict[Any, str]:
    """Exact rays, slit and pixel."""
    rays: dict[Any, str] = {effect: its for effect, its in lines.exact.items() if effect in RAYS}
    return {**rays, SLIT: variant}


def _as_components(scene: RasterScene) -> RasterScene:
    """A scene whose light is that of its components, one a band: rays are summed before bands are mixed."""
    count = scene.electrons.shape[0]
    ones = np.ones(count, np.float32)
    light = SceneLight(np.eye(count, dtype=np.float32), ones)
    nm = np.arange(1.0, count + 1)
    return replace(scene, light=Once.of(light), panel=ones, wavelength_nm=nm, fwhm_nm=None)


def _run(state: Rough, setting: Setting) -> Light:
    if setting in SLIT.variants:
        return state.lines.light(_box_alone(state.lines, str(setting)))
    return _by_rays(state, int(str(setting).split()[0]))


def _by_rays(state: Rough, per_px: int) -> Light:
    """Light of evenly spaced rays, at least so many per px, each as much as the others."""
    lines, width = state.lines, state.lines.rig.camera.slit_px
    turns, runs = _middles(width, per_px), _middles(1.0, per_px)
    rays: dict[Any, str] = {effect: its for effect, its in lines.exact.items() if effect in RAYS}
    blocks = [
        replace(one, wavelength_nm=state.components.wavelength_nm, fwhm_nm=None, white_e=None) for one in lines.blocks
    ]
    parts = [
        sum(
            expected_light(state.components, block, {**rays, Beside(run, turn): "rays"})
            for turn in turns
            for run in runs
        )
        for block in blocks
    ]
    scale = np.float32(1 / (len(turns) * len(runs)))
    return to_bands(np.concatenate(parts) * scale, lines.scene.electrons)


def _middles(width: float, per_px: int) -> list[float]:
    """Middles of equal parts of a width, each at most 1 / ``per_px`` long."""
    count = int(np.ceil(width * per_px))
    return [float(place) for place in ((np.arange(count) + 0.5) / count - 0.5) * width]


SUPERSAMPLING = register(
    replace(
        FOOTPRINT,
        knob="supersampling",
        reference=f"slit and pixel alone as {SLIT.variants[0]} boxes in closed form",
        settings=(*SLIT.variants, *(f"{count} ray{'s' * (count > 1)}/px" for count in RAYS_PER_PX)),
        prepare=_prepare,
        run=_run,
    )
)
