"""What shorter exposures and wider steps would have shown of a look: noise of its columns by the light that it had."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from models.network.spectral import Normalisation
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS

REFERENCE_MS = DEFAULT_EXPOSURE_MS  # exposures are told as fractions of this one, at which looks are made
STEPS = MappingProxyType({1: 0.5, 2: 0.4, 4: 0.1})  # how often crops have lines so many pixels apart
DARKEST_COARSE_MS = 10.0  # of a coarse pass, whose samples are read in fours
TINY = 1e-9  # added to correlations, which rounding may leave with an eigenvalue below 0
Matrix = NDArray[np.float64]
Columns = NDArray[np.float32]  # (y, x, column)


@dataclass(frozen=True)
class ColumnNoise:
    """Covariance of what one reading adds to columns, in squares of scene values.

    At the fraction ``light`` of the reference exposure a pixel of spectrum v has the covariance shot(v) / light + read
    / light^2: electrons grow with the exposure, the readings' noise does not. The mean of n samples, each read for
    itself, has a n-th of both.
    """

    shot: Matrix  # (column,) variance of each for a unit of its own light
    read: Matrix  # (column, column)

    @staticmethod
    def of_bands(
        matrix: NDArray[np.floating], value_of_electron: NDArray[np.floating], read_noise_e: float
    ) -> ColumnNoise:
        """By the weights (band, column) of columns and what an electron at the reference exposure is worth, (band,)."""
        weight, value = matrix.astype(np.float64), value_of_electron.astype(np.float64)
        shot = (weight**2).T @ value
        read = (weight * (read_noise_e * value[:, None]) ** 2).T @ weight
        return ColumnNoise(shot, read)

    def correlation(self) -> Matrix:
        """How columns err together, (column, column): bands that two of them share."""
        size = np.sqrt(np.maximum(np.diag(self.read), 1e-300))
        correlation: Matrix = self.read / np.outer(size, size)
        return correlation

    def variance(self, columns: NDArray[np.floating], light: float) -> NDArray[np.floating]:
        """Of columns (..., column) in scene values; light below 0 counts as none."""
        read = np.diag(self.read).astype(columns.dtype) / light**2
        variance: NDArray[np.floating] = np.maximum(columns, 0) * (self.shot / light).astype(columns.dtype) + read
        return variance

    def covariance(self, columns: NDArray[np.floating], light: float, samples: float = 1.0) -> Matrix:
        """(column, column) of the mean of ``samples`` samples of a spectrum (column,)."""
        size = np.sqrt(self.variance(columns.astype(np.float64), light) / samples)
        covariance: Matrix = self.correlation() * np.outer(size, size)
        return covariance


class CaptureAugmentation:
    """Turns crops of the reference exposure into what shorter exposures and wider steps would have shown."""

    def __init__(
        self,
        normalisation: Normalisation,
        *,
        darkest_ms: float = 3.0,
        steps: Mapping[int, float] = STEPS,
        own_coarse: float = 0.3,
    ) -> None:
        """``steps``: how often lines are so many pixels apart; ``own_coarse``: how often there is a coarse pass."""
        self.normalisation, self.darkest_ms, self.own_coarse = normalisation, darkest_ms, own_coarse
        self.steps = steps
        self.unwhiten = np.linalg.inv(normalisation.whitening.astype(np.float64)).astype(np.float32)

    def draw(
        self, fine: Columns, coarse: Columns, noise: ColumnNoise, factor: int, rng: np.random.Generator
    ) -> tuple[Columns, Columns]:
        """Show a crop as a look drawn by chance: exposure (its logarithm is even), step, and a coarse pass or none.

        ``fine`` and ``coarse`` are whitened columns of the reference exposure, the coarse pixels ``factor`` times as
        wide; what comes back has their shapes.
        """
        light = _drawn_light(self.darkest_ms, rng)
        step = drawn_step(self.steps, factor, rng)
        plain, means = self.scan(fine, noise, factor, light=light, step=step, rng=rng)
        if rng.random() >= self.own_coarse:
            return plain, means
        light = _drawn_light(max(self.darkest_ms, DARKEST_COARSE_MS), rng)
        return plain, self.coarse_pass(coarse, noise, factor, light=light, rng=rng)

    def coarse_pass(
        self, coarse: Columns, noise: ColumnNoise, factor: int, *, light: float, rng: np.random.Generator
    ) -> Columns:
        """Show a coarse pass of the reference exposure as one of another, ``light`` its fraction of the reference."""
        own = self._noisy(coarse @ self.unwhiten, noise, light, rng, samples=factor, readings=factor)
        return np.asarray(own @ self.normalisation.whitening, np.float32)

    def scan(
        self, fine: Columns, noise: ColumnNoise, factor: int, *, light: float, step: int, rng: np.random.Generator
    ) -> tuple[Columns, Columns]:
        """Show a crop as a uniform scan: fine pixels by lines ``step`` px apart, and the coarse ones that they make.

        ``light`` is the exposure as a fraction of the reference; ``step`` divides ``factor``.
        """
        scaled, whitening = fine @ self.unwhiten, self.normalisation.whitening
        if step > 1:
            scaled = scaled.reshape(-1, step, *scaled.shape[1:]).mean(axis=1)
        scaled = self._noisy(scaled, noise, light, rng, samples=step)
        rows, columns = scaled.shape[0] * step // factor, scaled.shape[1] // factor
        means = scaled.reshape(rows, factor // step, columns, factor, -1).mean(axis=(1, 3))
        for _ in range(step.bit_length() - 1):
            scaled = _twice_the_rows(scaled)
        return np.asarray(scaled @ whitening, np.float32), np.asarray(means @ whitening, np.float32)

    def _noisy(
        self,
        scaled: Columns,
        noise: ColumnNoise,
        light: float,
        rng: np.random.Generator,
        *,
        samples: int,
        readings: int = 1,
    ) -> Columns:
        """With what so many readings of an exposure of ``light`` add to a mean of ``samples`` pixels of the reference.

        A line of several pixels is read once, a coarse pixel as often as it has samples along its line.
        """
        values = scaled * self.normalisation.spread + self.normalisation.centre
        more = noise.variance(values, light) / readings - noise.variance(values, 1.0) / samples
        size = np.sqrt(np.maximum(more, 0)) / self.normalisation.spread
        mixing = np.linalg.cholesky(noise.correlation() + TINY * np.eye(len(noise.shot))).T.astype(np.float32)
        drawn = rng.standard_normal(scaled.shape, np.float32) @ mixing
        return np.asarray(scaled + size.astype(np.float32) * drawn, np.float32)


def drawn_step(steps: Mapping[int, float], factor: int, rng: np.random.Generator) -> int:
    """Draw how far apart lines are, by odds, among steps that divide ``factor``: coarse pixels are means of lines."""
    offered = {step: odds for step, odds in steps.items() if factor % step == 0}
    odds = np.array(list(offered.values()))
    return int(rng.choice(list(offered), p=odds / odds.sum()))


def _drawn_light(darkest_ms: float, rng: np.random.Generator) -> float:
    """An exposure between the darkest and the reference, as a fraction of that."""
    return float(np.exp(rng.uniform(np.log(darkest_ms / REFERENCE_MS), 0.0)))


def _twice_the_rows(image: Columns) -> Columns:
    """Rows between rows, by Catmull-Rom at a quarter of the way, with the border repeated."""
    before, at, after, beyond = (
        np.pad(image, ((2, 2), (0, 0), (0, 0)), mode="edge")[i : len(image) + 1 + i] for i in range(4)
    )
    third = (-0.0703125 * before + 0.8671875 * at + 0.2265625 * after - 0.0234375 * beyond).astype(np.float32)
    first = (-0.0234375 * before + 0.2265625 * at + 0.8671875 * after - 0.0703125 * beyond).astype(np.float32)
    grown = np.empty((2 * len(image), *image.shape[1:]), np.float32)
    grown[0::2], grown[1::2] = first[:-1], third[1:]
    return grown
