"""Trade-offs of rectifying: line model, overlap of sweeps, kernel of resampling, step of the scan, spacing of ties."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from flows.tradeoff.entries import Level, Setting, Tradeoff, register_all
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.mirror import direction_to_normal, scene_to_direction
from pipeline.geometry.paper_equations import LINE_MODELS, LineModel, line_points, unlimited_position
from pipeline.geometry.scan import CostModel, Sweep, line_positions, scene_to_sweep
from pipeline.rectify.calibrate import reflectance
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.lookup import grid_points, lookup
from pipeline.rectify.placed import tie_table
from pipeline.rectify.registration.shifts import PairShift, pair_shift
from pipeline.rectify.resample import resample
from pipeline.rectify.tracks import Track, make_tracks
from pipeline.simulator.effects.registry import QUIET
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep

Floats = NDArray[np.float64]
Values = NDArray[np.float32]
Lines = list[tuple[Floats, Floats]]  # along and scan of each line's samples [px]

FIELD_PX = 10240
LINES_APART_PX = 80.0


@dataclass(frozen=True)
class Strips:
    """Lines of a full scan that the mirror reaches, strip by strip, and where they end."""

    camera: LineCamera
    centres: tuple[tuple[float, Floats], ...]  # strip and scan coordinate of its lines [px]
    ends: Lines


def _prepare_strips(_seed: int) -> Strips:
    camera = LineCamera()
    half, sides = FIELD_PX / 2, FIELD_PX // camera.samples
    scan = np.arange(-half, half + 1, LINES_APART_PX)
    centres = []
    for strip in (np.arange(sides) + 0.5) * camera.samples - half:
        tangents = np.stack([np.full_like(scan, strip), scan], axis=-1) * camera.ifov_rad
        position = unlimited_position(direction_to_normal(scene_to_direction(tangents)))
        centres.append((float(strip), scan[np.hypot(*position.T) <= 1]))
    return Strips(camera, tuple(centres), [_ends(*line_points("L4", *strip, camera)) for strip in centres])


def _ends(along: Floats, scan: Floats) -> tuple[Floats, Floats]:
    return along[:, [0, -1]], scan[:, [0, -1]]


def _error_at_ends(state: Strips, _model: Setting, out: Lines) -> float:
    pairs = zip(map(_ends, *zip(*out, strict=True)), state.ends, strict=True)
    return max(float(np.hypot(a - exact_a, b - exact_b).max()) for (a, b), (exact_a, exact_b) in pairs)


LINE_MODEL = Tradeoff(
    stage="rectify",
    knob="line model",
    error="greatest error at a line's end [px]",
    unit="px",
    reference=f"exact rays over {FIELD_PX} x {FIELD_PX} px, as far as the mirror reaches",
    settings=LINE_MODELS,
    prepare=_prepare_strips,
    run=lambda state, model: [
        line_points(cast("LineModel", model), strip, scan, state.camera) for strip, scan in state.centres
    ],
    judge=_error_at_ends,
    work=lambda state, _model: float(sum(len(scan) for _, scan in state.centres) * state.camera.samples),
    levels=lambda _state: (Level("half a pixel", 0.5),),
    moved_bytes=16.0,
)


WAVES = 24


@dataclass(frozen=True)
class Waves:
    """Sum of plane waves, in every band with other phases and amplitudes: a scene known at every point."""

    frequency: Floats  # (wave, 2) cycles per px down and across
    cosine: Floats  # (wave, band)
    sine: Floats

    def at(self, coordinates: Floats) -> Floats:
        """Exact values at (n, 2) positions [px], (n, band)."""
        phase = 2 * np.pi * coordinates @ self.frequency.T
        values: Floats = np.cos(phase) @ self.cosine + np.sin(phase) @ self.sine
        return values


def draw_waves(seed: int, bands: int, periods_px: tuple[float, float]) -> Waves:
    """Waves of random directions, their periods even in logarithm."""
    rng = np.random.default_rng(seed)
    period = np.exp(rng.uniform(np.log(periods_px[0]), np.log(periods_px[1]), WAVES))
    angle = rng.uniform(0, np.pi, WAVES)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=-1) / period[:, None]
    return Waves(frequency, rng.standard_normal((WAVES, bands)), rng.standard_normal((WAVES, bands)))


SEAM_PX = 256
OVERLAPS_PX = (16, 32, 64, 128, 256)
PAIRS = 5
SEAM_PERIODS_PX = (16.0, 160.0)
SNR = 50.0
PRIOR_PX = 3.0


@dataclass(frozen=True)
class Seams:
    """Two noisy looks at each seam, the second shifted by what is known."""

    pairs: list[tuple[Floats, Floats]]  # (row, column), of the widest overlap
    shifts: Floats  # (pair, 2) rows and columns


def _prepare_seams(seed: int) -> Seams:
    rng = np.random.default_rng([seed, 2])
    size = (SEAM_PX, max(OVERLAPS_PX))
    places = np.argwhere(np.ones(size, bool)).astype(np.float64)
    shifts = rng.uniform(1 - PRIOR_PX, PRIOR_PX - 1, (PAIRS, 2))
    pairs = []
    for number, shift in enumerate(shifts):
        waves = draw_waves(seed + number, 1, SEAM_PERIODS_PX)
        # reference(p) = moving(p - shift)
        looks = [waves.at(places + moved).reshape(size) for moved in (np.zeros(2), shift)]
        sigma = float(np.std(looks[0])) / SNR
        pairs.append((looks[0] + rng.normal(0, sigma, size), looks[1] + rng.normal(0, sigma, size)))
    return Seams(pairs, shifts)


def _median_miss(state: Seams, _overlap: Setting, found: list[PairShift]) -> float:
    """A pair that is not decided counts as infinitely far."""
    off = np.linalg.norm([pair.shift for pair in found] - state.shifts, axis=1)
    return float(np.median(np.where(np.isnan(off), np.inf, off)))


OVERLAP = Tradeoff(
    stage="rectify",
    knob="overlap",
    error="median error of the shift [px]",
    unit="pair",
    reference=(
        f"{PAIRS} known shifts of waves of {SEAM_PERIODS_PX[0]:g} to {SEAM_PERIODS_PX[1]:g} px, "
        f"{SEAM_PX} px of seam, SNR {SNR:g}"
    ),
    settings=OVERLAPS_PX,
    prepare=_prepare_seams,
    run=lambda state, overlap: [
        pair_shift(one[:, : int(overlap)], other[:, : int(overlap)], prior_px=PRIOR_PX) for one, other in state.pairs
    ],
    judge=_median_miss,
    work=lambda _state, _overlap: float(PAIRS),
    levels=lambda _state: (Level("goal of 0.1 px", 0.1),),
)


SIDE, BANDS, POINTS = 256, 64, 40_000
PERIODS_PX = (4.0, 40.0)
CONTRAST = 0.2  # standard deviation of the scene over its mean, which fills half of the converter's range


@dataclass(frozen=True)
class Scattered:
    """Samples on a grid, points between them, and what is true there."""

    samples: Values  # (line, sample, band)
    coordinates: Floats  # (n, 2)
    truth: Floats  # (n, band)


def _prepare_points(seed: int) -> Scattered:
    """Point samples of waves, and points at least 2 px inside, in the order of lines as a lookup gives them."""
    waves, rng = draw_waves(seed, BANDS, PERIODS_PX), np.random.default_rng([seed, 1])
    grid = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    samples = waves.at(grid).astype(np.float32).reshape(SIDE, SIDE, BANDS)
    coordinates = rng.uniform(2, SIDE - 3, (POINTS, 2))
    coordinates = coordinates[np.lexsort((coordinates[:, 1], np.floor(coordinates[:, 0])))]
    return Scattered(samples, coordinates, waves.at(coordinates))


def noise_levels(camera: LineCamera) -> tuple[Level, ...]:
    """A tenth of the noise and half a step of the converter, over the scene's standard deviation."""
    electrons = camera.full_well_e / 2
    scene = CONTRAST * electrons
    noise = float(np.sqrt(electrons + camera.read_noise_e**2))
    return (
        Level("0.1 σ of noise", 0.1 * noise / scene),  # noqa: RUF001
        Level("0.5 LSB", 0.5 * camera.electrons_per_dn / scene),
    )


RESAMPLE = Tradeoff(
    stage="rectify",
    knob="kernel",
    error="rmse / standard deviation",
    unit="px*band",
    reference=f"waves of {PERIODS_PX[0]:g} to {PERIODS_PX[1]:g} px, evaluated at the output pixels",
    settings=("nearest", "bilinear", "catmull-rom"),
    prepare=_prepare_points,
    run=lambda state, kernel: resample(
        state.samples, np.ones(state.samples.shape[:2], bool), state.coordinates, cast("Kernel", kernel)
    )[0],
    judge=lambda state, _kernel, out: float(np.sqrt(np.mean((out - state.truth) ** 2)) / np.std(state.truth)),
    work=lambda state, _kernel: float(state.truth.size),
    levels=lambda _state: noise_levels(LineCamera()),
    moved_bytes=6.0,  # a uint16 read and a float32 written
)


SHAPE = (192, 320)
STEPS = (1, 2, 3, 4, 6, 8)


@dataclass(frozen=True)
class CapturedAtStep:
    """Sweeps of one strip by their step, calibrated, and what a full scan without noise makes of the scene."""

    camera: LineCamera
    sweeps: dict[int, tuple[SimulatedSweep, Values]]
    full: Values  # (y, x, band)
    noise: float  # of one line over the scene's standard deviation


def _prepare_steps(seed: int) -> CapturedAtStep:
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
    return lines, np.ascontiguousarray(values[..., ::8])


def _rectify(camera: LineCamera, lines: SimulatedSweep, values: Values) -> Values:
    origin = (-(SHAPE[0] - 1) / 2, -(SHAPE[1] - 1) / 2)
    coordinates = lookup(lines.position, camera, grid_points(origin, 1.0, SHAPE), along="x")
    seen, _ = resample(values, np.ones(values.shape[:2], bool), coordinates.reshape(-1, 2))
    return seen.reshape(*SHAPE, -1)


SCAN_STEP = Tradeoff(
    stage="rectify",
    knob="scan step",
    error="rmse / standard deviation",
    unit="scene px",
    reference=f"full scan without noise of a farm of {SHAPE[1]} x {SHAPE[0]} px",
    settings=STEPS,
    prepare=_prepare_steps,
    run=lambda state, step: _rectify(state.camera, *state.sweeps[int(step)]),
    judge=lambda state, _step, out: float(np.sqrt(np.nanmean((out - state.full) ** 2)) / np.nanstd(state.full)),
    work=lambda _state, _step: float(SHAPE[0] * SHAPE[1]),
    modelled_s=lambda state, step, _out: CostModel().seconds([state.sweeps[int(step)][0].sweep], state.camera),
    levels=lambda state: (Level("σ of noise", state.noise), Level("0.1 σ of noise", 0.1 * state.noise)),  # noqa: RUF001
)


TIED = Sweep("ties", "fine", "x", strip_px=2500.0, start_px=-2000.0, lines=620)  # turned by 13 to 15 deg
ORIGIN_PX, TIED_SHAPE = (-1930.0, 2230.0), (480, 540)  # of a grid that the sweep covers
ROWS = 64  # handed on at a time


@dataclass(frozen=True)
class TiesLookedUp:
    """A sweep over a grid, and the exact line and sample of every pixel."""

    camera: LineCamera
    track: Track
    exact: Floats  # (y, x, 2)


def _prepare_ties(_seed: int) -> TiesLookedUp:
    camera = LineCamera()
    (track,) = make_tracks(line_positions(TIED, camera), camera)
    y, x = (origin + np.arange(size) for origin, size in zip(ORIGIN_PX, TIED_SHAPE, strict=True))
    return TiesLookedUp(camera, track, scene_to_sweep(TIED, camera, *np.broadcast_arrays(x[None, :], y[:, None])))


def _look_up(state: TiesLookedUp, spacing: Setting) -> list[Floats]:
    table = tie_table(
        state.track,
        state.camera,
        along=TIED.along,
        binning=TIED.binning,
        origin_px=ORIGIN_PX,
        spacing_px=1.0,
        shape=TIED_SHAPE,
        tie=int(spacing),
        tolerance_px=np.inf,
    )
    rows, columns = TIED_SHAPE
    return [table.coordinates(slice(row, min(row + ROWS, rows)), slice(0, columns)) for row in range(0, rows, ROWS)]


TIE_SPACING = Tradeoff(
    stage="rectify",
    knob="tie spacing",
    error="greatest error of line and sample [px]",
    unit="px",
    reference=f"closed form over {TIED_SHAPE[1]} x {TIED_SHAPE[0]} px; 1: no ties",
    settings=(1, 8, 16, 32, 64),
    prepare=_prepare_ties,
    run=_look_up,
    judge=lambda state, _spacing, out: float(np.abs(np.concatenate(out) - state.exact).max()),
    work=lambda state, _spacing: float(state.exact.size / 2),
    levels=lambda _state: (Level("goal of 0.002 px", 2e-3),),
    moved_bytes=16.0,
)
register_all(LINE_MODEL, OVERLAP, RESAMPLE, SCAN_STEP, TIE_SPACING)
