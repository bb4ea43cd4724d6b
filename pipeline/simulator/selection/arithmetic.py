"""What arithmetic alone may change of light that is computed in two ways: float32, tables, few kernels for all bands.

It follows the light about a sample and not its noise. Beyond a full well the one grows faster than the other, and a
dark sample beside bright ones has little noise and weights of much light: there a small change is lost in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.effect import Effect, Light
from pipeline.simulator.effects.line import ROTATION, SLIT, SMEAR
from pipeline.simulator.optics.kernel_fit import NEGLIGIBLE
from pipeline.simulator.optics.tap_tables import TABULATED

Floats = NDArray[np.float64]
Render = Callable[[SweepBlock, Mapping[Effect, str]], Light]
ROUNDING = 4e-6  # of the brightest light of some lines: float32 sums
REACH_PX = 8  # of a footprint's weights, along the line and the scan
_HALVES = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # px along and scan
MIDDLE_RAYS: Mapping[Effect, str] = {ROTATION: ROTATION.variants[0]}  # the scene itself, where lines really lie


def misplaced_electrons(light: NDArray[np.floating], contrast: NDArray[np.floating], share: float) -> Floats:
    """Bound by how much two ways may differ at each number of some lines (line, number, band). [e-]

    ``contrast`` is that of `contrast_about`, stored as the light is, ``share`` that of `misplaced_share`.
    """
    bound: Floats = share * contrast.astype(np.float64) + ROUNDING * float(np.abs(light).max(initial=0.0))
    return bound


def misplaced_share(exact: Mapping[Effect, str], chosen: Mapping[Effect, str]) -> float:
    """Give the share of the contrast about a sample by which two ways to compute its light may differ at most.

    Tables of weights, one along either axis, misplace up to `TABULATED` of the light by size, in either image; where
    blurs or held positions differ, so do the few kernels that stand for those of all bands, each right to `NEGLIGIBLE`.
    Weights sum to 1, so that what they misplace counts half of the contrast.
    """

    return 2 * TABULATED + (0.0 if _folded(exact) == _folded(chosen) else NEGLIGIBLE)


def _folded(ways: Mapping[Effect, str]) -> dict[str, str]:
    """What kernels are made of; a slit's parts all have the same."""
    blurs = {one.name: way for one, way in ways.items() if hasattr(one, "moments") or one.name == SMEAR.name}
    return blurs | {one.name: "box" for one in ways if one.name == SLIT.name}


def contrast_about(block: SweepBlock, render: Render) -> Floats:
    """Give the range of the scene's light within reach of each sample's footprint, (1, sample, band). [e-]

    The scene is looked at by middle rays, a px and half a px apart: pixels may lie between those of one look.
    """
    from scipy.ndimage import maximum_filter1d

    sweep = block.sweep
    held = replace(sweep, step=1, lines=sweep.lines * sweep.step)
    ends = block.lines.start * sweep.step - REACH_PX, block.lines.stop * sweep.step + REACH_PX
    wide = replace(block, sweep=held, lines=range(max(ends[0], 0), min(ends[1], held.lines)))
    if not wide.lines:
        return np.zeros((1, len(block.columns), len(block.wavelength_nm)))
    looks = [render(replace(wide, sweep=_beside(held, *way)), MIDDLE_RAYS) for way in _HALVES]
    seen = np.concatenate(looks)
    ends_e = seen.max(axis=0), -seen.min(axis=0)
    most, least = (maximum_filter1d(one, 2 * REACH_PX + 1, axis=0, mode="nearest") for one in ends_e)
    contrast: Floats = (most + least).astype(np.float64)[None]
    return contrast


def _beside(sweep: Sweep, along_px: float, scan_px: float) -> Sweep:
    return replace(sweep, strip_px=sweep.strip_px + along_px, start_px=sweep.start_px + scan_px)
