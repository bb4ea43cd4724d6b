"""Calibration of the simulated rig: the dark and white frames that a survey takes before it starts.

Calibration sees the detector and the spectrograph: dark current, response, smile, gains and defects of elements. What
it cannot know stays in the data: stray light, blur and keystone, what the air and the sky do, and the sun's course.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.defects import DEFECTS, dead_elements, hot_electrons
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.fixed_pattern import PRNU, STRIPING
from pipeline.simulator.effects.response import RESPONSE
from pipeline.simulator.effects.smile import SMILE
from pipeline.simulator.effects.vignetting import VIGNETTING
from pipeline.simulator.instrument import sweep_block
from pipeline.simulator.readout import dark_frame
from pipeline.simulator.render import Choice
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import Scene
from pipeline.source import AT_REST, References

Frame = NDArray[np.float32]
SEEN = frozenset({RESPONSE.name, SMILE.name, PRNU.name, STRIPING.name})  # by light of the panel


def take_references(scene: Scene, rig: Rig, choice: Choice, sweep: Sweep) -> References:
    """Give mean dark and white frames with the sweep's binning, free of noise.

    The white frame is scaled to the exposure from a shorter one, so that it does not saturate. It is taken with the
    mirror at rest, by the light of the survey's start. Dead and hot elements are told as bad.

    Returns
    -------
    Frames (sample, band) [DN]; the panel's values are those of the rig's bands.
    """
    block = sweep_block(scene, rig, AT_REST, range(1))
    dark = dark_frame(block, choice)
    white = dark + _panel_light(block, choice) / np.float32(rig.camera.electrons_per_dn)
    panel = scene.panel.astype(np.float32)
    if (response := choice.variant(RESPONSE.name)) != OFF:
        panel = RESPONSE.change(panel[None, None], block, response)[0, 0]
    return References(
        dark=_binned(dark, sweep.binning),
        white=_binned(white, sweep.binning),
        panel=panel,
        bad=_bad_elements(block, choice, sweep.binning),
        by_mirror=choice.variant(VIGNETTING.name) != OFF,
    )


def _panel_light(block: SweepBlock, choice: Choice) -> Frame:
    """Electrons that the panel gives in one exposure, (sample, band)."""
    assert block.white_e is not None
    light = np.repeat(block.white_e.astype(np.float32)[None, None], len(block.columns), axis=1)
    for effect, variant in choice.effects:
        if effect.name not in SEEN:
            continue
        if hasattr(effect, "gain"):
            light = light * effect.gain(block, variant)
        elif hasattr(effect, "change"):
            light = effect.change(light, block, variant)
    seen: Frame = light[0]
    if choice.variant(DEFECTS.name) != OFF:
        seen[dead_elements(block.rig, seen.shape[1])] = 0
    return seen


def _bad_elements(block: SweepBlock, choice: Choice, binning: int) -> NDArray[np.bool_] | None:
    """Dead and hot elements, (sample, band): of a sum one is enough; None where there are none."""
    if choice.variant(DEFECTS.name) == OFF:
        return None
    bands = len(block.wavelength_nm)
    bad = dead_elements(block.rig, bands) | (hot_electrons(block.rig, bands) > 0)
    return _binned(bad.astype(np.float32), binning) > 0 if bad.any() else None


def _binned(frame: Frame, binning: int) -> Frame:
    count = len(frame) // binning
    sums: Frame = frame[: count * binning].reshape(count, binning, -1).sum(axis=1)
    return sums
