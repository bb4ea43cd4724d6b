"""Light from beside the sweeps: how far they see, its greatest changes, and what blurs and shifts bring of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, points_of_scan, scene_to_sweep
from pipeline.simulator.effects.air import greatest_fraction, sway_gradient
from pipeline.simulator.effects.blurs import airy_gaussians
from pipeline.simulator.effects.effect import OFF, Effect
from pipeline.simulator.effects.probe import (
    WIDE_PX,
    Detail,
    Probe,
    lights_within,
    second_difference,
    steepest_difference,
    unit_electrons,
)
from pipeline.simulator.optics.kernel_fit import Moments
from pipeline.simulator.optics.rays import normals_met
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene, to_bands

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
_CELLS = 40_000  # at which it is asked whether a sweep looks there
_PROBES = 65  # lines and samples of a sweep that tell where it sees the scene's repeated edge


@dataclass(frozen=True)
class ReachedCells:
    """Square cells of a scene: how far each lies from what sweeps see, never more than it does, 0 where they see it.

    Between neighbouring cells lies nothing.
    """

    apart_px: Floats  # (row, column)
    cell_px: int
    shape: tuple[int, int]  # of the scene [px]

    @property
    def covers(self) -> bool:
        """Return whether sweeps see all of the scene."""
        return not self.apart_px.any()

    def rows_within(self, first: int, last: int, nearest_px: float, farthest_px: float) -> Mask:
        """Return which pixels of rows lie farther than the one and no farther than the other, (row, column)."""
        rows = np.arange(first, min(last, self.shape[0])) // self.cell_px
        apart = self.apart_px[rows]
        within: Mask = np.repeat((apart > nearest_px) & (apart <= farthest_px), self.cell_px, axis=1)
        return within[:, : self.shape[1]]


def reached_cells(shape: tuple[int, int], camera: LineCamera, sweeps: Sequence[Sweep]) -> ReachedCells:
    """Return which cells of a scene any sweep sees in part; outside, the scene's edge is repeated."""
    cell = max(2, math.ceil(math.sqrt(shape[0] * shape[1] / _CELLS)))
    y, x = (np.arange(0, size, cell) + (cell - size) / 2 for size in shape)
    reached = np.zeros((len(y), len(x)), np.bool_)
    for sweep in sweeps:
        along, scan = (y[:, None], x[None]) if sweep.along == "y" else (x[None], y[:, None])
        held = replace(sweep, step=1, lines=sweep.lines * sweep.step, binning=1)
        line, sample = np.moveaxis(scene_to_sweep(held, camera, along, scan), -1, 0)
        slack = 1 + cell / 2
        reached |= (np.abs(line - (held.lines - 1) / 2) <= held.lines / 2 + slack) & (
            np.abs(sample - (camera.samples - 1) / 2) <= camera.samples / 2 + slack
        )
        reached[_edge_cells(held, camera, shape, cell)] = True
    if reached.all():
        return ReachedCells(np.zeros(reached.shape), cell, shape)
    if not reached.any():
        return ReachedCells(np.full(reached.shape, np.inf), cell, shape)
    apart = scipy.ndimage.distance_transform_edt(~reached)
    return ReachedCells(np.where(reached, 0.0, np.maximum((apart - 1) * cell, 1e-3)), cell, shape)


def _edge_cells(
    sweep: Sweep, camera: LineCamera, shape: tuple[int, int], cell: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the cells at the scene's edge that a sweep sees repeated outside of it."""
    count = max(_PROBES, 2 * max(shape) // cell)
    lines = sweep.start_px + np.linspace(0, sweep.lines - 1, count)
    slopes = np.linspace(-0.5, 0.5, count) * camera.samples * camera.ifov_rad
    along, scan = points_of_scan(sweep.swath_px, camera, lines[:, None], slopes)
    places = np.stack([scan, along] if sweep.along == "x" else [along, scan]).reshape(2, -1)
    places += (np.array(shape)[:, None] - 1) / 2
    last = np.array(shape)[:, None] - 1
    outside = ((places < 0) | (places > last)).any(axis=0)
    row, column = (np.clip(places[:, outside], 0, last).astype(np.intp)) // cell
    return row, column


Radiance = NDArray[np.float32]
REACHES = (2.0, 6.0, 24.0)  # px beside the sweeps, within which is looked as closely as where they see
BLOCK_PX = 4  # of the scene, averaged: a blur of `WIDE_PX` and more sees means of two by two of them
_ROWS_AT_ONCE = 64


@dataclass(frozen=True)
class WideLight:
    """Means of several pixels of a scene: their ends (band,) [e-] and derivatives (2, band) [e-/px, e-/px^2].

    ``spectral`` (2, band) are the greatest divided differences over wavelength [e-/nm, e-/nm^2].
    """

    low: Radiance
    high: Radiance
    slope: Radiance
    curvature: Radiance
    spectral: Radiance


def seen_widely(scene: RasterScene, exposure_ms: float) -> WideLight:
    """Return what is `WIDE_PX` wide and wider sees of all the scene: means of 2 x 2 blocks of `BLOCK_PX`.

    Derivatives are the greatest along either axis.
    """
    spectra = scene.electrons * np.float32(exposure_ms / DEFAULT_EXPOSURE_MS)
    bands, nm = len(scene.wavelength_nm), np.asarray(scene.wavelength_nm, np.float64)
    low, high = np.full(bands, np.inf, np.float32), np.full(bands, -np.inf, np.float32)
    slope, curvature, spectral = (np.zeros(size, np.float32) for size in (bands, bands, (2, bands)))
    for parts in _means(scene):
        means = to_bands(parts, spectra)
        low, high = np.minimum(low, means.min(axis=(0, 1))), np.maximum(high, means.max(axis=(0, 1)))
        for axis in (0, 1):
            size, whole = means.shape[axis] - 4, (slice(None),) * axis
            ahead, middle, behind = (means[(*whole, slice(at, at + size))] for at in (4, 2, 0))
            slope = np.maximum(slope, _largest(ahead - middle))
            curvature = np.maximum(curvature, _largest(ahead + behind - 2 * middle))
        if bands > 1:
            both = steepest_difference(means, nm), second_difference(means, nm)
            spectral = np.maximum(spectral, [_largest(one) for one in both])
    window = 2 * BLOCK_PX
    steep, bent = np.stack([slope] * 2) / np.float32(window), np.stack([curvature] * 2) / np.float32(window**2)
    return WideLight(low, high, steep, bent, spectral)


def _largest(values: Radiance) -> Radiance:
    """Return the largest magnitude in each band, (band,)."""
    return np.asarray(np.maximum(values.max(axis=(0, 1), initial=0.0), -values.min(axis=(0, 1), initial=0.0)))


def _means(scene: RasterScene) -> Iterator[Radiance]:
    """Yield the components of windows of two by two blocks, a block apart, in overlapping parts of the scene."""
    planes = scene.planes
    short = [-size % BLOCK_PX for size in scene.shape]
    if any(short):
        planes = np.pad(planes, ((0, short[0]), (0, short[1]), (0, 0)), mode="edge")
    rows, columns = (size // BLOCK_PX for size in planes.shape[:2])
    blocks = planes.reshape(rows, BLOCK_PX, columns, BLOCK_PX, -1).sum(axis=1).sum(axis=2) / np.float32(BLOCK_PX**2)
    blocks = np.pad(blocks, ((4, 4), (4, 4), (0, 0)), mode="edge")
    sums = blocks[1:] + blocks[:-1]
    windows = (sums[:, 1:] + sums[:, :-1]) / np.float32(4)
    for first in range(0, len(windows), _ROWS_AT_ONCE):
        part = windows[first : first + _ROWS_AT_ONCE + 4]
        if len(part) > 4 or not first:
            yield part


_ENDLESS = 1e9  # span and curvature of an image whose shifts show as they are


def blended_surroundings(probe: Probe, rig: Rig, moving: Sequence[Effect]) -> Probe:
    """Return the probe of an image that all blurs and shifts of a rig have passed, with what they bring from beside.

    Shifts bring what lies within their way. Each part of a blur has the greatest derivatives of what it reaches, and
    the image has the mean of its parts'. The same probe where nothing lies beside the sweeps.
    """
    if probe.anywhere is None:
        return probe
    turn = sway_gradient(rig) + greatest_fraction(rig.air)  # what rises along one axis rises along the other
    turned = tuple(replace(one, slope=one.slope + turn * one.slope[::-1]) for one in probe.beside)
    probe = replace(probe, slope=probe.slope + turn * probe.slope[::-1], beside=turned)
    blurs = [one for one in moving if hasattr(one, "moments")]
    way, parts = greatest_way_px(probe, rig, moving), _blur_parts(probe, rig, blurs)
    own = _blended(probe, 0.0, way, parts)
    beside = [_blended(probe, one.reach_px - way, way, parts) for one in probe.beside if one.reach_px > way]
    return replace(probe.with_detail(own), beside=tuple(beside))


def _blended(probe: Probe, reach_px: float, way_px: float, parts: Sequence[tuple[float, float]]) -> Detail:
    """Return what lies within a reach once the image has been moved by so much and blurred by parts (share, sd)."""
    near = probe.within(reach_px + way_px)
    slope, curvature, span = near.slope, near.curvature, near.span
    spectral = near_spectral = np.stack([near.spectral_slope, near.spectral_curvature])
    for fraction, sd in parts:
        seen = _seen_through(probe, reach_px + way_px, sd)
        slope = slope + fraction * np.maximum(seen.slope - near.slope, 0.0)
        curvature = curvature + fraction * np.maximum(seen.curvature - near.curvature, 0.0)
        span = span + fraction * np.maximum(seen.span - near.span, 0.0)
        spectral = spectral + fraction * np.maximum(seen.spectral - near_spectral, 0.0)
    return Detail(reach_px, span, slope, curvature, spectral)


def _seen_through(probe: Probe, beside_px: float, sd_px: float) -> Detail:
    """Return the least bound of derivatives and span of an image blurred by a Gaussian, up to this distance away."""
    assert probe.anywhere is not None
    last = max((one.reach_px for one in probe.beside), default=0.0)
    found = []
    for reach in (0.0, *(one.reach_px for one in probe.beside)):
        near = probe.within(max(beside_px, min(beside_px + reach, last)))
        beyond = 4 * scipy.special.ndtr(-reach / sd_px if sd_px else -np.inf)
        far, own = beyond * probe.anywhere, np.stack([near.spectral_slope, near.spectral_curvature])
        spectral = own if probe.anywhere_spectral is None else own + beyond * probe.anywhere_spectral
        found.append((near.span + far, near.slope + far, near.curvature + 4 * far, spectral))
    if probe.afar is not None and sd_px > WIDE_PX:
        found.append((probe.afar.span, probe.afar.slope, probe.afar.curvature, probe.afar.spectral))
    return Detail(beside_px, *(np.min(some, axis=0) for some in zip(*found, strict=True)))


def greatest_way_px(probe: Probe, rig: Rig, effects: Sequence[Effect]) -> float:
    """Return the greatest displacement by all effects together, by their bounds on an image that rises evenly [px]."""
    moving = [one for one in effects if any(hasattr(one, act) for act in ("aim", "displaced"))]
    bands = len(probe.wavelength_nm)
    rising = replace(
        probe,
        beside=(),
        afar=None,
        anywhere=None,
        own_e=None,
        slit_errors={},
        span=np.full(bands, _ENDLESS),
        slope=np.ones((2, bands)),
        curvature=np.full((2, bands), _ENDLESS),
    )
    return math.fsum(one.bound(rising, rig, OFF).value for one in moving)


def _blur_parts(probe: Probe, rig: Rig, blurs: Sequence[Any]) -> list[tuple[float, float]]:
    """Return the fractions and sizes (sd) of the Gaussians that make up a rig's blurs, as wide as in any band. [px]"""
    nm = np.asarray(probe.wavelength_nm, np.float64)
    sizes, waves = [0.0], [0.0]
    for normal in normals_met(probe.sweeps, rig.camera):
        both = Moments.together([one.moments(rig, nm, one.variants[0], normal) for one in blurs], len(nm))
        sizes.append(float(np.sqrt(both.spread.max(initial=0.0)) + np.abs(both.shift).max(initial=0.0)))
        waves.append(0.0 if both.waves is None else float(both.waves.max(initial=0.0)))
    fractions, widths = airy_gaussians() if max(waves) > 0 else (np.ones(1), np.zeros(1))
    return [
        (float(fraction), math.hypot(width * max(waves), max(sizes)))
        for fraction, width in zip(fractions, widths, strict=True)
    ]


def light_brought(probe: Probe, rig: Rig, moving: Iterable[Effect]) -> Probe:
    """Return the probe of light to which blurs and shifts have brought some from beside what the sweeps see.

    They change no signal by more than their bounds, and none to what is nowhere in the scene. The same probe where
    nothing lies beside.
    """
    if probe.anywhere is None or probe.ends_e is None:
        return probe
    brought = min(math.fsum(one.bound(probe, rig, OFF).value for one in moving), float(probe.anywhere.max()))
    low, high = lights_within(probe, rig)
    change = brought * unit_electrons(high, probe, rig)
    brighter = np.maximum(np.minimum(high + change, probe.ends_e[1]) - high, 0.0)
    darker = np.maximum(low - np.maximum(low - change, probe.ends_e[0]), 0.0)
    least = unit_electrons(low - darker, probe, rig)
    return replace(
        probe,
        level=np.maximum(probe.level, (high + brighter) / unit_electrons(high + brighter, probe, rig)),
        span=np.maximum(probe.span, (high + brighter - low + darker) / least),
        spread=probe.spread + float((np.maximum(brighter, darker) / least).max(initial=0.0)),
        brightest_e=probe.brightest_e + float(brighter.max(initial=0.0)),
        darkest_e=probe.darkest_e - float(darker.max(initial=0.0)),
        own_e=np.stack([low - darker, high + brighter]),
    )
