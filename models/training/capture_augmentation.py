"""What shorter exposures and wider steps would have shown of a look: noise of its columns by the light that it had."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from models.network.spectral import LineSpec, Normalisation, with_planes
from pipeline.simulator.scenes.scene import DEFAULT_EXPOSURE_MS

REFERENCE_MS = DEFAULT_EXPOSURE_MS  # exposures are told as fractions of this one, at which looks are made
STEPS = MappingProxyType({1: 0.45, 2: 0.3, 4: 0.2, 8: 0.05})  # how often crops have lines so many pixels apart
UNIFORM, INTERLACED, TWO_PASSES = range(3)
KINDS_OF_CAPTURE = (0.65, 0.2, 0.15)  # how often
BINNED = 4  # lines and samples of a coarse pass to a pixel
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
    """Turns crops of the reference exposure into what shorter exposures and wider line spacings would have shown.

    What is given back has the planes of `models.network.spectral.LineSpec` behind the spectral features.
    """

    def __init__(self, normalisation: Normalisation, *, darkest_ms: float = 3.0) -> None:
        self.normalisation, self.darkest_ms = normalisation, darkest_ms
        self.unwhiten = np.linalg.inv(normalisation.whitening.astype(np.float64)).astype(np.float32)

    def draw(self, columns: Columns, noise: ColumnNoise, rng: np.random.Generator) -> tuple[Columns, Columns]:
        """Show a crop (y, x, column) as a capture drawn by chance: what the overview reads, and the full network.

        A uniform scan; two of them, of which one covers a rectangle (lines captured between others); or two passes,
        where the overview reads binned pixels and the full network a scan. Exposures are even in their logarithm.
        """
        kind = rng.choice(3, p=KINDS_OF_CAPTURE)
        odds = {step: often for step, often in STEPS.items() if len(columns) % step == 0}
        step = int(rng.choice(list(odds), p=np.array(list(odds.values())) / sum(odds.values())))
        image = self.scan(columns, noise, light=self._light(rng), step=step, rng=rng)
        if kind == TWO_PASSES:
            light = max(self._light(rng), DARKEST_COARSE_MS / REFERENCE_MS)
            return self.coarse_pass(columns, noise, light=light, rng=rng), image
        if kind == INTERLACED and step > 1:
            finer = step // int(rng.choice([own for own in (2, 4, 8) if own <= step]))
            (top, bottom), (left, right) = (
                sorted(rng.integers(0, size // step + 1, 2) * step) for size in image.shape[:2]
            )
            part = np.s_[top:bottom, left:right]
            if bottom > top and right > left:
                image[part] = self.scan(columns[part], noise, light=self._light(rng), step=finer, rng=rng)
        return image, image

    def _light(self, rng: np.random.Generator) -> float:
        """An exposure between the darkest and the reference, as a fraction of that."""
        return float(np.exp(rng.uniform(np.log(self.darkest_ms / REFERENCE_MS), 0.0)))

    def scan(
        self, columns: Columns, noise: ColumnNoise, *, light: float, step: int, rng: np.random.Generator
    ) -> Columns:
        """Show a crop as a uniform scan of lines ``step`` px apart, rows between them by interpolation.

        ``light`` is the exposure as a fraction of the reference; ``step`` is a power of two that divides the rows.
        """
        scaled = columns @ self.unwhiten
        if step > 1:
            scaled = scaled.reshape(-1, step, *scaled.shape[1:]).mean(axis=1)
        scaled = self._noisy(scaled, noise, light, rng, samples=step)
        for _ in range(step.bit_length() - 1):
            scaled = _twice_the_rows(scaled)
        return with_planes(scaled @ self.normalisation.whitening, LineSpec(light, step))

    def coarse_pass(self, columns: Columns, noise: ColumnNoise, *, light: float, rng: np.random.Generator) -> Columns:
        """Show a crop as a pass of lines ``BINNED`` px apart, so many samples binned, each pixel repeated."""
        scaled = columns @ self.unwhiten
        y, x, _ = scaled.shape
        means = scaled.reshape(y // BINNED, BINNED, x // BINNED, BINNED, -1).mean(axis=(1, 3))
        means = self._noisy(means, noise, light, rng, samples=BINNED**2, readings=BINNED)
        repeated = np.repeat(np.repeat(means, BINNED, axis=0), BINNED, axis=1)
        return with_planes(repeated @ self.normalisation.whitening, LineSpec(light, BINNED, BINNED))

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
