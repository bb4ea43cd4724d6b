"""Simulate crops at shorter exposures and wider line spacings, with their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spectralzoom.models.network.machine import PROCESSOR
from spectralzoom.models.network.sizes import PLANES
from spectralzoom.models.network.spectral import LineSpec, Normalisation
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS

REFERENCE_MS = DEFAULT_EXPOSURE_MS  # exposures are fractions of this one
STEPS = MappingProxyType({1: 0.4, 2: 0.25, 4: 0.27, 8: 0.08})  # line spacing [px]: fraction of crops
INTERLACED = 0.5  # fraction of crops with lines apart that get closer lines in some areas
AREAS = (0.3, 0.4, 0.3)  # probability of 0, 1, 2 areas with closer lines
ACROSS = 0.5  # fraction of areas as wide as the crop
TINY = 1e-9  # added to correlations against negative eigenvalues by rounding
CONDENSED = 0.75  # fraction of crops with the components of a large field alone; small fields keep all directions
LEAST_POWERS = (0.001, 0.02)  # of components: variance of their signal over that of a spectrum's noise
LEAST_COMPONENTS = 4  # that stay whatever their power, as in a survey
ROUNDED = 1 / 12  # variance that rounding adds to scores, in squares of the noise
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class ColumnNoise:
    """Covariance of the noise of columns, in squares of scene values.

    At the fraction ``light`` of the reference exposure a spectrum v has the covariance
    shot(v) / light + read / light^2. The mean of n samples has 1 / n of it.
    """

    shot: Matrix  # (column,) variance for a unit of light
    read: Matrix  # (column, column)
    spectra: SceneSpectra | None = None  # None: crops of the scene are never condensed

    @staticmethod
    def of_bands(
        matrix: NDArray[np.floating], value_of_electron: NDArray[np.floating], read_noise_e: float
    ) -> ColumnNoise:
        """Return the noise of weights (band, column); an electron at the reference exposure has a value of (band,)."""
        weight = matrix.astype(np.float64)
        value = value_of_electron.astype(np.float64)
        return ColumnNoise((weight**2).T @ value, (weight * (read_noise_e * value[:, None]) ** 2).T @ weight)

    def correlation(self) -> Matrix:
        """Return the correlation of the noise, (column, column): columns share bands."""
        size = np.sqrt(np.maximum(np.diag(self.read), 1e-300))
        return np.asarray(self.read / np.outer(size, size))

    def variance(self, columns: NDArray[np.floating], light: float) -> NDArray[np.floating]:
        """Return the variance of columns (..., column) in scene values; negative values have no shot noise."""
        read = np.diag(self.read).astype(columns.dtype) / light**2
        return np.asarray(np.maximum(columns, 0) * (self.shot / light).astype(columns.dtype) + read)

    def covariance(self, columns: NDArray[np.floating], light: float) -> Matrix:
        """Return the covariance (column, column) of a spectrum (column,)."""
        size = np.sqrt(self.variance(columns.astype(np.float64), light))
        return self.correlation() * np.outer(size, size)


class Condensing(NamedTuple):
    """Components of a scene by a survey. Scores have the noise of one spectrum as their unit."""

    of_columns: NDArray[np.float32]  # (column, component) weights that give scores of columns less those of the mean
    back: NDArray[np.float32]  # (component, column) weights that give columns of scores
    mean: NDArray[np.float32]  # (column,) of the mean spectrum
    power: Matrix  # (component,) variance of the signal, falling


@dataclass(frozen=True, eq=False)
class SceneSpectra:
    """Moments of a scene's spectra: crops are condensed by them as surveys condense their lines."""

    centre: Matrix  # (band,) mean spectrum
    covariance: Matrix  # (band, band)
    matrix: NDArray[np.floating]  # (band, column)
    value_of_electron: Matrix  # (band,) at the reference exposure
    read_noise_e: float

    def noise(self, light: float) -> tuple[Matrix, Matrix]:
        """Return the variances (band,) of shot and read noise of the mean spectrum, at a fraction of the reference."""
        shot = np.maximum(self.centre, 0) * self.value_of_electron / light
        return shot, (self.value_of_electron * self.read_noise_e / light) ** 2

    def without_noise(self) -> SceneSpectra:
        """Subtract the noise of the reference exposure; a tenth of the directions have no signal beyond it."""
        noise = np.sum(self.noise(1.0), axis=0)
        power = np.linalg.eigvalsh(self.covariance / np.sqrt(np.outer(noise, noise)))
        return replace(self, covariance=self.covariance - np.quantile(power, 0.1) * np.diag(noise))

    @lru_cache(maxsize=2048)  # noqa: B019 - a training has some dozens of scenes, which stay
    def condensing(self, light: float) -> Condensing:
        """Return the components of a survey with this exposure, at most one for each column."""
        sigma = np.sqrt(np.sum(self.noise(light), axis=0))
        most = self.matrix.shape[1]
        power, axes = np.linalg.eigh(self.covariance / np.outer(sigma, sigma))
        power, axes = power[::-1][:most], axes[:, ::-1][:, :most]
        back, mean = Components(self.centre, axes.T, sigma).onto(self.matrix)
        matrix = self.matrix.astype(np.float64)
        seen = matrix.T @ self.covariance @ matrix + (matrix.T * np.sum(self.noise(1.0), axis=0)) @ matrix
        spectra = np.linalg.solve(seen, matrix.T @ self.covariance)  # (column, band) expected from columns
        return Condensing(((spectra / sigma) @ axes).astype(np.float32), back, mean, power)


class CaptureAugmentation:
    """Turn crops of the reference exposure into captures of shorter exposures and wider line spacings.

    Crops are tensors (y, x, column) of any device, which also simulates them. Results have the planes of
    `models.network.spectral.LineSpec` after the spectral features.
    """

    def __init__(self, normalisation: Normalisation, *, min_exposure_ms: float = 3.0) -> None:
        self.normalisation = normalisation
        self.min_exposure_ms = min_exposure_ms
        self.unwhiten = np.linalg.inv(normalisation.whitening.astype(np.float64)).astype(np.float32)

    def draw(self, columns: Tensor, noise: ColumnNoise, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return a crop (y, x, column) by a random capture, as inputs of the overview and the full network.

        Both inputs are the same image: a uniform scan, or a first pass with closer lines in some areas. Exposures are
        log-uniform. A subclass may return two images.
        """
        odds = {step: often for step, often in STEPS.items() if len(columns) % step == 0}
        step = int(rng.choice(list(odds), p=np.array(list(odds.values())) / sum(odds.values())))
        least_power = float(np.exp(rng.uniform(*np.log(LEAST_POWERS)))) if rng.random() < CONDENSED else 0.0
        if step > 1 and rng.random() < INTERLACED:
            image = self.interlaced(columns, noise, step=step, rng=rng, least_power=least_power)
        else:
            image = self.scan(columns, noise, light=self._light(rng), step=step, rng=rng, least_power=least_power)
        return image, image

    def _light(self, rng: np.random.Generator) -> float:
        """Draw an exposure between the darkest and the reference, as a fraction of the latter."""
        return float(np.exp(rng.uniform(np.log(self.min_exposure_ms / REFERENCE_MS), 0.0)))

    def scan(
        self,
        columns: Tensor,
        noise: ColumnNoise,
        *,
        light: float,
        step: int,
        rng: np.random.Generator,
        least_power: float = 0.0,
    ) -> Tensor:
        """Return a crop by a uniform scan of lines ``step`` px apart, with rows between them interpolated.

        ``light`` is the exposure as a fraction of the reference; ``step`` is a power of two that divides the rows.
        Components of less than ``least_power`` are left out.
        """
        scaled = columns @ beside(columns, self.unwhiten)
        means = scaled.reshape(-1, step, *scaled.shape[1:]).mean(dim=1)
        lines = self._captured(means, noise, light, rng, unit=light, least_power=least_power, samples=step)
        between = rows_between(lines, len(columns), first=(step - 1) / 2, apart=step) if step > 1 else lines
        return self._input(between, LineSpec(light, step).planes)

    def scanned(
        self,
        columns: NDArray[np.floating],
        noise: ColumnNoise,
        *,
        light: float,
        step: int,
        rng: np.random.Generator,
        device: str | torch.device = PROCESSOR,
    ) -> NDArray[np.float32]:
        """Return columns (y, x, column) by such a scan, without the planes of the capture."""
        plain = torch.from_numpy(np.asarray(columns, np.float32)).to(device)
        scan = self.scan(plain, noise, light=light, step=step, rng=rng)[..., :-PLANES]
        return np.asarray(scan.cpu().numpy(), np.float32)

    def interlaced(
        self, columns: Tensor, noise: ColumnNoise, *, step: int, rng: np.random.Generator, least_power: float = 0.0
    ) -> Tensor:
        """Return a crop by a first pass of rows ``step`` px apart, and areas with later lines between them.

        Lines of the first pass stay among the closer lines of an area, each with its own exposure.
        """
        scaled = columns @ beside(columns, self.unwhiten)
        size = len(columns)
        light = self._light(rng)
        first = int(rng.integers(step))
        lines = self._captured(scaled[first::step], noise, light, rng, unit=light, least_power=least_power)
        image = self._input(rows_between(lines, size, first=first, apart=step), LineSpec(light, step).planes)
        for _ in range(rng.choice(len(AREAS), p=AREAS)):
            rows = slice(*np.sort(rng.integers(0, size + 1, 2)).tolist())
            samples = slice(*np.sort(rng.integers(0, columns.shape[1] + 1, 2)).tolist())
            samples = slice(None) if rng.random() < ACROSS else samples
            closer = step // int(rng.choice([own for own in (2, 4, 8) if own <= step]))
            later = self._light(rng)
            start = first % closer
            area = scaled[start::closer, samples]
            taken = self._captured(area, noise, later, rng, unit=light, least_power=least_power)
            taken[first // closer :: step // closer] = lines[:, samples]
            between = rows_between(taken, size, first=start, apart=closer)[rows]
            nearest = np.clip(np.rint((np.arange(size) - start) / closer), 0, len(taken) - 1) * closer + start
            own = np.where((nearest - first) % step == 0, light, later)[rows]
            planes = np.array([LineSpec(float(one), closer).planes for one in own]).reshape(-1, 1, PLANES)
            image[rows, samples] = self._input(between, planes)
        return image

    def _input(self, scaled: Tensor, planes: NDArray[np.floating]) -> Tensor:
        """Whiten columns, and append the planes of their capture, which broadcast to them."""
        return with_capture(scaled @ beside(scaled, self.normalisation.whitening), planes)

    def _captured(
        self,
        scaled: Tensor,
        noise: ColumnNoise,
        light: float,
        rng: np.random.Generator,
        *,
        unit: float,
        least_power: float,
        samples: int = 1,
    ) -> Tensor:
        """Add the noise of an exposure ``light``, and condense by the components of an exposure ``unit``.

        ``scaled`` are means of ``samples`` pixels of the reference exposure. Components of less than ``least_power``
        are left out. With 0, or without spectra, nothing is condensed.
        """
        centre, spread = (beside(scaled, one) for one in (self.normalisation.centre, self.normalisation.spread))
        values = scaled * spread + centre
        if noise.spectra is None or least_power == 0:
            of_light = beside(scaled, noise.shot * (1 / light - 1 / samples))
            of_reading = beside(scaled, np.diag(noise.read) * (1 / light**2 - 1 / samples))
            added = (values.clamp(min=0) * of_light + of_reading).clamp(min=0).sqrt() / spread
            mixing = np.linalg.cholesky(noise.correlation() + TINY * np.eye(len(noise.shot))).T
            return scaled + added * (normal(scaled, rng) @ beside(scaled, mixing))
        unit = float(2 ** (np.round(4 * np.log2(unit)) / 4))  # a quarter of an octave
        law = noise.spectra.condensing(unit)
        kept = max(np.count_nonzero(law.power > least_power), LEAST_COMPONENTS)
        mean = beside(scaled, law.mean)
        whole = np.sum(noise.spectra.noise(unit), axis=0)
        variances = zip(noise.spectra.noise(light), noise.spectra.noise(1.0), strict=True)
        # added noise, as means over the bands, in variances of the exposure ``unit``
        shot, read = (float(np.mean((own - before / samples) / whole)) for own, before in variances)
        brightness = values.mean(dim=-1, keepdim=True) / max(float(law.mean.mean()), TINY)
        size = ((read + shot * brightness.clamp(min=0)).clamp(min=0) + ROUNDED).sqrt()
        scores = (values - mean) @ beside(scaled, law.of_columns[:, :kept])
        scores += size * normal(scores, rng)
        return (scores @ beside(scaled, law.back[:kept]) + mean - centre) / spread


def beside(image: Tensor, numbers: NDArray[np.floating]) -> Tensor:
    """Return numbers as float32 on the device of an image."""
    return torch.from_numpy(np.asarray(numbers, np.float32)).to(image.device)


def with_capture(columns: Tensor, planes: NDArray[np.floating]) -> Tensor:
    """Append the planes of a capture (..., 3) to spectral features, (y, x, column) -> (y, x, column + 3)."""
    return torch.cat([columns, beside(columns, planes).expand(*columns.shape[:-1], PLANES)], dim=-1)


def normal(like: Tensor, rng: np.random.Generator) -> Tensor:
    """Draw standard normal numbers on the device of a tensor, by a seed of ``rng``."""
    seeded = torch.Generator(like.device).manual_seed(int(rng.integers(2**63)))
    return torch.randn(like.shape, generator=seeded, device=like.device)


def rows_between(lines: Tensor, size: int, *, first: float, apart: float) -> Tensor:
    """Interpolate ``size`` rows from lines (line, x, column) at row ``first`` and every ``apart`` rows, by Catmull-Rom.

    The border's lines are repeated beyond it.
    """
    at = (np.arange(size) - first) / apart
    before = np.floor(at).astype(np.intp)
    t = at - before
    weights = (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    rows = lines.new_zeros(size, *lines.shape[1:])
    for tap, weight in enumerate(weights, start=-1):
        near = torch.from_numpy(np.clip(before + tap, 0, len(lines) - 1)).to(lines.device)
        rows += beside(lines, weight)[:, None, None] * lines[near]
    return rows
