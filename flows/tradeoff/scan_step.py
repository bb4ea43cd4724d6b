"""Trade-off of the scan's step: fewer lines, further apart, against the rectified scene of the full scan."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.rectify.calibration.calibrate import reflectance
from pipeline.rectify.lookup import grid_points, lookup
from pipeline.rectify.resample import resample
from pipeline.simulator.effects.registry import QUIET
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

SHAPE = (192, 320)
STEPS = (1, 2, 3, 4, 6, 8)
BANDS = slice(0, None, 8)

Values = NDArray[np.float32]


@dataclass(frozen=True)
class CapturedAtStep:
    """Sweeps of one strip by their step, calibrated, and what a full scan without noise makes of the scene."""

    camera: LineCamera
    sweeps: dict[int, tuple[SimulatedSweep, Values]]
    full: Values  # (y, x, band)
    noise: float  # of one line over the scene's standard deviation


def _prepare(seed: int) -> CapturedAtStep:
    camera = LineCamera(samples=SHAPE[1])
    source = SimulatedSource(farm_scene(seed, SHAPE), Rig(camera), seed)
    sweeps = {step: _capture(source, step) for step in STEPS}
    calm = _capture(replace(source, chosen=QUIET), 1)
    full = _rectify(camera, *calm)
    noise = float(np.nanstd(sweeps[1][1] - calm[1]) / np.nanstd(full))
    return CapturedAtStep(camera, sweeps, full, noise)


def _capture(source: SimulatedSource, step: int) -> tuple[SimulatedSweep, Values]:
    sweep = Sweep(f"step {step}", "fine", "x", 0.0, -(SHAPE[0] - 1) / 2, -(-SHAPE[0] // step), step)
    lines = SimulatedSweep(source, sweep)
    values = reflectance(lines.read(0, sweep.lines), lines.references, position=lines.position)
    return lines, np.ascontiguousarray(values[..., BANDS])


def _rectify(camera: LineCamera, lines: SimulatedSweep, values: Values) -> Values:
    """The scene at its own pixels."""
    origin = (-(SHAPE[0] - 1) / 2, -(SHAPE[1] - 1) / 2)
    coordinates = lookup(lines.position, camera, grid_points(origin, 1.0, SHAPE), along="x")
    seen, _ = resample(values, np.ones(values.shape[:2], bool), coordinates.reshape(-1, 2))
    return seen.reshape(*SHAPE, -1)


def _judge(state: CapturedAtStep, _step: Setting, out: Values) -> float:
    return float(np.sqrt(np.nanmean((out - state.full) ** 2)) / np.nanstd(state.full))


SCAN_STEP = register(
    Tradeoff(
        stage="rectify",
        knob="scan step",
        error="rmse / standard deviation",
        unit="scene px",
        reference=f"full scan without noise of a farm of {SHAPE[1]} x {SHAPE[0]} px",
        settings=STEPS,
        prepare=_prepare,
        run=lambda state, step: _rectify(state.camera, *state.sweeps[int(step)]),
        judge=_judge,
        work=lambda _state, _step: float(SHAPE[0] * SHAPE[1]),
        modelled_s=lambda state, step, _out: CostModel().seconds([state.sweeps[int(step)][0].sweep], state.camera),
        levels=lambda state: (Level("σ of noise", state.noise), Level("0.1 σ of noise", 0.1 * state.noise)),  # noqa: RUF001
    )
)
