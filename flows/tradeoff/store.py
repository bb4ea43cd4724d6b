"""The trade-off of storing lines: condensed spectra beside other methods.

The other methods are binned bands, pcodec of exact and of rounded numbers, principal components without whitening, and
those as JPEG 2000 (Du & Fowler 2007). Each gives scene values back, which are rectified and read as in a survey.
"""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import SignalChoice
from flows.tasks.scene import check_labels, judged_labels, scene_of_file
from flows.tasks.stages.condense import with_shared_directions
from flows.tasks.survey_model import shipped_weights
from flows.tradeoff.entries import Figures, Setting, Tradeoff
from models.evaluation.metrics import confusion, mean_iou
from models.network.spectral import LineSpec
from models.reading.inference import CoarsePrediction, read_coarse_pass, read_coarse_prediction, segment
from models.weights.files import Weights, describe_weights, load_weights
from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.coverage import cheapest_full, uniform_sweeps
from pipeline.rectify.region import mosaic_rows
from pipeline.signal.calibrate import calibrate
from pipeline.signal.components import Components
from pipeline.signal.condense import CondensedSweep, Condenser, ResidualLaw, calibrated_blocks, score_lines, whole_steps
from pipeline.signal.subspace import SignalStatistics, find_components
from pipeline.simulator.effects.probe import noise_electrons
from pipeline.simulator.readout import dark_frame, read_out
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.farm.farm_scene import farm_scene
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS
from pipeline.simulator.simulated import SimulatedSource, SimulatedSweep, sweep_block
from pipeline.source import References, SweepLines
from storage.arrays.cubes import SweepHeader
from storage.arrays.layout import numbers_in_memory
from storage.arrays.signal_cubes import LineRows, SignalCubeInMemory
from storage.readers.scene_files import load_scene_file

Values = NDArray[np.float32]
FIELD_SHAPE = (256, 600)  # one swath
EXPOSURE_MS = 10.0
BLOCK_PX = 64  # to a side, over which residuals are averaged
ROWS = 64  # that are rectified at a time
STEPS = (0.5, 1.0, 2.0, 3.0)  # deviations of the noise
BINS = (2, 4, 8, 17)  # bands
ROUNDED = (0.25, 0.5, 1.0)  # deviations of the noise
RATES = (1.0, 2.0, 4.0)  # bytes a spectrum
BLOCK_LINES = 64
JP2_DRIVER = "JP2OpenJPEG"
JP2_STEP = 0.25  # of scores before JPEG 2000 [deviations of the noise]
JP2_LARGEST = 32_000  # score in steps, before ``JP2_ZERO`` is added
JP2_ZERO = 1 << 15
USUAL = SignalChoice()  # of a survey


# lines of a scan, and the error of restored ones


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
        """Return that all lines are valid, (line,)."""
        return np.ones(len(self.data), np.bool_)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Return the numbers of the lines ``start`` to ``stop``, (line, sample, band)."""
        return self.data[start:stop]

    def calibrated(self, dn: NDArray[Any]) -> Values:
        """Return the scene values of raw numbers in place of its own, (line, sample, band)."""
        return calibrate(dn, self.references, saturated_dn=np.inf, position=self.position)[0]


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Raw lines of a scan, their scene values, and the truth about both."""

    lines: HeldLines  # raw numbers, uint16
    camera: LineCamera
    wavelength_nm: NDArray[np.float64]
    values: Values  # (line, sample, band) scene values of the raw lines
    truth: Values  # the same without noise; ``values`` where it is unknown
    sigma: Values  # deviation of the noise of a value, as large or (band,)
    noise_dn: NDArray[np.float64]  # (band,) of raw numbers, on average
    miou: Callable[[Values], float]  # NaN without labels
    notes: tuple[str, ...] = ()  # on the labels

    def judge(self, _setting: Setting, stored: KeptLines) -> Figures:
        """Compare restored scene values with the truth: root mean square, means of blocks, and the map."""
        restored = stored.restore()
        off = (restored - self.truth) / self.sigma
        return Figures(
            error=float(np.sqrt(np.mean(np.square(off), dtype=np.float64))),
            cost=stored.size / off[..., 0].size,
            beside={
                f"mean of {BLOCK_PX}² [σ]": float(np.abs(block_means_of(off, BLOCK_PX)).max()),  # noqa: RUF001
                "mIoU [%]": 100 * self.miou(restored),
            },
        )


def block_means_of(values: Values, side: int) -> NDArray[np.float32]:
    """Return means of whole blocks of lines and samples, (block, block, band); a smaller image is one block."""
    down, across = (min(side, size) for size in values.shape[:2])
    lines, samples = values.shape[0] // down, values.shape[1] // across
    cut = values[: lines * down, : samples * across].reshape(lines, down, samples, across, -1)
    return np.asarray(cut.mean(axis=(1, 3), dtype=np.float64).astype(np.float32))


def scan_farm(seed: int, shape: tuple[int, int] = FIELD_SHAPE, camera: LineCamera | None = None) -> ScanLines:
    """Scan a farm of one swath by every line at 10 ms; the simulator also gives the values without noise."""
    camera = camera or LineCamera()
    weights = load_weights(shipped_weights())
    grid = SceneGrid(*shape, weights.config.patch)
    source = SimulatedSource(farm_scene(seed, shape, camera=camera), Rig(camera), seed)
    along, _, _ = cheapest_full(grid, camera, CostModel())
    (sweep,) = uniform_sweeps(grid, camera, along, step=1, exposure_ms=EXPOSURE_MS)
    block = sweep_block(source.scene, source.rig, sweep, range(sweep.lines), seed=seed)
    light = expected_light(source.scene, block, source.choice)
    simulated = SimulatedSweep(source, sweep)
    per_dn = np.float32(camera.electrons_per_dn)
    raw = read_out(light, block, source.choice)
    noise_dn = noise_electrons(light, block.rig) / per_dn
    lines = HeldLines(sweep, simulated.references, simulated.position, simulated.time_s, raw)

    def miou(values: Values) -> float:
        """Rectify scene values and read them, as a survey does."""
        plain = replace(lines, references=_unit_references(values.shape), data=values)
        capture = LineSpec(EXPOSURE_MS / DEFAULT_EXPOSURE_MS)
        coarse = coarse_of_sweeps([plain], camera, source.wavelength_nm, grid, weights, capture)
        return _miou(weights, coarse, np.asarray(source.scene.labels, np.uint8))

    dark = dark_frame(block, source.choice)
    return ScanLines(
        lines,
        camera,
        source.wavelength_nm,
        values=lines.calibrated(raw),
        truth=lines.calibrated(light / per_dn + dark),
        sigma=lines.calibrated(noise_dn + dark),
        noise_dn=np.sqrt(np.mean(np.square(noise_dn), axis=(0, 1), dtype=np.float64)),
        miou=miou,
    )


def scan_raster(path: str, weights_path: Path | None) -> ScanLines:
    """Take the pixels of a raster as lines, with an estimate of their noise.

    Raises SceneError: a value is missing, or is no whole number of 16 bits.
    """
    file = load_scene_file(path, labels_needed=False)
    values = file.values
    if not np.isfinite(values).all() or values.min() < 0 or values.max() > 65_534 or (values != np.rint(values)).any():
        raise SceneError(
            f"{path} holds missing values, or numbers other than whole ones from 0 to 65534. Choose a cube of raw "
            "numbers, or scale it"
        )
    lines = HeldLines(
        Sweep("raster", "coarse", "x", 0.0, 0.0, len(values)),
        _unit_references(values.shape),
        position=np.zeros((len(values), 2)),
        time_s=np.arange(len(values), dtype=np.float64),
        data=values.astype(np.uint16),
    )
    statistics = _statistics([(0, values, np.ones(values.shape[:2], np.bool_))], values.shape)
    noise = find_components(statistics, false_alarm=USUAL.false_alarm, least=USUAL.least).noise
    known = np.where(np.isfinite(noise) & (noise > 0), noise, 1.0)
    scene = scene_of_file(file, LineCamera())
    notes = () if weights_path is None else check_labels(scene, describe_weights(weights_path))

    def miou(restored: Values) -> float:
        """Read the pixels where they are."""
        if weights_path is None or file.labels is None:
            return float("nan")
        weights = load_weights(weights_path)
        grid = SceneGrid(*file.shape, weights.config.patch)
        coarse = read_coarse_prediction(weights, read_coarse_pass(weights, [restored], file.wavelength_nm, grid))
        labels = judged_labels(scene, describe_weights(weights_path))
        assert labels is not None
        return _miou(weights, coarse, labels)

    sigma = known.astype(np.float32)
    return ScanLines(lines, LineCamera(bits=16), file.wavelength_nm, values, values, sigma, known, miou, notes)


def _unit_references(shape: tuple[int, ...]) -> References:
    """Return references by which numbers are scene values."""
    frame = np.zeros(shape[1:], np.float32)
    return References(frame, frame + 1, np.ones(shape[2], np.float32))


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


def _miou(weights: Weights, coarse: CoarsePrediction, labels: NDArray[np.uint8]) -> float:
    """Return the mIoU of the map of all patches."""
    patch_index = coarse.grid.every_patch()
    drawn = segment(weights, coarse, coarse.patches(patch_index), patch_index)
    return mean_iou(confusion(labels, drawn.classes, weights.config.classes))


# methods of storing them


@dataclass(frozen=True, eq=False)
class KeptLines:
    """Stored lines: their bytes, and a function that restores scene values (line, sample, band)."""

    size: int
    restore: Callable[[], Values]


def keep_raw(scan: ScanLines) -> KeptLines:
    """Store raw lines by the codec of scores, which packs them closer than the codec of raw lines on disk."""
    size, array = numbers_in_memory(scan.lines.data)
    return KeptLines(size, lambda: scan.lines.calibrated(np.asarray(array[...])))


def condense(scan: ScanLines, step: float) -> KeptLines:
    """Condense the lines as a survey does."""
    statistics = _statistics(calibrated_blocks(scan.lines, scan.camera), scan.values.shape)
    components = find_components(statistics, false_alarm=USUAL.false_alarm, least=USUAL.least)
    law = ResidualLaw.learned(statistics.spectra, components)
    condenser = Condenser(components, law, scan.camera, USUAL.rare_spectra, step)
    kept, condensed = _condensed(scan, condenser, statistics)
    better = with_shared_directions(condenser, [condensed], statistics, USUAL.false_alarm)
    return kept if better is None else _condensed(scan, better, statistics)[0]


Block = tuple[int, Values, NDArray[np.bool_]]  # first line, values (line, sample, band), valid (line, sample)


def _statistics(blocks: Iterable[Block], shape: tuple[int, ...]) -> SignalStatistics:
    lines, samples, bands = shape
    statistics = SignalStatistics(bands, lines * samples)
    for _, values, valid in blocks:
        statistics.add(values, valid)
    return statistics


def _raw_blocks(scan: ScanLines) -> Iterator[Block]:
    for first in range(0, len(scan.lines.data), BLOCK_LINES):
        numbers = scan.lines.data[first : first + BLOCK_LINES].astype(np.float32)
        yield first, numbers, np.ones(numbers.shape[:2], np.bool_)


def _condensed(scan: ScanLines, condenser: Condenser, statistics: SignalStatistics) -> tuple[KeptLines, CondensedSweep]:
    """Store the scores of all lines and the residuals of rare spectra."""
    assert statistics.origin is not None
    lines = scan.lines
    components = condenser.components
    header = SweepHeader(lines.sweep, lines.references, scan.wavelength_nm)
    largest = components.largest(statistics.largest + np.abs(statistics.origin - components.mean))
    cube = SignalCubeInMemory(header, components, step=condenser.step, largest=largest)
    done = condenser.sweep(lines, cube.writer.write)
    exposure_ms = np.full(len(lines.data), scan.camera.exposure_ms)
    x, y = lines.position.T
    cube.writer.close(LineRows(lines.time_s, x, y, exposure_ms, lines.valid_line), done.rare, done.residuals)
    return KeptLines(cube.size, lambda: cube.open().spectra(0, len(lines.data))), done


def bin_bands(scan: ScanLines, width: int) -> KeptLines:
    """Store means of neighbouring bands as whole numbers; interpolate linearly between their centres."""
    bands = scan.values.shape[2]
    first = np.arange(0, bands, width)
    count = np.diff(np.append(first, bands))
    sums = np.add.reduceat(scan.lines.data, first, axis=2, dtype=np.uint32)
    size, array = numbers_in_memory(np.rint(sums / count.astype(np.float32)).astype(np.uint16))
    middle = first + (count - 1) / 2
    weights = np.stack([np.interp(np.arange(bands), middle, one) for one in np.eye(len(first))]).astype(np.float32)
    return KeptLines(size, lambda: scan.lines.calibrated(np.asarray(array[...], np.float32) @ weights))


def pack_pcodec(scan: ScanLines, step: float | None) -> KeptLines:
    """Store raw numbers by pcodec, exactly or in whole steps, each a fraction of its band's noise."""
    pcodec = importlib.import_module("pcodec")
    unit = np.ones(1, np.float32)
    numbers = scan.lines.data
    if step is not None:
        unit = (step * scan.noise_dn).astype(np.float32)
        numbers = np.rint(numbers / unit).astype(np.uint32)
    packed: bytes = pcodec.standalone.simple_compress(numbers.ravel(), pcodec.ChunkConfig())

    def restore() -> Values:
        return scan.lines.calibrated(pcodec.standalone.simple_decompress(packed).reshape(numbers.shape) * unit)

    return KeptLines(len(packed) + unit.nbytes, restore)


def keep_principal(scan: ScanLines, step: float) -> KeptLines:
    """Store principal components of raw numbers, as many as condensing keeps, without whitening or rare spectra."""
    components, scores = _scored(scan, raw=True)
    numbers = whole_steps(scores, step).transpose(2, 0, 1)
    size, array = numbers_in_memory(numbers.astype(np.int16 if np.abs(numbers).max() < 2**15 else np.int32))

    def restore() -> Values:
        back = np.asarray(array[...], np.float32).transpose(1, 2, 0) * np.float32(step)
        return scan.lines.calibrated(components.restore(back))

    axes_and_mean = 4 * (len(components) + 1) * components.bands  # bytes of float32
    return KeptLines(size + axes_and_mean, restore)


def _scored(scan: ScanLines, *, raw: bool) -> tuple[Components, Values]:
    """Return components and all scores (line, sample, component): of condensing, or principal ones of raw numbers.

    The unit of principal scores is the mean noise of all bands.
    """
    statistics = _statistics(calibrated_blocks(scan.lines, scan.camera), scan.values.shape)
    components = find_components(statistics, false_alarm=USUAL.false_alarm, least=USUAL.least)
    if raw:
        statistics = _statistics(_raw_blocks(scan), scan.values.shape)
        assert statistics.origin is not None
        mean = statistics.total / statistics.count
        axes = np.linalg.eigh(statistics.single / statistics.count - np.outer(mean, mean))[1][:, ::-1]
        noise = np.full(statistics.bands, np.sqrt(np.mean(scan.noise_dn**2)))
        components = Components(statistics.origin + mean, axes[:, : len(components)].T, noise)
    blocks = _raw_blocks(scan) if raw else calibrated_blocks(scan.lines, scan.camera)
    return components, np.concatenate([score_lines(values, valid, components).scores for _, values, valid in blocks])


def compress_jpeg2000(scan: ScanLines, rate: float, raw: bool) -> KeptLines:
    """Store components as the bands of a JPEG 2000 image of ``rate`` bytes a spectrum.

    They are the principal components of ``raw`` numbers (Du & Fowler 2007), or the components of condensing.
    """
    rasterio = importlib.import_module("rasterio")
    memory_file = importlib.import_module("rasterio.io").MemoryFile
    components, scores = _scored(scan, raw=raw)
    step = np.float32(max(JP2_STEP, float(np.abs(scores).max()) / JP2_LARGEST))
    numbers = (np.rint(scores.transpose(2, 0, 1) / step) + JP2_ZERO).astype(np.uint16)
    count, height, width = numbers.shape
    shape: dict[str, Any] = {"count": count, "height": height, "width": width, "dtype": "uint16"}
    percent = 100 * rate / (2 * count)  # of the bytes of these numbers
    with warnings.catch_warnings(), memory_file() as file:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with file.open(driver=JP2_DRIVER, QUALITY=percent, REVERSIBLE="NO", YCC="NO", **shape) as image:
            image.write(numbers)
        packed: bytes = file.read()

    def restore() -> Values:
        with warnings.catch_warnings(), memory_file(packed) as file:
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with file.open() as image:
                back = (image.read().astype(np.float32) - JP2_ZERO) * step
        restored = components.restore(back.transpose(1, 2, 0))
        return scan.lines.calibrated(restored) if raw else restored

    axes_and_mean = 4 * (count + 1) * components.bands  # bytes of float32
    return KeptLines(len(packed) + axes_and_mean, restore)


_PCODEC: Mapping[Setting, Callable[[ScanLines], KeptLines]] = {
    "pcodec, exact": partial(pack_pcodec, step=None),
    **{f"pcodec, rounded {step:g}": partial(pack_pcodec, step=step) for step in ROUNDED},
}
WAYS: Mapping[Setting, Callable[[ScanLines], KeptLines]] = {
    "raw": keep_raw,
    **{f"condensed, step {step:g}": partial(condense, step=step) for step in STEPS},
    **{f"binned, {width} bands": partial(bin_bands, width=width) for width in BINS},
    **(_PCODEC if importlib.util.find_spec("pcodec") else {}),  # of the extra `bench`
    **{f"PCA, step {step:g}": partial(keep_principal, step=step) for step in STEPS},
    **{f"PCA, JPEG 2000, {rate:g} B": partial(compress_jpeg2000, rate=rate, raw=True) for rate in RATES},
    **{f"condensed, JPEG 2000, {rate:g} B": partial(compress_jpeg2000, rate=rate, raw=False) for rate in RATES},
}


STORE = Tradeoff(
    stage="store",
    knob="kept of lines",
    error="spectral error [σ of the noise]",  # noqa: RUF001
    reference=f"light and labels of a farm of {FIELD_SHAPE[1]} x {FIELD_SHAPE[0]} px, every line, {EXPOSURE_MS:g} ms",
    cost="bytes a spectrum",
    settings=tuple(WAYS),
    default=f"condensed, step {USUAL.step:g}",
    prepare=scan_farm,
    run=lambda scan, setting: WAYS[setting](scan),
    judge=ScanLines.judge,
    repeats=1,
)


def store_tradeoff(scene: str, weights: Path | None) -> Tradeoff:
    """Return the same trade-off on the pixels of a raster; without weights no map is judged."""
    labels = "no map" if weights is None else "its labels"
    return replace(
        STORE, prepare=lambda _seed: scan_raster(scene, weights), reference=f"pixels of {Path(scene).name}; {labels}"
    )
