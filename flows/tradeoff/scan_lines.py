"""The lines of a uniform scan that are to be stored, and how good what comes back of them is: spectra and the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import SignalChoice
from flows.tasks.scene import judged_labels
from flows.tasks.stages.accuracy import columns_of_raster, columns_of_sweeps
from flows.tasks.survey_model import shipped_weights
from flows.training.data import scene_of_file
from models.evaluation.metrics import confusion, mean_iou
from models.network.spectral import LineSpec
from models.reading.inference import coarse_prediction_of_patches, segment
from models.weights.files import Weights, describe_weights, load_weights
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, uniform_sweeps
from pipeline.signal.calibrate import calibrate
from pipeline.signal.components import Components
from pipeline.signal.subspace import SignalStatistics, find_components
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_block
from pipeline.source import References
from storage.readers.raster_fields import RasterPixels
from storage.readers.scene_files import load_scene_file

Values = NDArray[np.float32]
FIELD_SHAPE = (256, 600)  # one swath
EXPOSURE_MS = 10.0
BLOCK_PX = 64  # to a side, over which residuals are averaged
MEMORY = 2**30  # bytes that rectifying may take


@dataclass(frozen=True, eq=False)
class HeldLines:
    """The lines of one sweep in memory, raw or in scene values."""

    sweep: Sweep
    references: References
    position: NDArray[np.float64]  # (line, 2) mirror X and Y
    time_s: NDArray[np.float64]  # (line,)
    data: NDArray[Any]  # (line, sample, band)

    @property
    def valid_line(self) -> NDArray[np.bool_]:
        """(line,) all of them."""
        return np.ones(len(self.data), np.bool_)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Numbers of the lines ``start`` to ``stop``, (line, sample, band)."""
        return self.data[start:stop]


@dataclass(frozen=True)
class Fidelity:
    """Distance of restored spectra from what was there, in deviations of the noise, and the score of their map."""

    error: float  # root mean square against the truth
    block_mean: float  # largest mean of a band over 64 x 64 spectra against the truth
    miou: float  # in %; NaN without labels


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Raw lines of a scan, the scene values that they give, and what is known of both."""

    lines: HeldLines  # raw numbers, uint16
    camera: LineCamera
    wavelength_nm: NDArray[np.float64]
    values: Values  # (line, sample, band) scene values of the raw lines
    truth: Values  # likewise without noise; the values themselves where it is unknown
    sigma: Values  # deviation of the noise of a value, as large or (band,)
    noise_dn: NDArray[np.float64]  # (band,) of raw numbers, on average
    rank: int  # components that rise above the noise
    miou: Callable[[Values], float]
    judged: dict[object, Fidelity]  # by setting, for its figures to share

    def calibrated(self, dn: NDArray[Any]) -> Values:
        """Scene values of restored numbers, (line, sample, band)."""
        return _calibrated(dn, self.lines)

    def fidelity(self, restored: Values) -> Fidelity:
        """Compare restored scene values, (line, sample, band), with what was there."""
        off = (restored - self.truth) / self.sigma
        error = float(np.sqrt(np.mean(np.square(off), dtype=np.float64)))
        return Fidelity(error, float(np.abs(block_means_of(off, BLOCK_PX)).max()), 100 * self.miou(restored))


def block_means_of(values: Values, side: int) -> NDArray[np.float32]:
    """Means of whole blocks of lines and samples, (block, block, band); smaller images are one block."""
    down, across = (min(side, size) for size in values.shape[:2])
    lines, samples = values.shape[0] // down, values.shape[1] // across
    cut = values[: lines * down, : samples * across].reshape(lines, down, samples, across, -1)
    means: NDArray[np.float32] = cut.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return means


def scan_farm(seed: int, shape: tuple[int, int] = FIELD_SHAPE, camera: LineCamera | None = None) -> ScanLines:
    """Scan a farm of one swath, every line at 10 ms, with the light that the lines had before it was read out."""
    camera, weights = camera or LineCamera(), load_weights(shipped_weights())
    grid = SceneGrid(*shape, weights.config.patch, 1)
    source = SimulatedSource(farm_scene(seed, shape, camera=camera), Rig(camera), seed)
    along, _, _ = cheapest_full(grid, camera, CostModel())
    (sweep,) = uniform_sweeps(grid, camera, along, step=1, exposure_ms=EXPOSURE_MS)
    block = sweep_block(source.scene, source.rig, sweep, range(sweep.lines), seed=seed)
    light = expected_light(source.scene, block, source.choice)
    seen, per_dn = SimulatedSweep(source, sweep), np.float32(camera.electrons_per_dn)
    raw, noise_dn = read_out(light, block, source.choice), noise_electrons(light, block.rig) / per_dn
    lines = HeldLines(sweep, seen.references, seen.position, seen.time_s, raw)
    labels = np.asarray(source.scene.labels, np.uint8)

    def miou(values: Values) -> float:
        """Rectify scene values, bring them to columns and read them, as a survey does."""
        plain = replace(lines, references=_as_they_are(values.shape), data=values)
        columns = columns_of_sweeps(
            [plain], camera, source.wavelength_nm, grid, weights, memory=MEMORY, resampling="catmull-rom"
        )
        return _miou(weights, columns, grid, labels, LineSpec(EXPOSURE_MS / DEFAULT_EXPOSURE_MS))

    dark = dark_frame(block, source.choice)
    truth, sigma = _calibrated(light / per_dn + dark, lines), _calibrated(noise_dn + dark, lines)
    mean_dn = np.sqrt(np.mean(np.square(noise_dn), axis=(0, 1), dtype=np.float64))
    values = _calibrated(raw, lines)
    rank = len(_components(values))
    return ScanLines(lines, camera, source.wavelength_nm, values, truth, sigma, mean_dn, rank, miou, {})


def scan_raster(path: str, weights_path: Path | None) -> ScanLines:
    """Take the pixels of a raster as lines; its noise is estimated. SceneError: it has gaps, or no whole numbers."""
    file = load_scene_file(path, labels_needed=False)
    values = file.values
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > 65_534 or (values != np.rint(values)).any():
        raise SceneError(
            f"{path} holds numbers that are no whole ones from 0 to 65534, or gaps: lines of a scan have neither; "
            "choose a cube of raw numbers, or scale it"
        )
    sweep = Sweep("raster", "coarse", "x", 0.0, 0.0, len(values))
    position, time_s = np.zeros((len(values), 2)), np.arange(len(values), dtype=np.float64)
    lines = HeldLines(sweep, _as_they_are(values.shape), position, time_s, values.astype(np.uint16))
    components = _components(values)
    known = np.where(np.isfinite(components.noise) & (components.noise > 0), components.noise, 1.0)

    def miou(restored: Values) -> float:
        """Read pixels where they are."""
        if weights_path is None or file.labels is None:
            return float("nan")
        weights = load_weights(weights_path)
        grid = SceneGrid(*file.shape, weights.config.patch, 1)
        raster = RasterPixels(lambda first, last: restored[first:last].copy(), file.missing, restored.shape[2], grid)
        columns = columns_of_raster(raster, weights, file.wavelength_nm, memory=4 * MEMORY)
        labels = judged_labels(scene_of_file(file, LineCamera()), describe_weights(weights_path))
        assert labels is not None
        return _miou(weights, columns, grid, labels)

    camera = LineCamera(bits=16)
    sigma, rank = known.astype(np.float32), len(components)
    return ScanLines(lines, camera, file.wavelength_nm, values, values, sigma, known, rank, miou, {})


def _calibrated(dn: NDArray[Any], lines: HeldLines) -> Values:
    return calibrate(dn, lines.references, saturated_dn=np.inf, position=lines.position)[0]


def _components(values: Values) -> Components:
    """Find the components of scene values (line, sample, band), all at once."""
    found = SignalStatistics(values.shape[2], values.shape[0] * values.shape[1])
    found.add(values, np.ones(values.shape[:2], np.bool_))
    return find_components(found, false_alarm=SignalChoice().false_alarm, least=SignalChoice().least)


def _as_they_are(shape: tuple[int, ...]) -> References:
    """References by which numbers are scene values."""
    frame = np.zeros(shape[1:], np.float32)
    return References(frame, frame + 1, np.ones(shape[2], np.float32))


def _miou(
    weights: Weights,
    columns: Values,
    grid: SceneGrid,
    labels: NDArray[np.uint8],
    capture: LineSpec = LineSpec(),  # noqa: B008
) -> float:
    """Draw the map of all patches and judge it."""
    patch_index = grid.valid_patches()
    seen = coarse_prediction_of_patches(weights, columns, grid, capture)
    drawn = segment(weights, seen, columns[patch_index], patch_index)
    return mean_iou(confusion(labels, drawn.classes, weights.config.classes))
