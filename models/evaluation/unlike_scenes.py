"""Tell by their spectra whether a scene is unlike the training of weights.

Spectra are compared in the largest components of the training, whitened with the noise of its exposures. Two distances
count, each divided by the largest that a training scene has from the others:

- that of the mean spectrum, relative to the spread of the means of training scenes;
- the median squared distance of spectra, as the product of diagonal neighbours among every third pixel. Noise adds
  nothing to it, as it is independent in the two, whatever the exposure and the line spacing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

COMPONENTS = 8
STRIDE = 3  # px between the pixels that count
PARTS = 8  # training scenes to leave out in turn; fewer scenes are cut into blocks
DIFFERENCE = 0.05  # least standard deviation of the means of training scenes
EDGES = np.geomspace(0.5, 1e9, 500)  # of the histogram of products; half a component is not told from 0
DIGITS = 5  # decimals of the statistics in a description
MOST = 1e12  # of statistics in a description
UNLIKE = 2.0  # times the largest distance of a training scene

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class SceneSpectra:
    """Statistics of the spectra of a scene or of a part of it, which add up."""

    pixels: int
    total: Floats  # (component,) sum over pixels
    products: NDArray[np.int64]  # histogram of products of neighbours, by `EDGES`

    def __add__(self, other: SceneSpectra) -> SceneSpectra:
        """Join the statistics of two parts."""
        return SceneSpectra(self.pixels + other.pixels, self.total + other.total, self.products + other.products)


@dataclass(frozen=True)
class TrainingSpectra:
    """Statistics of the training: what the spectra of a scene are compared with."""

    axes: Floats  # (column, component) of normalised columns
    centre: Floats  # (component,) mean
    spread: Floats  # (component,) standard deviation of the means of training scenes
    limits: tuple[float, float] = (1.0, 1.0)  # largest distances of a training scene: of its mean, of its spectra

    @staticmethod
    def measured(scenes: Sequence[Floats], whitening: Floats) -> TrainingSpectra | None:
        """Measure the training by its scenes of normalised columns (y, x, column); None if too small or constant."""
        axes = np.linalg.eigh(np.asarray(whitening, np.float64))[1][:, :COMPONENTS]  # smallest gain: largest variance
        bare = TrainingSpectra(axes, np.zeros(axes.shape[1]), np.ones(axes.shape[1]))
        parts = [block[::STRIDE, ::STRIDE] for block in _blocks(scenes)]
        known = [bare.of(part) for part in parts]
        parts = [part for part, one in zip(parts, known, strict=True) if one.pixels]
        if len(parts) < PARTS:
            return None
        pixels = np.array([one.pixels for one in known if one.pixels])
        means = np.array([one.total / one.pixels for one in known if one.pixels])
        found = []
        for number, part in enumerate(parts):
            rest = np.arange(len(parts)) != number
            others = TrainingSpectra(axes, np.average(means[rest], axis=0, weights=pixels[rest]), _spread(means[rest]))
            found.append(others.distances(others.of(part)))
        mean, spectra = map(float, np.max(found, axis=0).round(DIGITS))
        if not min(mean, spectra) > 0:
            return None
        return TrainingSpectra(axes, np.average(means, axis=0, weights=pixels), _spread(means), (mean, spectra))

    def of(self, columns: Floats, seen: NDArray[np.bool_] | None = None) -> SceneSpectra:
        """Return the statistics of some pixels (y, x, column), a third of the rows and columns, that were ``seen``."""
        at = columns.astype(np.float64) @ self.axes - self.centre
        if seen is not None:
            at[~seen] = np.nan
        pairs = (at[1:, 1:] * at[:-1, :-1]).sum(axis=-1)
        known = at[np.isfinite(at).all(axis=-1)]
        bins = np.searchsorted(EDGES, pairs[np.isfinite(pairs)])
        return SceneSpectra(len(known), known.sum(axis=0), np.bincount(bins, minlength=len(EDGES) + 1))

    def distances(self, scene: SceneSpectra) -> tuple[float, float]:
        """Return the distances of a scene by its mean and by its spectra, relative to `limits`; 0 without a pixel."""
        mean = scene.total / max(scene.pixels, 1) / self.spread
        middle = np.searchsorted(np.cumsum(scene.products), scene.products.sum() / 2)
        spectra = float(EDGES[min(int(middle), len(EDGES) - 1)]) if scene.products.any() else 0.0
        return float(np.sqrt((mean**2).mean())) / self.limits[0], spectra / self.limits[1]

    @staticmethod
    def read(content: Mapping[str, Any], columns: int) -> TrainingSpectra:
        """Read the statistics for so many columns. Raises KeyError, TypeError or ValueError: they are malformed."""
        axes, centre, spread = (np.asarray(content[name], np.float64) for name in ("axes", "centre", "spread"))
        mean, spectra = map(float, content["limits"])
        fits = axes.shape == (columns, *centre.shape) and spread.shape == centre.shape
        known = np.concatenate([axes.ravel(), centre, spread, [mean, spectra]])
        if not fits or not min(mean, spectra, *spread) > 0 or not (np.abs(known) < MOST).all():
            raise ValueError(f"spectra of axes {axes.shape}, centre {centre.shape} and spread {spread.shape}")
        return TrainingSpectra(axes, centre, spread, (mean, spectra))

    def as_dict(self) -> dict[str, Any]:
        """Return the statistics for a description."""
        return {name: np.round(value, DIGITS).tolist() for name, value in asdict(self).items()}


def _spread(means: Floats) -> Floats:
    return np.asarray(np.hypot(means.std(axis=0, ddof=1), DIFFERENCE))


def _blocks(scenes: Sequence[Floats]) -> list[Floats]:
    """Return the scenes, each cut into blocks where there are few."""
    side = int(np.ceil(np.sqrt(PARTS / len(scenes))))
    rows = [some for one in scenes for some in np.array_split(one, side)]
    blocks = [block for some in rows for block in np.array_split(some, side, axis=1)]
    return [block for block in blocks if block.size]
