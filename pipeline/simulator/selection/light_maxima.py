"""From the light that samples see, and places beside them, to the maxima that bounds are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import CostModel, Sweep
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
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.band_tiles import band_groups
from pipeline.simulator.selection.surroundings import REACHES, seen_widely

Floats = NDArray[np.float64]
Light = NDArray[np.float32]
Way = tuple[float, float]
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
class LinesLooked:
    """Light (shift, view, band) of the sweeps' own samples, and of places within each reach of them and beyond. [e-]

    ``scale`` is the unit of the tolerance at each stored number of theirs, (number, band) [e-].
    """

    own: Light
    around: tuple[Light, ...]
    scale: Light
    binning: int
    rig: Rig
    unit: Unit

    @staticmethod
    def of(parts: Sequence[Light], binning: int, rig: Rig, unit: Unit) -> LinesLooked:
        scale = unit_at(np.asarray(stored_mean(parts[0].min(axis=0), binning), np.float32), rig, unit, binning)
        return LinesLooked(parts[0], tuple(parts[1:]), scale, binning, rig, unit)

    def span_to(self, low: Light, high: Light) -> Floats:
        """Greatest difference of a stored number and light between two ends, (band,), over its unit."""
        least, most = self.own.min(axis=0), self.own.max(axis=0)
        off = np.maximum(most - low, high - least)
        return _greatest(stored_mean(_above(off, np.maximum(np.abs(low), np.abs(high))), self.binning) / self.scale)

    def beside(self, scene: RasterScene, covered: bool) -> dict[str, Any]:
        """Give what the probe knows of what lies beside the sweeps; ``covered``: they see all, but for a px or two."""
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


def sum_up_looks(looks: LinesLooked, scene: RasterScene, sweeps: tuple[Sweep, ...], means: Light) -> Probe:
    """Turn what samples see, and the means of lines (line,), into the probe's maxima."""
    rig, seen, scale, binning = looks.rig, looks.own, looks.scale, looks.binning
    camera, least, most = rig.camera, seen.min(axis=0), seen.max(axis=0)
    darkest, brightest = stored_mean(least, binning), stored_mean(most, binning)
    slope, curvature = _derivatives(seen, scale, binning)
    spectral = _spectral_derivatives(seen[0], scene.wavelength_nm, scale, binning)
    low, high = least.min(axis=0), most.max(axis=0)
    unit_brightest = unit_at(np.asarray(brightest, np.float32), rig, looks.unit, binning)
    level = np.maximum(np.abs(brightest) / unit_brightest, np.abs(darkest) / scale)
    off_mean = np.maximum(most - means.min(), means.max() - least)
    return Probe(
        unit=looks.unit,
        sweeps=sweeps,
        wavelength_nm=scene.wavelength_nm,
        fwhm_nm=scene.fwhm_nm,
        level=_greatest(level),
        spread=_greatest(stored_mean(_above(off_mean, high), binning) / scale),
        span=looks.span_to(low, high),
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
        own_e=np.stack([low, high]).astype(np.float64),
        binning=binning,
    )


def worst_of_groups(probe: Probe) -> Probe:
    """Give the probe with the worst of each group of neighbouring bands in all of them: one was looked at for each.

    Lights of the groups are the least and the greatest of any of their bands: a level that is one band's, and the span
    of another, do not tell the least light of a third.
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

    return replace(
        probe,
        level=worst(probe.level),
        spread=worst(probe.spread),
        span=worst(probe.span),
        slope=worst(probe.slope),
        curvature=worst(probe.curvature),
        spectral_slope=worst(probe.spectral_slope),
        spectral_curvature=worst(probe.spectral_curvature),
        beside=tuple(map(of_detail, probe.beside)),
        afar=None if probe.afar is None else of_detail(probe.afar),
        anywhere=None if probe.anywhere is None else worst(probe.anywhere),
        anywhere_spectral=None if probe.anywhere_spectral is None else worst(probe.anywhere_spectral),
        own_e=ends(probe.own_e),
        ends_e=ends(probe.ends_e),
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


def _spectral_derivatives(level: Light, wavelength_nm: Floats, scale: Light, binning: int) -> Floats:
    """Greatest first and second divided differences over wavelength, (2, band) over the unit; 0 where there is none."""
    nm = np.asarray(wavelength_nm, np.float64)
    if len(nm) < 2:
        return np.zeros((2, len(nm)))
    both = steepest_difference(level, nm), np.abs(second_difference(level, nm))
    return np.stack([_greatest(stored_mean(one, binning) / scale) for one in both])


def _above(difference: Light, high: Light) -> Light:
    """0 where a difference is no more than rounding."""
    return np.where(difference > _ROUNDING * np.abs(high), difference, np.float32(0))


def _greatest(values: NDArray[np.floating]) -> Floats:
    return np.asarray(values.max(axis=0).astype(np.float64))
