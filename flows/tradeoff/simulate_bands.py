"""Trade-offs of spectral resolution: how many groups of bands are blurred alike, and in how many bands to mix."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Setting, Tradeoff, register
from flows.tradeoff.simulate import FOOTPRINT, Seen, prepare_footprint
from flows.tradeoff.simulated_lines import FarmLines, Light
from pipeline.lazy import Once
from pipeline.simulator.effects.effect import Effect
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import RasterScene, SceneLight

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
        """Of the blur."""
        return str(self.blur.name)

    @property
    def variants(self) -> tuple[str, ...]:
        """Of the blur."""
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


def share_blurs(chosen: dict[Effect, str], groups: int) -> dict[Any, str]:
    """Give the same effects with blurs that so many groups of bands share."""
    return {
        Shared(effect, groups) if hasattr(effect, "moments") else effect: variant for effect, variant in chosen.items()
    }


def _in_groups(state: Seen, groups: Setting) -> Light:
    chosen = state.lines.footprint
    return state.lines.light(chosen if groups == EACH else share_blurs(chosen, int(groups)))


GROUP_COUNT = register(
    replace(
        FOOTPRINT,
        knob="blurs of all bands",
        reference="each band's own blur, summed of few kernels; n: as many groups of bands share one each",
        settings=(EACH, *GROUPS),
        run=_in_groups,
    )
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

    fewer: dict[Setting, FewBands] = field(default_factory=dict)  # made once, as for a survey

    def in_bands(self, count: Setting) -> FewBands:
        """Take evenly spaced bands, the first and the last among them."""
        if count not in self.fewer:
            self.fewer[count] = some_bands(self.lines, int(count))
        return self.fewer[count]


def some_bands(lines: FarmLines, count: int) -> FewBands:
    """Take so many bands, evenly spaced, of a scene."""
    from scipy.interpolate import CubicSpline

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


def _prepare(seed: int) -> InBands:
    seen = prepare_footprint(seed)
    return InBands(seen.lines, seen.against)


def _in_bands(state: InBands, count: Setting) -> Light:
    lines = state.lines
    fewer = state.in_bands(count)
    if len(fewer.bands) == len(lines.scene.wavelength_nm):
        return lines.light(lines.footprint)
    blocks = [
        replace(block, wavelength_nm=fewer.scene.wavelength_nm, fwhm_nm=fewer.scene.fwhm_nm, white_e=None)
        for block in lines.blocks
    ]
    light = np.concatenate([expected_light(fewer.scene, block, lines.footprint) for block in blocks])
    made: Light = np.matmul(light, fewer.spline)
    return made


BAND_COUNT: Tradeoff[InBands, Light] = register(
    replace(
        FOOTPRINT,
        knob="bands",
        reference="light of all bands; between fewer of them splines",
        settings=BANDS,
        prepare=_prepare,
        run=_in_bands,
    )
)
