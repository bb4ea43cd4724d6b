"""The simulated instrument: raw numbers of any lines of a sweep, whatever the block, and the frames that calibrate it.

Calibration sees the detector and the spectrograph: dark current, response, smile, gains and defects of elements. What
it cannot know stays in the data: stray light, blur and keystone, what the air and the sky do, and the sun's course.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SettingsError, ShapeError
from pipeline.geometry.camera import LineCamera, bin_samples
from pipeline.geometry.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.counting import GAUSSIAN, READ_NOISE, SHOT
from pipeline.simulator.effects.effect import OFF
from pipeline.simulator.effects.line import FOLDED, ROTATION, SLIT, SMEAR
from pipeline.simulator.effects.mirror_throughput import HELD, VIGNETTING
from pipeline.simulator.effects.registry import BY_NAME, EFFECTS
from pipeline.simulator.effects.sensor import DEFECTS, PRNU, STRIPING, dead_elements, hot_electrons
from pipeline.simulator.effects.spectrometer import RESPONSE, SMILE
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, Scene
from pipeline.source import AT_REST, References

Raw = NDArray[np.uint16]
BLOCK_LINES = 16  # rendered at a time: 11 MB of light with 640 samples and 270 bands
Frame = NDArray[np.float32]
SEEN = frozenset({RESPONSE.name, SMILE.name, PRNU.name, STRIPING.name})  # by light of the panel


def effects_on(*names: str) -> Choice:
    """Give effects by their names, in the order of the chain: exact ones, but for shot noise, which is cheap.

    Cheap shot noise may stand for the exact one: see `counting.Shot`.

    Raises
    ------
    SettingsError : there is no such effect.
    """
    unknown = sorted(set(names) - set(BY_NAME))
    if unknown:
        raise SettingsError(f"unknown effects {unknown}; choose from {', '.join(BY_NAME)}")
    return Choice(tuple((one, GAUSSIAN if one is SHOT else one.variants[0]) for one in EFFECTS if one.name in names))


# Of any camera behind a mirror, without noise and with; cheap: beside exact ones a farm changes by .015 sigma at most.
QUIET = Choice.of({ROTATION: "rays", SLIT: "3x1", SMEAR: FOLDED, VIGNETTING: HELD})

USUAL = Choice((*QUIET.effects, (SHOT, GAUSSIAN), (READ_NOISE, "exact")))


def sweep_block(
    scene: Scene,
    rig: Rig,
    sweep: Sweep,
    lines: range,
    *,
    seed: int = 0,
    started_s: float = 0.0,
    samples: range | None = None,
) -> SweepBlock:
    """Give some lines of a sweep over a scene, as effects ask about them.

    ``samples`` are the camera's, before binning; ``started_s`` is when the sweep starts, after the survey did.
    """
    white = scene.panel_electrons.astype(np.float64) * (rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS)
    return SweepBlock(
        rig, sweep, lines, scene.wavelength_nm, scene.shape, seed, samples, started_s, scene.fwhm_nm, white
    )


def render_lines(
    scene: Scene,
    rig: Rig,
    chosen: Mapping[Any, str] | Choice,
    sweep: Sweep,
    lines: range,
    *,
    seed: int = 0,
    started_s: float = 0.0,
    samples: range | None = None,
) -> Raw:
    """Give the raw numbers of some lines. Pure: threads and tasks may share all arguments.

    Neither the other lines and samples asked for nor the order of calls changes a number.

    Parameters
    ----------
    samples
        Neighbouring ones of the binned line; None is all. Effects for which all of a line counts see all of it.

    Returns
    -------
    (line, sample, band) uint16, binned. [DN]

    Raises
    ------
    ShapeError : sums of ``sweep.binning`` samples at full scale do not fit uint16, or the line has no such samples.
    PoseError : a position of the sweep is out of the mirror's reach.
    """
    check_binning(sweep, rig.camera)
    choice, count = Choice.of(chosen), rig.camera.samples // sweep.binning
    taken = range(count) if samples is None else samples
    if taken.step != 1 or not 0 <= taken.start < taken.stop <= count:
        raise ShapeError(f"sweep {sweep.name} has samples 0 to {count - 1} a line; expected some in a row, got {taken}")
    of_camera = None if samples is None else range(taken.start * sweep.binning, taken.stop * sweep.binning)
    raw = np.empty((len(lines), len(taken), len(scene.wavelength_nm)), np.uint16)
    for first in range(0, len(lines), BLOCK_LINES):
        some = slice(first, first + BLOCK_LINES)
        block = sweep_block(scene, rig, sweep, lines[some], seed=seed, started_s=started_s, samples=of_camera)
        light = expected_light(scene, block, choice)
        raw[some] = bin_samples(read_out(light, block, choice), sweep.binning)
    return raw


def check_binning(sweep: Sweep, camera: LineCamera) -> None:
    """Refuse sums that do not fit raw numbers.

    Raises
    ------
    ShapeError : ``sweep.binning`` samples at full scale sum to more than uint16 holds.
    """
    if sweep.binning > camera.most_binning:
        raise ShapeError(
            f"sweep {sweep.name}: sums of {sweep.binning} samples of {camera.bits} bits do not fit uint16; "
            f"bin at most {camera.most_binning}"
        )


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
