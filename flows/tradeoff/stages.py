"""Define the trade-off of each stage: resampling, tolerance of effects, plan, fraction of patches.

`tests/benchmarks` uses the same scenes and readers.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from flows.settings.load import load_settings
from flows.settings.survey_settings import RASTER, Settings
from flows.tasks.patch_budget import ReadingCosts
from flows.tasks.run import SurveyRun, open_run
from flows.tasks.scene import check_labels
from flows.tradeoff.entries import Figures, Setting, Tradeoff
from flows.tradeoff.store import STORE, Values, coarse_of_sweeps
from models.evaluation.metrics import confusion, mean_iou
from models.network.machine import keep_freed_memory
from models.network.spectral import LineSpec
from models.policies.policies import score_patches
from models.reading.inference import CoarsePrediction, DrawnMap, read_coarse_pass, read_coarse_prediction, segment
from models.weights.files import Weights
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import UNLABELLED, SceneGrid, cuts
from pipeline.geometry.scan import CostModel, Floats, Sweep
from pipeline.planning.coverage import cheapest_full, frame_patches, full_sweeps, raw_bytes, uniform_sweeps
from pipeline.planning.uniform_scans import format_scan
from pipeline.rectify.kernels import Kernel
from pipeline.rectify.resample import resample
from pipeline.simulator.effects.effect import Effect, SweepBlock
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import EFFECTS, expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from pipeline.simulator.selection.choice import Decision, decide
from pipeline.simulator.selection.survey_probe import probe_scene
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_block
from storage.archive.archive import Archive

# rectify: kernels on plane waves, whose values are known at every point

SIDE, BANDS, POINTS = 256, 64, 40_000  # of the samples
PERIODS_PX = (4.0, 40.0)
CONTRAST = 0.2  # standard deviation of the scene over its mean, which fills half of the converter's range
WAVES = 24


@dataclass(frozen=True)
class Waves:
    """Sum of plane waves with phases and amplitudes of their own in each band."""

    frequency: Floats  # (wave, 2) cycles per px down and across
    cosine: Floats  # (wave, band)
    sine: Floats

    def at(self, coordinates: Floats) -> Floats:
        """Return exact values at (n, 2) positions [px], (n, band)."""
        phase = 2 * np.pi * coordinates @ self.frequency.T
        return np.cos(phase) @ self.cosine + np.sin(phase) @ self.sine


def draw_waves(seed: int, bands: int, periods_px: tuple[float, float]) -> Waves:
    """Draw waves of random directions, their periods even in logarithm."""
    rng = np.random.default_rng(seed)
    period = np.exp(rng.uniform(np.log(periods_px[0]), np.log(periods_px[1]), WAVES))
    angle = rng.uniform(0, np.pi, WAVES)
    frequency = np.stack([np.sin(angle), np.cos(angle)], axis=-1) / period[:, None]
    return Waves(frequency, rng.standard_normal((WAVES, bands)), rng.standard_normal((WAVES, bands)))


@dataclass(frozen=True)
class Scattered:
    """Samples on a grid, points between them, and the truth there."""

    samples: Values  # (line, sample, band)
    coordinates: Floats  # (n, 2)
    truth: Floats  # (n, band)


def scatter_points(seed: int) -> Scattered:
    """Draw samples of waves, and points at least 2 px inside, in the row order of a geolocation grid."""
    waves = draw_waves(seed, BANDS, PERIODS_PX)
    grid = np.argwhere(np.ones((SIDE, SIDE), bool)).astype(np.float64)
    coordinates = np.random.default_rng([seed, 1]).uniform(2, SIDE - 3, (POINTS, 2))
    coordinates = coordinates[np.lexsort((coordinates[:, 1], np.floor(coordinates[:, 0])))]
    return Scattered(waves.at(grid).astype(np.float32).reshape(SIDE, SIDE, BANDS), coordinates, waves.at(coordinates))


ELECTRONS = LineCamera().full_scale_e / 2
NOISE = math.sqrt(ELECTRONS + LineCamera().read_noise_e ** 2) / (CONTRAST * ELECTRONS)  # over the standard deviation
RECTIFY = Tradeoff(
    stage="rectify",
    knob="resampling",
    error="rmse / standard deviation",
    reference=f"waves of {PERIODS_PX[0]:g} to {PERIODS_PX[1]:g} px, evaluated at the output pixels",
    settings=("nearest", "bilinear", "catmull-rom"),
    default=Settings().resampling,
    prepare=scatter_points,
    run=lambda state, kernel: resample(
        state.samples, np.ones(state.samples.shape[:2], bool), state.coordinates, cast("Kernel", kernel)
    )[0],
    judge=lambda state, _kernel, out: Figures(float(np.sqrt(np.mean((out - state.truth) ** 2)) / np.std(state.truth))),
    level=("0.1 σ of noise", 0.1 * NOISE),  # noqa: RUF001
)


# simulate: effects left out by their bounds, on lines of a farm

LAND_SHAPE = (512, 1280)
LINES = 8  # at each end of a sweep and in its middle
PATCH = 16
EXACT = "exact"
TOLERANCES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # sigma


@dataclass(frozen=True)
class FarmLines:
    """Lines of an outer sweep over a farm, the decision for every tolerance, and the exact light of the samples."""

    scene: RasterScene
    rig: Rig
    blocks: tuple[SweepBlock, ...]
    decisions: Mapping[Setting, Decision]
    exact: Values  # (line, sample, band) [e-], with the dark signal
    noise: Values  # one sigma at each

    def judge(self, setting: Setting, made: tuple[Values, Any]) -> Figures:
        """Return the greatest change against all exact effects, in sigmas of the sample's noise, and its bound."""
        shown = made[0] + _dark(self.blocks[0], self.decisions[setting].chosen)
        change = float(np.abs((shown - self.exact) / self.noise).max())
        return Figures(change, beside={"bound [σ]": self.decisions[setting].error})  # noqa: RUF001


def _simulate(
    scene: RasterScene, blocks: tuple[SweepBlock, ...], chosen: Mapping[Effect, str]
) -> tuple[Values, NDArray[np.uint16]]:
    """Return expected electrons before the readout, and raw numbers, (line, sample, band) each."""
    light = [expected_light(scene, block, chosen) for block in blocks]
    raw = [read_out(one, block, chosen) for one, block in zip(light, blocks, strict=True)]
    return np.concatenate(light), np.concatenate(raw)


def _dark(block: SweepBlock, chosen: Mapping[Effect, str]) -> Values:
    return dark_frame(block, chosen) * np.float32(block.rig.camera.electrons_per_dn)


def decide_for_lines(seed: int) -> FarmLines:
    """Plan the full scan of a farm, decide on effects for every tolerance, and take lines of the first sweep."""
    scene = farm_scene(seed, LAND_SHAPE)
    rig = Rig()
    sweeps = full_sweeps(SceneGrid(*LAND_SHAPE, PATCH), rig.camera, "x")
    probe = probe_scene(scene, rig, sweeps)
    starts = (0, (sweeps[0].lines - LINES) // 2, sweeps[0].lines - LINES)
    blocks = tuple(sweep_block(scene, rig, sweeps[0], range(at, at + LINES), seed=seed) for at in starts)
    limits: dict[Setting, float] = {EXACT: 0.0} | {one: one for one in TOLERANCES}
    decisions = {one: decide(probe, rig, EFFECTS, limit) for one, limit in limits.items()}
    chosen = decisions[EXACT].chosen
    exact = _simulate(scene, blocks, chosen)[0] + _dark(blocks[0], chosen)
    return FarmLines(scene, rig, blocks, decisions, exact, noise_electrons(exact, rig))


SIMULATE = Tradeoff(
    stage="simulate",
    knob="tolerance",
    error="greatest change of a sample [σ of its noise]",  # noqa: RUF001
    reference="all effects of the rig, exact; mean over the noise",
    settings=(EXACT, *TOLERANCES),
    default=Settings().tol.value,
    prepare=decide_for_lines,
    run=lambda state, setting: _simulate(state.scene, state.blocks, state.decisions[setting].chosen),
    judge=FarmLines.judge,
    level=("0.1 σ of noise", 0.1),  # noqa: RUF001
)


# survey: uniform scans and parts of one, by the camera's seconds

FARM_SHAPE = (384, 512)
SCANS = {format_scan(step, ms): (step, ms) for step in (1, 2, 4) for ms in (100.0, 50.0, 25.0, 12.0, 6.0)}
PART_OF = (1, 25.0)  # step and exposure [ms] of the scan of which parts are read in full
PARTS = {f"{format_scan(*PART_OF)}, {fraction:.0%} of the patches": fraction for fraction in (0.5, 0.35, 0.2)}
POLICY = "gain"


@dataclass(frozen=True)
class PlannedPass:
    """A coarse prediction, the patches to read in full, and the cost of the scan."""

    coarse: CoarsePrediction
    patch_index: NDArray[np.intp]
    weights: Weights
    seconds: float | None = None
    bytes_raw: int = 0


@dataclass(frozen=True)
class PlannedField:
    """A field with labels, scanned or read by several plans."""

    labels: NDArray[np.uint8]
    costs: ReadingCosts
    passes: Mapping[Setting, PlannedPass]
    notes: tuple[str, ...] = ()  # on the labels

    def read(self, plan: Setting) -> DrawnMap:
        """Return the class map of a plan; the overview is read anew, whose time counts."""
        one = self.passes[plan]
        coarse = replace(one.coarse, overview=None)
        return segment(one.weights, coarse, coarse.patches(one.patch_index), one.patch_index)

    def judge(self, plan: Setting, drawn: DrawnMap) -> Figures:
        """Return 1 - mIoU of a map, the seconds of its scan, and the multiply-adds of the network."""
        one = self.passes[plan]
        raw = {} if one.seconds is None else {"MB raw": one.bytes_raw / 1e6}
        return Figures(
            error=1 - mean_iou(confusion(self.labels, drawn.classes, one.weights.config.classes)),
            cost=one.seconds,
            beside={**raw, "billion multiply-adds": self.costs.of_map(one.patch_index).total / 1e9},
        )


def uniform_pass(
    weights: Weights, source: SimulatedSource, sweeps: list[Sweep], grid: SceneGrid, cost: CostModel, capture: LineSpec
) -> PlannedPass:
    """Plan to read all patches of a uniform scan."""
    seen = [SimulatedSweep(source, sweep) for sweep in sweeps]
    coarse = coarse_of_sweeps(seen, source.camera, source.wavelength_nm, grid, weights, capture)
    size = raw_bytes(sweeps, source.camera, len(source.wavelength_nm))
    return PlannedPass(coarse, grid.every_patch(), weights, cost.seconds(sweeps, source.camera), size)


def open_field(seed: int, scene: str | None, weights: Path | None, source: str) -> SurveyRun:
    """Open a field as a survey by its defaults does, or a farm without a ``scene``; nothing is written.

    Raises SceneError: it has no labels; else as `flows.tasks.run.open_run`.
    """
    farm = {"scene": "farm", "size": "{1}x{0}".format(*FARM_SHAPE)}
    asked = {**(farm if scene is None else {"scene": scene}), "source": source, "seed": seed, "weights": weights}
    settings = load_settings(None, {name: str(one) for name, one in asked.items() if one is not None})
    with tempfile.TemporaryDirectory(prefix="spectralzoom-tradeoff-") as empty:
        run = open_run(settings, planning=True, archive=Archive(Path(empty), writes=False))
    if run.labels is None or (run.labels == UNLABELLED).all():
        raise SceneError(f"{scene} has no labels by which a map could be judged; lay a label file beside it")
    return run


def plan_every_way(seed: int, scene: str | None = None, weights: Path | None = None) -> PlannedField:
    """Scan a farm or another scene by every uniform scan, and read parts of one of them."""
    run = open_field(seed, scene, weights, "sim")
    grid = SceneGrid(*run.scene.shape, run.described.config.patch)
    along, _, _ = cheapest_full(grid, run.camera, run.settings.cost)
    passes: dict[Setting, PlannedPass] = {}
    for name, (step, exposure_ms) in SCANS.items():
        sweeps = uniform_sweeps(grid, run.camera, along, step=step, exposure_ms=exposure_ms)
        scan = LineSpec(exposure_ms / DEFAULT_EXPOSURE_MS, step)
        passes[name] = uniform_pass(run.weights, run.simulated, sweeps, grid, run.settings.cost, scan)
    whole = passes[format_scan(*PART_OF)]
    scores = score_patches(POLICY, whole.coarse)
    for name, fraction in PARTS.items():
        passes[name] = replace(whole, patch_index=np.sort(frame_patches(scores, fraction)))
    assert run.labels is not None
    return PlannedField(run.labels, run.costs, passes, check_labels(run.scene, run.described))


SURVEY = Tradeoff(
    stage="survey",
    knob="plan",
    error="1 - mIoU",
    reference=f"labels of a farm of {FARM_SHAPE[1]} x {FARM_SHAPE[0]} px; parts by expected gain",
    cost="seconds by the cost model",
    settings=(*SCANS, *PARTS),
    prepare=plan_every_way,
    run=PlannedField.read,
    judge=PlannedField.judge,
)


# segment: fractions of the patches read in full

FRACTIONS = (1.0, 0.35, 0.2, 0.15, 0.1, 0.05, 0.0)


def plan_every_fraction(seed: int, scene: str | None = None, weights: Path | None = None) -> PlannedField:
    """Scan a farm by every line, or take a raster as it is; choose every fraction of its patches by expected gain."""
    run = open_field(seed, scene, weights, "sim" if scene is None else RASTER)
    grid = run.grid
    raster = run.raster
    wavelength_nm = run.scene.wavelength_nm
    keep_freed_memory()  # as surveys do
    if raster is not None:
        parts = cuts(grid.height, raster.rows_at_once(run.settings.memory))
        blocks = (raster.rows(part.start, part.stop) for part in parts)
        coarse = read_coarse_prediction(run.weights, read_coarse_pass(run.weights, blocks, wavelength_nm, grid))
    else:
        _, full, _ = cheapest_full(grid, run.camera, run.settings.cost)
        seen = [SimulatedSweep(run.simulated, sweep) for sweep in full]
        coarse = coarse_of_sweeps(seen, run.camera, wavelength_nm, grid, run.weights)
    scores = score_patches(POLICY, coarse)
    chosen = {one: frame_patches(scores, one) if one < 1 else grid.every_patch() for one in FRACTIONS}
    assert run.labels is not None
    passes: dict[Setting, PlannedPass] = {one: PlannedPass(coarse, index, run.weights) for one, index in chosen.items()}
    return PlannedField(run.labels, run.costs, passes, check_labels(run.scene, run.described))


SEGMENT = Tradeoff(
    stage="segment",
    knob="fraction of patches",
    error="1 - mIoU",
    reference=f"labels of a farm of {FARM_SHAPE[1]} x {FARM_SHAPE[0]} px; policy {POLICY}, patches scored beforehand",
    settings=FRACTIONS,
    prepare=plan_every_fraction,
    run=PlannedField.read,
    judge=PlannedField.judge,
)


def survey_tradeoff(scene: str, weights: Path) -> Tradeoff:
    """Return the trade-off of `survey` on a given scene, captured by the simulated rig."""
    return replace(
        SURVEY,
        prepare=lambda seed: plan_every_way(seed, scene, weights),
        reference=f"labels of {Path(scene).name}, captured by the simulated rig; parts by expected gain",
    )


def segment_tradeoff(scene: str, weights: Path) -> Tradeoff:
    """Return the trade-off of `segment` on the pixels of a given raster."""
    return replace(
        SEGMENT,
        prepare=lambda seed: plan_every_fraction(seed, scene, weights),
        default=FRACTIONS[0],
        reference=f"labels of {Path(scene).name}; patches by {POLICY}, scored beforehand",
    )


TRADEOFFS = {one.stage: one for one in (RECTIFY, SEGMENT, SIMULATE, STORE, SURVEY)}
