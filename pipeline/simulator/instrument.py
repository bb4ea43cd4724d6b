"""The simulated instrument: raw numbers of any lines of a sweep, the same in whatever blocks they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.camera import LineCamera, bin_samples
from pipeline.errors import SettingsError, ShapeError
from pipeline.scan import Sweep
from pipeline.simulator.block import SweepBlock
from pipeline.simulator.effects.read_noise import READ_NOISE
from pipeline.simulator.effects.registry import BY_NAME, EFFECTS
from pipeline.simulator.effects.rotation import ROTATION
from pipeline.simulator.effects.shot import GAUSSIAN, SHOT
from pipeline.simulator.effects.slit import SLIT
from pipeline.simulator.effects.smear import FOLDED, SMEAR
from pipeline.simulator.effects.vignetting import HELD, VIGNETTING
from pipeline.simulator.readout import read_out
from pipeline.simulator.render import Choice, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import DEFAULT_EXPOSURE_MS, Scene

Raw = NDArray[np.uint16]
BLOCK_LINES = 16  # rendered at a time: 11 MB of light with 640 samples and 270 bands


def effects_on(*names: str) -> Choice:
    """Give effects by their names, in the order of the chain: exact ones, but for shot noise, which is cheap.

    Cheap shot noise may stand for the exact one: see `shot.Shot`.

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
    exposures = rig.camera.exposure_ms / DEFAULT_EXPOSURE_MS
    return SweepBlock(
        rig, sweep, lines, scene.wavelength_nm, scene.shape, seed, samples, started_s, scene.fwhm_nm,
        scene.panel_electrons.astype(np.float64) * exposures,
    )  # fmt: skip


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
