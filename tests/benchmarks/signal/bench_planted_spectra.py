"""Planted spectra: does the stored signal keep the detections of a matched filter at the same false-alarm rate?

For each size and strength, 1000 spectra with smooth signatures over all bands are added to a small farm's raw lines and
to Indian Pines. Components are those of the field without them, as for one rare object in a large field. The filter
knows the signature, and the field's mean and covariance. Its threshold is passed once in a field without planted
spectra, like the noise limit of rare spectra. A detection is kept if the filter finds it in restored spectra.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measure import ROOT, Row, data_folder, not_run
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, uniform_filter

from pipeline.geometry.camera import LineCamera
from pipeline.signal.components import Components
from pipeline.signal.condense import (
    RESIDUAL_STEP,
    UNUSABLE,
    ResidualLaw,
    calibrated_blocks,
    find_rare,
    residual_steps,
    score_lines,
)
from pipeline.signal.subspace import SignalStatistics, find_components
from storage.arrays.cubes import open_raw_cubes

SHAPES = {"1 px": (1, 1), "2 x 2 px": (2, 2), "line of 8 px": (1, 8)}
STRENGTHS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # standard deviations of the noise a band; the goal holds from 1 on
PLANTED = 1000  # of each kind
APART = 16  # px between places
SMOOTH = 8  # bands over which a signature is smooth
ALARMS = 1.0  # false alarms in a field
LIMITS = 24  # signatures by which the filter's threshold is set
FARM = ("--scene", "farm", "--seed", "11", "--size", "512x384", "--seconds", "12")

Values = NDArray[np.float32]
Numbers = NDArray[np.intp]


@dataclass(frozen=True)
class Condensed:
    """A field without planted spectra, its law, and the whitening of the filter."""

    name: str
    values: Values  # (line, sample, band)
    components: Components
    law: ResidualLaw
    ratio: Values  # (line, sample) residual over the expected one
    whitening: NDArray[np.float64]  # (band, band) to spectra of unit covariance


def rows() -> list[Row]:
    """Return the rows of every size and strength on both fields."""
    with tempfile.TemporaryDirectory() as folder:
        found = list(_table(_condensed("farm", _farm_values(Path(folder)))))
    pines = data_folder("indian_pines") / "Indian_pines_corrected.npy"
    if not pines.is_file():
        return [*found, not_run("planted spectra on Indian Pines", pines.parent)]
    return [*found, *_table(_condensed("Indian Pines", np.load(pines).astype(np.float32)))]


def _farm_values(folder: Path) -> Values:
    """Return scene values of all lines of a small survey of the farm; NaN if unusable."""
    command = [sys.executable, "-m", "flows.cli.main", "survey", *FARM, "--out", str(folder), "--engine", "plain"]
    subprocess.run([*command, "--no-accuracy", "--keep", "raw"], cwd=ROOT, check=True, capture_output=True)
    (capture,) = (folder / "stages" / "capture").iterdir()
    found = []
    for cube in open_raw_cubes(capture):
        for _, values, valid in calibrated_blocks(cube, LineCamera()):
            found.append(np.where(valid if valid.ndim == 3 else valid[..., None], values, np.float32(np.nan)))
    return np.concatenate(found)


def _condensed(name: str, values: Values) -> Condensed:
    found = SignalStatistics(values.shape[2], values[..., 0].size)
    usable = np.isfinite(values).all(axis=2)
    for first in range(0, len(values), 64):
        found.add(values[first : first + 64], usable[first : first + 64])
    components = find_components(found)
    law = ResidualLaw.learned(found.spectra, components)
    ratio = np.empty(usable.shape, np.float32)
    for first in range(0, len(values), 64):
        part = slice(first, first + 64)
        seen = score_lines(values[part], usable[part], components)
        ratio[part] = np.where(seen.quality == UNUSABLE, np.nan, seen.residual / law.expected(seen.scores))
    mean = found.total / found.count
    power, axes = np.linalg.eigh(found.single / found.count - np.outer(mean, mean))
    whitening = axes / np.sqrt(np.maximum(power, power[-1] * 1e-12)) @ axes.T
    return Condensed(name, values, components, law, ratio, whitening)


def _table(field: Condensed) -> Iterator[Row]:
    rare = find_rare(field.ratio, field.law, ALARMS)
    words = f"{rare.mean():.2%} of {rare.size} spectra are rare; noise may mark {ALARMS:g}"
    yield Row(f"{field.name}: components of {field.components.bands} bands", f"{len(field.components)}", peers=words)
    rng = np.random.default_rng(1)
    for name, shape in SHAPES.items():
        limit = _limit(field, shape, rng)
        for strength in STRENGTHS:
            found, kept, marked, error = _trial(field, shape, strength, limit, rng)
            fraction = float(kept[found].mean()) if found.any() else 1.0
            figure = f"{fraction:.1%} of found kept; {marked.mean():.1%} rare"
            peers = f"filter: {found.mean():.1%} in raw lines, {kept.mean():.1%} in restored; rare ones off {error:.2f}"
            goal = (">= 99 % of found kept", fraction >= 0.99) if strength >= 1 else ("", None)
            yield Row(f"{field.name}: {name}, {strength:g} sigma a band", figure, *goal, peers)


def _signatures(count: int, noise: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return smooth spectra (count, band) with a mean square of 1 relative to the noise variance."""
    shape = gaussian_filter1d(rng.normal(size=(count, len(noise))), SMOOTH, axis=1)
    shape /= np.sqrt(np.mean(shape**2, axis=1, keepdims=True))
    return np.asarray(shape * np.nan_to_num(noise))


def _filters(field: Condensed, signatures: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights (n, band) of matched filters with an output variance of 1 on the field."""
    white = signatures @ field.whitening
    return np.asarray(white / np.linalg.norm(white, axis=1, keepdims=True) @ field.whitening)


def _limit(field: Condensed, shape: tuple[int, int], rng: np.random.Generator) -> float:
    """Return the filter's maximum over the field, summed over a shape; the median of some signatures."""
    filters = _filters(field, _signatures(LIMITS, field.components.noise, rng)).astype(np.float32)
    clean = np.nan_to_num(field.values - np.nan_to_num(field.components.mean).astype(np.float32))
    maps = clean @ filters.T
    return float(np.median(uniform_filter(maps, (*shape, 1)).max(axis=(0, 1)) * np.sqrt(shape[0] * shape[1])))


def _trial(
    field: Condensed, shape: tuple[int, int], strength: float, limit: float, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_], float]:
    """Return for each planted place: found in raw lines, in restored ones, all px rare; and the largest rare error."""
    found: list[bool] = []
    kept: list[bool] = []
    marked: list[bool] = []
    error = 0.0
    mean = np.nan_to_num(field.components.mean)
    while len(found) < PLANTED:
        line, sample = _places(field.ratio, shape, rng)
        line, sample = line[: PLANTED - len(found)], sample[: PLANTED - len(found)]
        own = _signatures(len(line), field.components.noise, rng) * strength
        raw = field.values[line, sample] + own[:, None].astype(np.float32)
        seen = score_lines(raw, np.ones(raw.shape[:2], np.bool_), field.components)
        ratio = field.ratio.copy()
        ratio[line, sample] = seen.residual / field.law.expected(seen.scores)
        rare = find_rare(ratio, field.law, ALARMS)[line, sample]
        rounded = np.rint(seen.scores)
        restored = field.components.restore(rounded)
        noise = field.components.noise.astype(np.float32)
        restored[rare] += residual_steps(raw[rare], rounded[rare], field.components) * np.float32(RESIDUAL_STEP) * noise
        filters = _filters(field, own)
        for values, told in ((raw, found), (restored, kept)):
            output = np.einsum("npb,nb->np", values - mean, filters)
            told += (output.mean(axis=1) * np.sqrt(output.shape[1]) > limit).tolist()
        marked += rare.all(axis=1).tolist()
        error = max(error, float(np.abs((restored - raw)[rare] / noise).max(initial=0.0)))
    return np.array(found), np.array(kept), np.array(marked), error


def _places(ratio: Values, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Numbers, Numbers]:
    """Return lines and samples (place, px) of shapes that do not touch and lie on usable spectra."""
    top, left = rng.integers(0, APART - max(shape), 2)
    down = np.arange(top, ratio.shape[0] - shape[0], APART)
    across = np.arange(left, ratio.shape[1] - shape[1], APART)
    first = np.stack(np.meshgrid(down, across, indexing="ij"), axis=-1).reshape(-1, 1, 2)
    line, sample = np.moveaxis(first + np.array(list(np.ndindex(shape))), -1, 0)
    order = rng.permutation(np.flatnonzero(np.isfinite(ratio[line, sample]).all(axis=1)))
    return line[order], sample[order]
