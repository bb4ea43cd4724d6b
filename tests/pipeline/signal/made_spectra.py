"""Spectra for tests: smooth fields of some materials, a camera's noise, and their lines as from a source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.signal.components import Components
from spectralzoom.pipeline.signal.condense import ResidualLaw, ScoredLines, find_rare, score_lines
from spectralzoom.pipeline.signal.subspace import SignalStatistics
from spectralzoom.pipeline.source import References

CAMERA = LineCamera(samples=64)
DARK = 64  # DN
GAIN = 1e-3  # the scene value of one DN

Values = NDArray[np.float32]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Field:
    """Spectra without noise (line, sample, band), the standard deviation of the noise (band,), and their sum."""

    clean: Floats
    noise: Floats
    values: Values


def field_of(
    seed: int, shape: tuple[int, int] = (96, 96), bands: int = 40, materials: int = 3, signal: float = 30.0
) -> Field:
    """Return materials that vary over some px, each by ``signal`` sigma of a band's noise, around a value of 1."""
    rng = np.random.default_rng(seed)
    noise = np.linspace(4, 10, bands) * GAIN
    clean = np.ones((*shape, bands))
    for _ in range(materials):
        amount, spectrum = gaussian_filter(rng.normal(size=shape), 4), gaussian_filter(rng.normal(size=bands), 2)
        clean += signal * noise * (amount / amount.std())[..., None] * spectrum / max(np.abs(spectrum).max(), 1e-9)
    return Field(clean, noise, with_noise(clean, noise, seed))


def with_noise(clean: Floats, noise: Floats, seed: int) -> Values:
    """Return spectra with a camera's noise."""
    return (clean + noise * np.random.default_rng([seed, 1]).normal(size=clean.shape)).astype(np.float32)


def statistics_of(values: Values, valid: Bools | None = None, *, expected: int | None = None) -> SignalStatistics:
    """Return statistics of a field that is added 64 lines at a time."""
    known = np.ones(values.shape[:2], np.bool_) if valid is None else valid
    found = SignalStatistics(values.shape[2], expected or values.shape[0] * values.shape[1])
    for first in range(0, len(values), 64):
        found.add(values[first : first + 64], known[first : first + 64])
    return found


def scored(values: Values, components: Components, valid: Bools | None = None) -> ScoredLines:
    """Return scores of all spectra, or of those that are ``valid``."""
    return score_lines(values, np.ones(values.shape[:2], np.bool_) if valid is None else valid, components)


def marked(
    values: Values, found: SignalStatistics, components: Components, valid: Bools | None = None, alarms: float = 1.0
) -> Bools:
    """Return a mask of rare spectra (line, sample), by the residual law of the statistics' own spectra."""
    law = ResidualLaw.learned(found.spectra, components)
    seen = scored(values, components, valid)
    return find_rare(seen.residual / law.expected(seen.scores), law, alarms)


def restored(seen: ScoredLines, components: Components, step: float = 1.0) -> Values:
    """Return scene values of scores rounded in steps."""
    return components.restore(np.rint(seen.scores / np.float32(step)) * np.float32(step))


def raw_of(values: Values) -> NDArray[np.uint16]:
    """Return scene values as 12-bit numbers of the camera."""
    return np.clip(np.rint(values / GAIN) + DARK, 0, CAMERA.full_scale_dn).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class MadeLines:
    """A sweep with its raw lines in memory."""

    raw: NDArray[np.uint16]
    valid_line: Bools
    references: References

    @classmethod
    def of(cls, raw: NDArray[np.uint16], bad: Bools | None = None, *, by_mirror: bool = False) -> MadeLines:
        """Return lines of a detector with equal elements."""
        lines, *frame = raw.shape
        dark, white = np.full(frame, DARK, np.float32), np.ones(frame[1], np.float32)
        return cls(raw, np.ones(lines, np.bool_), References(dark, dark + 1 / GAIN, white, bad, by_mirror=by_mirror))

    @property
    def sweep(self) -> Sweep:
        """Return the sweep of the lines."""
        return Sweep("fine-0", "fine", "x", 0.0, 0.0, len(self.raw))

    @property
    def position(self) -> Floats:
        """Return mirror positions that differ slightly from line to line."""
        return np.stack([np.zeros(len(self.raw)), np.linspace(-0.1, 0.1, len(self.raw))], axis=-1)

    @property
    def time_s(self) -> Floats:
        """Return times at ten lines a second."""
        return 0.1 * np.arange(len(self.raw))

    @property
    def exposure_ms(self) -> Floats:
        """Return the exposures of the camera."""
        return np.full(len(self.raw), CAMERA.exposure_ms)

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Return raw numbers of some lines."""
        return self.raw[start:stop]
