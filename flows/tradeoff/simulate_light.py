"""Trade-offs of light: groups of bands that are blurred alike, bands to mix in, and boxes or rays for the footprint."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from flows.tradeoff.entries import Setting, Tradeoff, register_all
from flows.tradeoff.simulate import FOOTPRINT, Against, FarmLines, Light, Seen, look_at_lines, prepare_footprint
from pipeline.geometry.mirror import direction_to_scene, position_to_normal, reflect
from pipeline.lazy import Once
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.effects.registry import RAYS
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, to_bands

EACH = "each band"
GROUPS = (6, 4, 3, 2, 1)
BANDS = (270, 135, 90, 60, 30, 15)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Shared:
    """A blur that neighbouring bands share: all bands of a group have the means of shifts, variances, waves."""

    blur: Any
    groups: int

    @property
    def name(self) -> str:
        return str(self.blur.name)

    @property
    def variants(self) -> tuple[str, ...]:
        return tuple(self.blur.variants)

    def moments(self, rig: Rig, wavelength_nm: Floats, variant: str, normal: Floats | None = None) -> Moments:
        """Give shift and variance of each band, the same for all of a group."""
        own = self.blur.moments(rig, wavelength_nm, variant, normal)
        group = np.arange(len(wavelength_nm)) * self.groups // len(wavelength_nm)
        waves = None if own.waves is None else _means(own.waves, group)
        return Moments(_means(own.shift, group), _means(own.variance, group), waves)


def _means(values: Floats, group: NDArray[np.int64]) -> Floats:
    """Means (2, band) over groups of bands."""
    sizes = np.bincount(group)
    means: Floats = np.stack([np.bincount(group, weights=row) / sizes for row in values])
    return means[:, group]


def _in_groups(state: Seen, groups: Setting) -> Light:
    """The same effects, with blurs that so many groups of bands share."""
    chosen: dict[Any, str] = dict(state.lines.footprint)
    if groups != EACH:
        chosen = {Shared(one, int(groups)) if hasattr(one, "moments") else one: its for one, its in chosen.items()}
    return state.lines.light(chosen)


GROUP_COUNT = replace(
    FOOTPRINT,
    knob="blurs of all bands",
    reference="each band's own blur, summed of few kernels; n: as many groups of bands share one each",
    settings=(EACH, *GROUPS),
    run=_in_groups,
)


@dataclass(frozen=True)
class FewBands:
    """A scene in some of its bands, and what all bands are made from them by."""

    scene: RasterScene
    bands: NDArray[np.intp]
    spline: Light  # (some, all)


@dataclass(frozen=True)
class InBands(Seen):
    """The same lines in fewer bands."""

    fewer: dict[Setting, FewBands]  # made once, as for a survey


def some_bands(lines: FarmLines, count: int) -> FewBands:
    """Take so many bands of a scene, evenly spaced, the first and the last among them."""
    scene, nm = lines.scene, lines.scene.wavelength_nm
    bands = np.unique(np.linspace(0, len(nm) - 1, count).round().astype(np.intp))
    fewer = replace(
        scene,
        light=Once.of(SceneLight(scene.electrons[:, bands], scene.panel_electrons[bands])),
        panel=scene.panel[bands],
        wavelength_nm=nm[bands],
        fwhm_nm=None if scene.fwhm_nm is None else scene.fwhm_nm[bands],
    )
    spline = CubicSpline(nm[bands], np.eye(len(bands)), axis=0)(nm).T
    return FewBands(fewer, bands, np.ascontiguousarray(spline, np.float32))


def _prepare_bands(seed: int) -> InBands:
    seen = prepare_footprint(seed)
    return InBands(seen.lines, seen.against, {count: some_bands(seen.lines, count) for count in BANDS})


def _in_bands(state: InBands, count: Setting) -> Light:
    lines = state.lines
    fewer = state.fewer[count]
    if len(fewer.bands) == len(lines.scene.wavelength_nm):
        return lines.light(lines.footprint)
    blocks = [
        replace(block, wavelength_nm=fewer.scene.wavelength_nm, fwhm_nm=fewer.scene.fwhm_nm, white_e=None)
        for block in lines.blocks
    ]
    light = np.concatenate([expected_light(fewer.scene, block, lines.footprint) for block in blocks])
    made: Light = np.matmul(light, fewer.spline)
    return made


BAND_COUNT: Tradeoff[InBands, Light] = replace(
    FOOTPRINT,
    knob="bands",
    reference="light of all bands; between fewer of them splines",
    settings=BANDS,
    prepare=_prepare_bands,
    run=_in_bands,
)

RAY_LINES = 2  # of each block
RAYS_PER_PX = (1, 2, 4, 8)


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


def _prepare_rays(seed: int) -> Rough:
    lines = look_at_lines(seed)
    few = replace(lines, blocks=tuple(replace(one, lines=one.lines[:RAY_LINES]) for one in lines.blocks))
    exact = few.light(_box_alone(few, SLIT.variants[0]))
    return Rough(few, Against.of(exact, few.rig), _as_components(few.scene))


def _box_alone(lines: FarmLines, variant: str) -> dict[Any, str]:
    rays: dict[Any, str] = {effect: its for effect, its in lines.exact.items() if effect in RAYS}
    return {**rays, SLIT: variant}


def _as_components(scene: RasterScene) -> RasterScene:
    count = scene.electrons.shape[0]
    ones = np.ones(count, np.float32)
    light = SceneLight(np.eye(count, dtype=np.float32), ones)
    nm = np.arange(1.0, count + 1)
    return replace(scene, light=Once.of(light), panel=ones, wavelength_nm=nm, fwhm_nm=None)


def _run_rays(state: Rough, setting: Setting) -> Light:
    if setting in SLIT.variants:
        return state.lines.light(_box_alone(state.lines, str(setting)))
    return _by_rays(state, int(str(setting).split()[0]))


def _by_rays(state: Rough, per_px: int) -> Light:
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


SUPERSAMPLING = replace(
    FOOTPRINT,
    knob="supersampling",
    reference=f"slit and pixel alone as {SLIT.variants[0]} boxes in closed form",
    settings=(*SLIT.variants, *(f"{count} ray{'s' * (count > 1)}/px" for count in RAYS_PER_PX)),
    prepare=_prepare_rays,
    run=_run_rays,
)
register_all(GROUP_COUNT, BAND_COUNT, SUPERSAMPLING)
