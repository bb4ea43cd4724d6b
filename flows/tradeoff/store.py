"""The trade-off of storing lines: components of whitened spectra beside what else may be kept of raw lines.

Opponents: binned bands, rounded numbers (each by the codec of scores), pcodec, principal components without
whitening, those as JPEG 2000 (Du & Fowler 2007), and ZFP. All come back as scene values, which are rectified and read
as a survey reads them.
"""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import SignalChoice
from flows.tasks.stages.condense import with_shared_directions
from flows.tradeoff.entries import Setting, Tradeoff
from flows.tradeoff.scan_lines import BLOCK_PX, EXPOSURE_MS, FIELD_SHAPE, ScanLines, Values, scan_farm, scan_raster
from pipeline.signal.components import Components
from pipeline.signal.condense import CondensedSweep, Condenser, ResidualLaw, calibrated_blocks, score_lines
from pipeline.signal.subspace import SignalStatistics, find_components
from storage.arrays.cubes import SweepHeader
from storage.arrays.layout import numbers_in_memory
from storage.arrays.signal_cubes import LineRows, SignalCubeInMemory

STEPS = (0.5, 1.0, 2.0, 3.0)  # deviations of the noise
FEWER = (8, 6, 4)  # components
BINS = (2, 4, 8, 17)  # bands
ROUNDED = (0.25, 0.5, 1.0)  # deviations of the noise
RATES = (1.0, 2.0, 4.0)  # bytes a spectrum
TOLERANCES = (4.0, 8.0, 16.0)  # deviations of the noise that no sample is off by more than
JP2_STEP = 0.25  # in which scores become whole numbers before JPEG 2000 [deviations of the noise]
JP2_LARGEST, JP2_ZERO = 32_000, 1 << 15
JP2_DRIVER = "JP2OpenJPEG"
BLOCK_LINES = 64
EXTRA = {"pcodec": "pcodec", "ZFP": "zfpy"}  # packages by family


@dataclass(frozen=True, eq=False)
class KeptLines:
    """Stored lines: their bytes, and a function that gives scene values (line, sample, band) back."""

    size: int
    restore: Callable[[], Values]


def keep_raw(scan: ScanLines) -> KeptLines:
    """Store raw lines as they are, by the codec of scores, which packs them closer than that of raw lines on disk."""
    size, array = numbers_in_memory(scan.lines.data)
    return KeptLines(size, lambda: scan.calibrated(np.asarray(array[...])))


def condense(scan: ScanLines, step: float, most: int | None = None) -> KeptLines:
    """Condense the lines as a survey does; with ``most`` by the leading components alone."""
    choice, found = SignalChoice(), _statistics(scan)
    components = find_components(found, false_alarm=choice.false_alarm, least=choice.least)
    if most is not None:
        components = replace(components, axes=components.axes[:most])
    law = ResidualLaw.learned(found.spectra, components)
    condenser = Condenser(components, law, scan.camera, choice.rare_spectra, step)
    stored = _condensed(scan, condenser, found)
    if most is None:
        better = with_shared_directions(condenser, [stored[1]], found, choice.false_alarm)
        stored = stored if better is None else _condensed(scan, better, found)
    return stored[0]


def _blocks(scan: ScanLines, raw: bool) -> Iterator[tuple[int, Values, NDArray[np.bool_]]]:
    """Yield the first line, scene values or ``raw`` numbers, and validity of some lines at a time."""
    if not raw:
        yield from calibrated_blocks(scan.lines, scan.camera)
        return
    for first in range(0, len(scan.lines.data), BLOCK_LINES):
        numbers = scan.lines.data[first : first + BLOCK_LINES].astype(np.float32)
        yield first, numbers, np.ones(numbers.shape[:2], np.bool_)


def _statistics(scan: ScanLines, raw: bool = False) -> SignalStatistics:
    lines, samples, bands = scan.values.shape
    found = SignalStatistics(bands, lines * samples)
    for _, values, valid in _blocks(scan, raw):
        found.add(values, valid)
    return found


def _scores(scan: ScanLines, components: Components, raw: bool) -> Iterator[tuple[int, Values]]:
    for first, values, valid in _blocks(scan, raw):
        yield first, score_lines(values, valid, components).scores


def _condensed(scan: ScanLines, condenser: Condenser, found: SignalStatistics) -> tuple[KeptLines, CondensedSweep]:
    """Store the scores of all lines and the residuals of rare spectra."""
    components = condenser.components
    cube = _new_cube(scan, components, condenser.step, found)
    done = condenser.sweep(scan.lines, cube.writer.write)
    return _closed(scan, cube, done.rare, done.residuals), done


def _new_cube(scan: ScanLines, components: Components, step: float, found: SignalStatistics) -> SignalCubeInMemory:
    assert found.origin is not None
    header = SweepHeader(scan.lines.sweep, scan.lines.references, scan.wavelength_nm)
    largest = components.largest(found.largest + np.abs(found.origin - components.mean))
    return SignalCubeInMemory(header, components, step=step, largest=largest)


def _closed(
    scan: ScanLines, cube: SignalCubeInMemory, rare: NDArray[np.intp], residuals: NDArray[np.int32]
) -> KeptLines:
    lines, (x, y) = scan.lines, scan.lines.position.T
    exposure_ms = np.full(len(lines.data), scan.camera.exposure_ms)
    cube.writer.close(LineRows(lines.time_s, x, y, exposure_ms, lines.valid_line), rare, residuals, None)
    return KeptLines(cube.size, lambda: cube.open().spectra(0, len(lines.data)))


def bin_bands(scan: ScanLines, width: int) -> KeptLines:
    """Store the means of neighbouring bands as whole numbers; linear between their middles when they come back."""
    bands = scan.values.shape[2]
    first = np.arange(0, bands, width)
    count = np.diff(np.append(first, bands))
    sums = np.add.reduceat(scan.lines.data, first, axis=2, dtype=np.uint32)
    size, array = numbers_in_memory(np.rint(sums / count.astype(np.float32)).astype(np.uint16))
    middle, each = first + (count - 1) / 2, np.eye(len(first))
    weights = np.stack([np.interp(np.arange(bands), middle, one) for one in each]).astype(np.float32)
    return KeptLines(size, lambda: scan.calibrated(np.asarray(array[...], np.float32) @ weights))


def round_numbers(scan: ScanLines, step: float) -> KeptLines:
    """Store raw numbers in steps of a part of each band's noise, by the codec of scores."""
    unit, steps = _in_steps(scan, step)
    size, array = numbers_in_memory(steps)
    return KeptLines(size + unit.nbytes, lambda: scan.calibrated(np.asarray(array[...]) * unit))


def _in_steps(scan: ScanLines, step: float) -> tuple[Values, NDArray[np.unsignedinteger[Any]]]:
    """Return steps (band,) and raw numbers in whole ones."""
    unit = (step * scan.noise_dn).astype(np.float32)
    steps = np.rint(scan.lines.data / unit).astype(np.uint32)
    return unit, steps.astype(np.uint16) if steps.max() <= np.iinfo(np.uint16).max else steps


def pack_pcodec(scan: ScanLines, step: float | None) -> KeptLines:
    """Store raw numbers, or steps of a part of each band's noise, by pcodec."""
    pcodec = importlib.import_module("pcodec")
    unit, numbers = (np.ones(1, np.float32), scan.lines.data) if step is None else _in_steps(scan, step)
    packed: bytes = pcodec.standalone.simple_compress(numbers.ravel(), pcodec.ChunkConfig())

    def restore() -> Values:
        return scan.calibrated(pcodec.standalone.simple_decompress(packed).reshape(numbers.shape) * unit)

    return KeptLines(len(packed) + unit.nbytes, restore)


def compress_zfp(scan: ScanLines, tolerance: float) -> KeptLines:
    """Store raw numbers over each band's noise by ZFP, none off by more than a tolerance."""
    zfpy = importlib.import_module("zfpy")
    unit = scan.noise_dn.astype(np.float32)
    packed: bytes = zfpy.compress_numpy(scan.lines.data / unit, tolerance=tolerance)
    return KeptLines(len(packed) + unit.nbytes, lambda: scan.calibrated(zfpy.decompress_numpy(packed) * unit))


def keep_principal(scan: ScanLines, step: float) -> KeptLines:
    """Store as many principal components of raw numbers as condensing keeps, not whitened, none rare."""
    found = _statistics(scan, raw=True)
    components = _principal(scan, found)
    cube = _new_cube(scan, components, step, found)
    for first, scores in _scores(scan, components, raw=True):
        cube.writer.write(first, scores, np.zeros(scores.shape[:2], np.uint8))
    nothing = np.zeros((0, components.bands), np.int32)
    stored = _closed(scan, cube, np.zeros((0, 2), np.intp), nothing)
    return KeptLines(stored.size, lambda: scan.calibrated(stored.restore()))


def _principal(scan: ScanLines, found: SignalStatistics) -> Components:
    """Principal components of raw numbers; their scores count in the mean noise of all bands."""
    assert found.origin is not None
    mean = found.total / found.count
    axes = np.linalg.eigh(found.single / found.count - np.outer(mean, mean))[1][:, ::-1]
    noise = np.full(found.bands, np.sqrt(np.mean(scan.noise_dn**2)))
    return Components(found.origin + mean, axes[:, : scan.rank].T, noise)


def compress_jpeg2000(scan: ScanLines, rate: float, raw: bool) -> KeptLines:
    """Store components as the bands of a JPEG 2000 image of ``rate`` bytes a spectrum, which it shares out.

    Of ``raw`` numbers they are principal components (Du & Fowler 2007), else those that condensing finds.
    """
    choice, found = SignalChoice(), _statistics(scan, raw)
    if raw:
        components = _principal(scan, found)
    else:
        components = find_components(found, false_alarm=choice.false_alarm, least=choice.least)
    scores = np.concatenate([part for _, part in _scores(scan, components, raw)]).transpose(2, 0, 1)
    step = np.float32(max(JP2_STEP, float(np.abs(scores).max()) / JP2_LARGEST))
    numbers = (np.rint(scores / step) + JP2_ZERO).astype(np.uint16)
    packed = _to_jpeg2000(numbers, 100 * rate / (2 * len(components)))
    law = 4 * (len(components) + 1) * components.bands  # axes and mean, float32

    def restore() -> Values:
        back = (_from_jpeg2000(packed).astype(np.float32) - JP2_ZERO) * step
        restored = components.restore(back.transpose(1, 2, 0))
        return scan.calibrated(restored) if raw else restored

    return KeptLines(len(packed) + law, restore)


def _to_jpeg2000(numbers: NDArray[np.uint16], percent: float) -> bytes:
    """An image (band, y, x) in that part of its bytes."""
    rasterio = importlib.import_module("rasterio")
    count, height, width = numbers.shape
    shape: dict[str, Any] = {"count": count, "height": height, "width": width, "dtype": "uint16"}
    with warnings.catch_warnings(), importlib.import_module("rasterio.io").MemoryFile() as file:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with file.open(driver=JP2_DRIVER, QUALITY=percent, REVERSIBLE="NO", YCC="NO", **shape) as image:
            image.write(numbers)
        packed: bytes = file.read()
    return packed


def _from_jpeg2000(packed: bytes) -> NDArray[np.uint16]:
    rasterio = importlib.import_module("rasterio")
    with warnings.catch_warnings(), importlib.import_module("rasterio.io").MemoryFile(packed) as file:
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with file.open() as image:
            numbers: NDArray[np.uint16] = image.read()
    return numbers


WAYS: Mapping[Setting, Callable[[ScanLines], KeptLines]] = {
    "raw": keep_raw,
    **{f"condensed, step {step:g}": partial(condense, step=step) for step in STEPS},
    **{f"fewer components, {most}": partial(condense, step=1.0, most=most) for most in FEWER},
    **{f"binned, {width} bands": partial(bin_bands, width=width) for width in BINS},
    **{f"rounded, {step:g}": partial(round_numbers, step=step) for step in ROUNDED},
    "pcodec, exact": partial(pack_pcodec, step=None),
    **{f"pcodec, rounded {step:g}": partial(pack_pcodec, step=step) for step in ROUNDED},
    **{f"PCA, step {step:g}": partial(keep_principal, step=step) for step in STEPS},
    **{f"PCA, JPEG 2000, {rate:g} B": partial(compress_jpeg2000, rate=rate, raw=True) for rate in RATES},
    **{f"condensed, JPEG 2000, {rate:g} B": partial(compress_jpeg2000, rate=rate, raw=False) for rate in RATES},
    **{f"ZFP, tolerance {most:g}": partial(compress_zfp, tolerance=most) for most in TOLERANCES},
}


def not_here(setting: Setting) -> str | None:
    """Say why a way of storing cannot run on this machine; None where it can."""
    family = str(setting).partition(",")[0]
    package = EXTRA.get(family)
    if package is not None and importlib.util.find_spec(package) is None:
        return f"the package {package} is not installed; it comes with: pip install 'spectralzoom[bench]'"
    if "JPEG 2000" in str(setting) and not _writes_jpeg2000():
        return f"rasterio's GDAL has no driver {JP2_DRIVER}"
    return None


def _writes_jpeg2000() -> bool:
    with importlib.import_module("rasterio").Env() as env:
        return JP2_DRIVER in env.drivers()


def judge(scan: ScanLines, setting: Setting, stored: KeptLines) -> float:
    """Restore the lines, note all that is said of them, and return their spectral error."""
    scan.judged[setting] = scan.fidelity(stored.restore())
    return scan.judged[setting].error


STORE = Tradeoff(
    stage="store",
    knob="kept of lines",
    error="spectral error [σ of the noise]",  # noqa: RUF001
    unit="spectrum",
    reference=f"light and labels of a farm of {FIELD_SHAPE[1]} x {FIELD_SHAPE[0]} px, every line, {EXPOSURE_MS:g} ms",
    settings=tuple(WAYS),
    default=lambda _scan: f"condensed, step {SignalChoice().step:g}",
    prepare=scan_farm,
    run=lambda scan, setting: WAYS[setting](scan),
    judge=judge,
    work=lambda scan: float(scan.values[..., 0].size),
    beside={
        "bytes a spectrum": lambda scan, _setting, stored: stored.size / scan.values[..., 0].size,
        f"mean of {BLOCK_PX}² [σ]": lambda scan, setting, _stored: scan.judged[setting].block_mean,  # noqa: RUF001
        "mIoU [%]": lambda scan, setting, _stored: scan.judged[setting].miou,
    },
    paid="bytes a spectrum",
    missing=not_here,
    repeats=1,
)


def store_tradeoff(scene: str, weights: Path | None) -> Tradeoff:
    """Return the same trade-off on the pixels of a raster, read with weights of its classes; None: without a map."""
    labels = "no map" if weights is None else "its labels"
    return replace(
        STORE, prepare=lambda _seed: scan_raster(scene, weights), reference=f"pixels of {Path(scene).name}; {labels}"
    )
