"""The verb `tradeoff`: what accuracy costs in time, processor time and bytes, stage by stage.

Settings of a stage run in turn on one thread. A loaded machine then slows all of them alike.
"""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter
from cyclopts.validators import Number
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from scipy.ndimage import gaussian_filter

from spectralzoom.flows.field import Field
from spectralzoom.flows.opening.open_field import open_field
from spectralzoom.flows.settings.flags import AsJson, OutFile
from spectralzoom.flows.settings.settings import Settings, load_settings
from spectralzoom.flows.settings.values import RASTER
from spectralzoom.flows.terminal.figures import counted, format_bytes
from spectralzoom.flows.terminal.processes import writing
from spectralzoom.flows.terminal.progress import on_stdout, print_json, show_text, stderr, table
from spectralzoom.models.evaluation.metrics import confusion, mean_iou
from spectralzoom.models.evaluation.taught_labels import check_labels
from spectralzoom.models.network.machine import keep_freed_memory, one_thread
from spectralzoom.models.network.sizes import TOKEN_PX
from spectralzoom.models.network.spectral import LineSpec
from spectralzoom.models.policies.policies import score_patches
from spectralzoom.models.reading.inference import (
    CoarsePrediction,
    DrawnMap,
    read_coarse_pass,
    read_coarse_prediction,
    segment,
)
from spectralzoom.models.weights.files import Weights
from spectralzoom.pipeline.errors import SceneError, SettingsError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import UNLABELLED, SceneGrid, cuts
from spectralzoom.pipeline.geometry.scan import CostModel
from spectralzoom.pipeline.planning.coverage import (
    BYTES_PER_SAMPLE,
    cheapest_full,
    frame_patches,
    raw_bytes,
    uniform_sweeps,
)
from spectralzoom.pipeline.planning.uniform_scans import format_scan
from spectralzoom.pipeline.rectify.kernels import Kernel
from spectralzoom.pipeline.rectify.region import mosaic_rows
from spectralzoom.pipeline.rectify.resample import resample
from spectralzoom.pipeline.signal.calibrate import calibrate
from spectralzoom.pipeline.signal.components import SignalChoice
from spectralzoom.pipeline.signal.condense import score_lines
from spectralzoom.pipeline.signal.lines import BLOCK_LINES
from spectralzoom.pipeline.signal.rounding import whole_steps
from spectralzoom.pipeline.signal.subspace import SignalStatistics, find_components
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.probe import noise_electrons
from spectralzoom.pipeline.simulator.readout import dark_frame, read_out
from spectralzoom.pipeline.simulator.render import EFFECTS, USUAL, expected_light
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS, RasterScene
from spectralzoom.pipeline.simulator.selection.choice import Decision, decide
from spectralzoom.pipeline.simulator.selection.survey_probe import probe_scene
from spectralzoom.pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_block
from spectralzoom.pipeline.source import SweepLines
from spectralzoom.storage.arrays.layout import packed_size
from spectralzoom.storage.whole_files import to_json

Setting = str | float
Values = NDArray[np.float32]


@dataclass(frozen=True)
class Figures:
    """Error of a setting, bytes of what it keeps or reads, and the camera's seconds where it scans."""

    error: float
    bytes: int
    camera_s: float | None = None


Run = Callable[[Any], Any]
Judge = Callable[[Any, Any], Figures]


@dataclass(frozen=True)
class Tradeoff:
    """Define the measurement of one stage.

    ``prepare`` takes a seed, a scene and weights; the last two are None without a scene of one's own. It returns a
    function of a setting, which is timed, and another one that judges a setting by the result.
    """

    stage: str
    knob: str
    error: str  # with its unit
    bytes: str  # whose they are
    settings: tuple[Setting, ...]
    prepare: Callable[[int, str | None, Path | None], tuple[Run, Judge]]
    default: Setting | None = None  # setting of a survey by its defaults
    takes_scene: bool = False


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, load and versions of the numerical packages."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "processor": next(names, platform.processor() or "unknown"),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 2),  # over the last minute
        "versions": {
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "torch")},
        },
    }


def measure_tradeoff(
    tradeoff: Tradeoff, *, repeats: int = 5, seed: int = 0, scene: str | None = None, weights: Path | None = None
) -> dict[str, Any]:
    """Judge every setting by its first run, and time ``repeats`` runs of each in turn, on one thread.

    Every round begins with another setting. Times are the least of all rounds; ``time_s`` is that of the camera where
    the setting scans.
    """
    run, judge = tradeoff.prepare(seed, scene, weights)
    settings = list(tradeoff.settings)
    figures: dict[Setting, Figures] = {}
    clocks: dict[Setting, list[tuple[float, float]]] = {one: [] for one in settings}
    with one_thread():
        for turn in range(repeats):
            first = turn % len(settings)
            for one in settings[first:] + settings[:first]:
                gc.collect()
                wall, processor = time.perf_counter(), time.process_time()
                result = run(one)
                clocks[one].append((time.perf_counter() - wall, time.process_time() - processor))
                if turn == 0:
                    figures[one] = judge(one, result)
    points = []
    for one, found in figures.items():
        wall, processor = (min(times) for times in zip(*clocks[one], strict=True))
        times = {"time_s": found.camera_s or wall, "processor_s": processor}
        points.append({"setting": one, "error": found.error, **times, "bytes": found.bytes})
    about = {name: getattr(tradeoff, name) for name in ("stage", "knob", "error", "bytes", "default")}
    return {**about, "repeats": repeats, "seed": seed, "machine": describe_machine(), "points": points}


# rectify: kernels, between the pixels of a blurred farm

FINE = 4  # pixels of the truth to a sample
BLUR = 0.7  # deviation [samples], about that of the rig's light spread
RECTIFY_SHAPE = (1024, 1024)  # of the truth
POINTS = 40_000


def scatter_points(seed: int, _scene: str | None = None, _weights: Path | None = None) -> tuple[Run, Judge]:
    """Resample a blurred farm, sampled at every fourth pixel, at its other pixels in the order of a grid's rows.

    The error is the root mean square one over the standard deviation of the scene.
    """
    values = farm_scene(seed, RECTIFY_SHAPE).values()[..., ::4]
    fine = gaussian_filter(values, (FINE * BLUR, FINE * BLUR, 0))
    pixels = np.random.default_rng(seed).integers(2 * FINE, np.array(fine.shape[:2]) - 3 * FINE, (POINTS, 2))
    pixels = pixels[np.lexsort((pixels[:, 1], pixels[:, 0] // FINE))]
    samples, truth = fine[::FINE, ::FINE].copy(), fine[tuple(pixels.T)]
    valid = np.ones(samples.shape[:2], bool)

    def judge(_kernel: Kernel, found: Values) -> Figures:
        return Figures(float(np.sqrt(np.mean((found - truth) ** 2)) / np.std(truth)), found.nbytes)

    return lambda kernel: resample(samples, valid, pixels / FINE, kernel)[0], judge


RECTIFY = Tradeoff(
    stage="rectify",
    knob="resampling",
    error="rmse / standard deviation of the scene",
    bytes="values",
    settings=("nearest", "bilinear", "catmull-rom"),
    default=Settings().resampling,
    prepare=scatter_points,
)


# simulate: effects left out by their bounds, on lines of a farm

LAND_SHAPE = (512, 1280)
PATCH = 16
LINES = 8  # at each end of a sweep and in its middle
EXACT = "exact"
TOLERANCES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)  # sigma


def decide_for_lines(seed: int) -> tuple[RasterScene, list[SweepBlock], dict[Setting, Decision]]:
    """Return a farm, lines of the first sweep of its full scan, and the decision on effects for every tolerance."""
    scene = farm_scene(seed, LAND_SHAPE)
    rig = Rig()
    _, sweeps, _ = cheapest_full(SceneGrid(*LAND_SHAPE, PATCH), rig.camera, CostModel())
    probe = probe_scene(scene, rig, sweeps)
    starts = (0, (sweeps[0].lines - LINES) // 2, sweeps[0].lines - LINES)
    blocks = [sweep_block(scene, rig, sweeps[0], range(at, at + LINES), seed=seed) for at in starts]
    limits: dict[Setting, float] = {EXACT: 0.0} | {one: one for one in TOLERANCES}
    return scene, blocks, {one: decide(probe, rig, EFFECTS, limit) for one, limit in limits.items()}


def simulate_lines(seed: int, _scene: str | None = None, _weights: Path | None = None) -> tuple[Run, Judge]:
    """Simulate lines of a farm with the effects that a tolerance leaves.

    The error is the greatest change against all exact effects, in deviations of the sample's noise.
    """
    scene, blocks, decisions = decide_for_lines(seed)
    rig = blocks[0].rig

    def simulate(setting: Setting) -> tuple[Values, NDArray[np.uint16]]:
        """Return expected electrons before the readout, and raw numbers, (line, sample, band) each."""
        chosen = decisions[setting].chosen
        light = [expected_light(scene, block, chosen) for block in blocks]
        raw = [read_out(one, block, chosen) for one, block in zip(light, blocks, strict=True)]
        return np.concatenate(light), np.concatenate(raw)

    def electrons(setting: Setting, light: Values) -> Values:
        per_dn = np.float32(rig.camera.electrons_per_dn)
        return light + dark_frame(blocks[0], decisions[setting].chosen) * per_dn

    exact = electrons(EXACT, simulate(EXACT)[0])

    def judge(setting: Setting, made: tuple[Values, NDArray[np.uint16]]) -> Figures:
        off = (electrons(setting, made[0]) - exact) / noise_electrons(exact, rig)
        return Figures(float(np.abs(off).max()), packed_size(made[1]))

    return simulate, judge


SIMULATE = Tradeoff(
    stage="simulate",
    knob="tolerance [σ]",  # noqa: RUF001
    error="greatest change of a sample [σ of its noise]",  # noqa: RUF001
    bytes="raw numbers, packed",
    settings=(EXACT, *TOLERANCES),
    default=Settings().tol.value,
    prepare=simulate_lines,
)


# condense: the step of scores, on a sweep over a farm

FIELD_SHAPE = (128, 600)  # one swath
EXPOSURE_MS = 10.0
RAW = "raw"
STEPS = (0.5, 1.0, 2.0, 3.0)  # deviations of the noise
SIGNAL = SignalChoice()


def condense_farm(seed: int, _scene: str | None = None, _weights: Path | None = None) -> tuple[Run, Judge]:
    """Condense a scan of a farm of one swath by every line at 10 ms.

    The error is the root mean square one of restored spectra, in deviations of the simulator's noise. The bytes are
    those of the numbers as stores pack them.
    """
    rig = Rig()
    scene = farm_scene(seed, FIELD_SHAPE)
    along, _, _ = cheapest_full(SceneGrid(*FIELD_SHAPE, PATCH), rig.camera, CostModel())
    (sweep,) = uniform_sweeps(SceneGrid(*FIELD_SHAPE, PATCH), rig.camera, along, step=1, exposure_ms=EXPOSURE_MS)
    block = sweep_block(scene, rig, sweep, range(sweep.lines), seed=seed)
    light, dark = expected_light(scene, block, USUAL), dark_frame(block, USUAL)
    raw = read_out(light, block, USUAL)
    lines = SimulatedSweep(SimulatedSource(scene, rig, seed), sweep)
    per_dn = np.float32(rig.camera.electrons_per_dn)

    def calibrated(dn: NDArray[Any]) -> tuple[Values, NDArray[np.bool_]]:
        return calibrate(dn, lines.references, saturated_dn=np.inf, position=lines.position)

    values, valid = calibrated(raw)
    statistics = SignalStatistics(values.shape[2], values[..., 0].size)
    for part in cuts(len(values), BLOCK_LINES):
        statistics.add(values[part], valid[part])
    components = find_components(statistics, false_alarm=SIGNAL.false_alarm, least=SIGNAL.least)
    truth = calibrated(light / per_dn + dark)[0]
    sigma = calibrated(noise_electrons(light, block.rig) / per_dn + dark)[0]

    def condense(step: Setting) -> NDArray[Any]:
        """Return the raw numbers, or the scores in whole steps, (line, sample, component)."""
        if step == RAW:
            return raw
        return whole_steps(score_lines(values, valid, components).scores, float(step)).astype(np.int16)

    def judge(step: Setting, kept: NDArray[Any]) -> Figures:
        restored = values if step == RAW else components.restore(kept.astype(np.float32) * np.float32(step))
        planes = kept if step == RAW else np.ascontiguousarray(kept.transpose(2, 0, 1))
        off = (restored - truth) / sigma
        return Figures(float(np.sqrt(np.mean(np.square(off), dtype=np.float64))), packed_size(planes))

    return condense, judge


CONDENSE = Tradeoff(
    stage="condense",
    knob="step [σ]",  # noqa: RUF001
    error="rmse of a spectrum [σ of its noise]",  # noqa: RUF001
    bytes="kept numbers, packed",
    settings=(RAW, *STEPS),
    default=SIGNAL.step,
    prepare=condense_farm,
)


# survey: uniform scans; segment: fractions of the patches

FARM_SHAPE = (384, 512)
ROWS = 64  # that are rectified at a time
SCANS = {format_scan(step, ms): (step, ms) for step in (1, 2, 4) for ms in (100.0, 50.0, 25.0, 12.0, 6.0)}
FRACTIONS = (1.0, 0.35, 0.2, 0.15, 0.1, 0.05, 0.0)
POLICY = "gain"


@dataclass(frozen=True)
class PlannedPass:
    """A coarse prediction, the patches to read in full, and the cost of the scan."""

    coarse: CoarsePrediction
    patch_index: NDArray[np.intp]
    bytes: int
    seconds: float | None = None  # of the camera


def reading_of(field: Field, passes: Mapping[Setting, PlannedPass]) -> tuple[Run, Judge]:
    """Segment a field with labels by several plans; the overview is read anew, whose time counts.

    The error is 1 - mIoU of the map; bytes and seconds are those of the scan.
    """
    labels = field.labels.read()
    assert labels is not None
    for note in check_labels(field.scene, field.described):
        show_text(f"note: {note}")

    def read(plan: Setting) -> DrawnMap:
        one = passes[plan]
        coarse = replace(one.coarse, overview=None)
        return segment(field.model.load(), coarse, coarse.patches(one.patch_index), one.patch_index)

    def judge(plan: Setting, drawn: DrawnMap) -> Figures:
        miou = mean_iou(confusion(labels, drawn.classes, field.model.load().config.classes))
        return Figures(1 - miou, passes[plan].bytes, passes[plan].seconds)

    return read, judge


def coarse_of_sweeps(
    sweeps: Sequence[SweepLines],
    camera: LineCamera,
    wavelength_nm: NDArray[np.floating],
    grid: SceneGrid,
    weights: Weights,
    capture: LineSpec = LineSpec(),  # noqa: B008 - a value
) -> CoarsePrediction:
    """Rectify sweeps over a scene to its pixels, and predict from them."""
    blocks = mosaic_rows(sweeps, camera, grid, rows=ROWS)
    return read_coarse_prediction(weights, read_coarse_pass(weights, blocks, wavelength_nm, grid, capture=capture))


def open_labelled(seed: int, scene: str | None, weights: Path | None, source: str) -> Field:
    """Open a field as a survey by its defaults does, or a farm without a ``scene``; nothing is written.

    Raises SceneError: it has no labels; else as `flows.field.open_field`.
    """
    farm = {"scene": "farm", "size": "{1}x{0}".format(*FARM_SHAPE)}
    asked = {**(farm if scene is None else {"scene": scene}), "source": source, "seed": seed, "weights": weights}
    settings = load_settings(None, {name: str(one) for name, one in asked.items() if one is not None})
    field = open_field(settings, planning=True)
    labels = field.labels.read()
    if labels is None or (labels == UNLABELLED).all():
        raise SceneError(f"{scene} has no labels by which a map could be judged; lay a label file beside it")
    return field


def plan_scans(seed: int, scene: str | None = None, weights: Path | None = None) -> tuple[Run, Judge]:
    """Scan a farm or another scene by every uniform scan."""
    field = open_labelled(seed, scene, weights, "sim")
    grid = SceneGrid(*field.scene.shape, field.described.config.patch)
    along, _, _ = cheapest_full(grid, field.camera, field.settings.cost)
    bands = field.scene.wavelength_nm
    passes: dict[Setting, PlannedPass] = {}
    for name, (step, exposure_ms) in SCANS.items():
        sweeps = uniform_sweeps(grid, field.camera, along, step=step, exposure_ms=exposure_ms)
        scan = LineSpec(exposure_ms / DEFAULT_EXPOSURE_MS, step)
        seen = [SimulatedSweep(field.simulated, sweep) for sweep in sweeps]
        coarse = coarse_of_sweeps(seen, field.camera, bands, grid, field.model.load(), scan)
        size, seconds = raw_bytes(sweeps, field.camera, len(bands)), field.settings.cost.seconds(sweeps, field.camera)
        passes[name] = PlannedPass(coarse, grid.every_patch(), size, seconds)
    return reading_of(field, passes)


def plan_fractions(seed: int, scene: str | None = None, weights: Path | None = None) -> tuple[Run, Judge]:
    """Scan a farm by every line, or take a raster as it is; choose every fraction of its patches by expected gain."""
    field = open_labelled(seed, scene, weights, "sim" if scene is None else RASTER)
    grid, raster, wavelength_nm = field.grid, field.raster, field.scene.wavelength_nm
    keep_freed_memory()  # as surveys do
    if raster is not None:
        parts = cuts(grid.height, raster.rows_at_once(field.settings.memory))
        blocks = (raster.rows(part.start, part.stop) for part in parts)
        coarse = read_coarse_prediction(
            field.model.load(), read_coarse_pass(field.model.load(), blocks, wavelength_nm, grid)
        )
    else:
        _, full, _ = cheapest_full(grid, field.camera, field.settings.cost)
        seen = [SimulatedSweep(field.simulated, sweep) for sweep in full]
        coarse = coarse_of_sweeps(seen, field.camera, wavelength_nm, grid, field.model.load())
    scores = score_patches(POLICY, coarse)
    passes: dict[Setting, PlannedPass] = {}
    for fraction in FRACTIONS:
        chosen = frame_patches(scores, fraction) if fraction < 1 else grid.every_patch()
        pixels = grid.height * grid.width // TOKEN_PX**2 + len(chosen) * grid.patch**2
        passes[fraction] = PlannedPass(coarse, chosen, pixels * len(wavelength_nm) * BYTES_PER_SAMPLE)
    return reading_of(field, passes)


SURVEY = Tradeoff(
    stage="survey",
    knob="scan",
    error="1 - mIoU",
    bytes="raw numbers",
    settings=tuple(SCANS),
    prepare=plan_scans,
    takes_scene=True,
)
SEGMENT = replace(
    SURVEY,
    stage="segment",
    knob="fraction of patches",
    bytes="raw numbers of these patches and of means",
    settings=FRACTIONS,
    prepare=plan_fractions,
)
TRADEOFFS = {one.stage: one for one in (CONDENSE, RECTIFY, SEGMENT, SIMULATE, SURVEY)}


# the verb


def tradeoff(
    stage: str | None = None,
    *,
    scene: str | None = None,
    weights: Path | None = None,
    out: OutFile = Path("tradeoff"),
    repeats: Annotated[int, Parameter(validator=Number(gte=1))] = 5,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 0,
    as_json: AsJson = False,
) -> int:
    """Measure what accuracy costs in time and bytes, for STAGE or for all stages with a choice.

    Parameters
    ----------
    stage
        condense, rectify, segment, simulate or survey. Default: all.
    scene
        Labelled scene instead of a farm: a raster for segment, a scene of the simulated rig for survey.
    weights
        Weights for the classes of the scene.
    out
        Folder of tradeoff.json.
    repeats
        Rounds that time every setting once.
    seed
        Random seed of the scenes.
    """
    wanted = choose_tradeoffs(stage, scene, weights)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)  # fails before minutes are spent
    results = []
    for one in wanted:
        with stderr.status(f"measuring {one.stage}: {one.knob}"):
            results.append(measure_tradeoff(one, repeats=repeats, seed=seed, scene=scene, weights=weights))
        print_tradeoff(results[-1], stderr if as_json else on_stdout())
    content = {"tradeoffs": results}
    with writing(out):
        (out / "tradeoff.json").write_text(to_json(content), encoding="utf-8")
    show_text(str(out / "tradeoff.json"))
    if as_json:
        print_json(content)
    return 0


def choose_tradeoffs(stage: str | None, scene: str | None, weights: Path | None) -> list[Tradeoff]:
    """Return the trade-off of a stage, or all; with a scene only those that take one. Raises SettingsError."""
    if stage is not None and stage not in TRADEOFFS:
        raise SettingsError(f"no trade-off for stage {stage!r}; there are: {', '.join(TRADEOFFS)}")
    chosen = list(TRADEOFFS.values()) if stage is None else [TRADEOFFS[stage]]
    if scene is None and weights is None:
        return chosen
    chosen = [one for one in chosen if one.takes_scene]
    if scene is None or weights is None or not chosen:
        raise SettingsError(
            "--scene FILE and --weights FILE go together, with the stages segment and survey: "
            "spectralzoom tradeoff survey --scene FILE --weights FILE"
        )
    return chosen


def print_tradeoff(result: Mapping[str, Any], console: Console) -> None:
    """Print the four measures of all settings, from the least error up."""
    rows = []
    for point in sorted(result["points"], key=lambda point: float(point["error"])):
        name = f"{point['setting']}{' (default)' if point['setting'] == result['default'] else ''}"
        times = [f"{point[time]:.3g} s" for time in ("time_s", "processor_s")]
        rows.append([escape(name), f"{point['error']:.3g}", *times, format_bytes(point["bytes"])])
    headings = ("error", "time", "processor\ntime", "bytes")
    title = f"{result['stage']}: what accuracy costs"
    console.print(table((escape(result["knob"]), *headings), rows, title=title, whole=headings))
    machine = result["machine"]
    caption = (
        f"error: {result['error']}; bytes: {result['bytes']}\n{counted(result['repeats'], 'repeat')} in turn, one"
        f" thread, load {machine['load']}, {machine['processor']}"
    )
    console.print(escape(caption))
