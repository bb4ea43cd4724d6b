"""Estimate the relative illumination of sweeps by band, from their overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.readings import SIGMA_OF_MEDIAN
from spectralzoom.pipeline.rectify.placed import PixelGrid, PlacedSweep
from spectralzoom.pipeline.rectify.region import mosaic_tile
from spectralzoom.pipeline.rectify.registration.overlaps import Window

Floats = NDArray[np.float64]

ORDER = 3  # of the polynomial in wavelength: daylight drifts by colour, not by spectral line
ERROR_FLOOR = 1e-3  # of a log ratio
MEDIAN_LOSS = 1.2533  # standard error of a median over that of a mean
PROBE_ROWS = 96  # at the middle of every window
GROUP_PX = 16  # side of the squares whose sums are compared: some periods of crop rows
LEAST_GROUPS = 5


@dataclass(frozen=True)
class LightRatio:
    """Brightness of one sweep over that of another at the same ground."""

    reference: int  # number of the sweep
    moving: int
    log_ratio: Floats  # (band,) of moving over reference; NaN where too little was seen
    error: Floats  # (band,) standard error, infinite where the ratio is NaN


@dataclass(frozen=True)
class SweepLights:
    """Light of every sweep relative to the geometric mean of the sweeps that overlaps join."""

    light: NDArray[np.float32]  # (sweep, band), 1 on average
    untied: tuple[int, ...]  # sweeps in no ratio: left at 1

    def gain(self, sweep: int) -> NDArray[np.float32]:
        """Return the factor of a sweep's values, (band,): one over its light."""
        return np.asarray(1 / self.light[sweep])


def light_ratio(
    reference_values: NDArray[np.floating], moving_values: NDArray[np.floating], *, pair: tuple[int, int]
) -> LightRatio:
    """Compare a ``pair`` of sweeps at the same points: calibrated values (group, point, band), NaN where not seen.

    The points come in groups (squares of pixels). The ratio is the median over groups of the ratio of their sums. Sums
    suppress the noise of single pixels, and the median suppresses objects that moved between the sweeps.
    """
    both = np.isfinite(reference_values) & np.isfinite(moving_values)
    sums = [np.where(both, values, 0).sum(axis=1, dtype=np.float64) for values in (reference_values, moving_values)]
    usable = (sums[0] > 0) & (sums[1] > 0)
    each = np.full(usable.shape, np.nan)
    each[usable] = np.log(sums[1][usable] / sums[0][usable])
    ratio, error = np.full(each.shape[1], np.nan), np.full(each.shape[1], np.inf)
    for band in np.flatnonzero(usable.sum(axis=0) >= LEAST_GROUPS):
        known = each[usable[:, band], band]
        ratio[band] = np.median(known)
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(known - ratio[band]))
        error[band] = MEDIAN_LOSS * spread / np.sqrt(len(known))
    return LightRatio(*pair, ratio, error)


def solve_lights(ratios: Sequence[LightRatio], sweeps: int, wavelength_nm: Floats) -> SweepLights:
    """Find the light of every sweep from the ratios of all pairs; ``wavelength_nm`` is (band,) in any order.

    Least squares of log ratios, each weighted by its error, with the log light of a sweep a polynomial in wavelength.
    Overlaps see ratios only: the mean log light of sweeps that they join is 0 at every wavelength.
    """
    known = [ratio for ratio in ratios if np.isfinite(ratio.log_ratio).any()]
    low, high = float(np.min(wavelength_nm)), float(np.max(wavelength_nm))
    span = (2 * np.asarray(wavelength_nm, np.float64) - low - high) / max(high - low, 1e-9)
    most = len(np.unique(wavelength_nm)) - 1  # at most as many polynomials as bands
    basis = np.polynomial.legendre.legvander(span, min(ORDER, most)).astype(np.float64)
    answer = np.zeros((sweeps, basis.shape[1]))
    if known:
        rows, wanted = zip(*(_equations(ratio, sweeps, basis) for ratio in known), strict=True)
        # The least solution: what no ratio sees, the mean of joined sweeps, is 0.
        solved, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(wanted), rcond=1e-10)
        answer = solved.reshape(sweeps, -1)
    seen = {number for ratio in known for number in (ratio.reference, ratio.moving)}
    untied = tuple(number for number in range(sweeps) if number not in seen)
    return SweepLights(np.exp(answer @ basis.T).astype(np.float32), untied)


def overlap_light(placed: Sequence[PlacedSweep], camera: LineCamera, windows: Sequence[Window]) -> list[LightRatio]:
    """Compare both sweeps of every pair at the middle rows of their windows: one ratio for every pair.

    A window takes all pixels of 96 rows, summed in squares of 16 px. A subset of pixels would always meet crop rows at
    the same place between two plants. Two sweeps blur that place differently, which would look like a change of light.
    The sweeps are placed as registered, without a gain.
    """
    ratios = []
    for pair in sorted({(window.reference, window.moving) for window in windows}):
        here = [window for window in windows if (window.reference, window.moving) == pair]
        sides = [[_probe(placed[number], camera, window) for window in here] for number in pair]
        rows, columns = (min(GROUP_PX, *(values.shape[axis] for values in sides[0])) for axis in (0, 1))
        both = (np.concatenate([_squares(values, rows, columns) for values in side]) for side in sides)
        ratios.append(light_ratio(*both, pair=pair))
    return ratios


def _probe(placed: PlacedSweep, camera: LineCamera, window: Window) -> NDArray[np.float32]:
    """Return values of one sweep in a window, (row along the scan, column along the line, band)."""
    sweep = placed.lines.sweep
    rows = min(PROBE_ROWS, int((window.scan_px[1] - window.scan_px[0]) // sweep.step) + 1)
    columns = int((window.along_px[1] - window.along_px[0]) // sweep.step) + 1
    start = sum(window.scan_px) / 2 - (rows - 1) / 2 * sweep.step, window.along_px[0]
    turned = sweep.along == "y"
    grid = PixelGrid(start[::-1] if turned else start, sweep.step, (columns, rows) if turned else (rows, columns))
    values, _ = mosaic_tile([placed], camera, grid, slice(0, grid.shape[0]), slice(0, grid.shape[1]), kernel="bilinear")
    values = placed.signal.spectra(values)
    return values.swapaxes(0, 1) if turned else values


def _squares(values: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """Cut (row, column, band) into groups of neighbours, (group, point, band); incomplete groups are dropped."""
    down, across, bands = values.shape[0] // rows, values.shape[1] // columns, values.shape[2]
    whole = values[: down * rows, : across * columns].reshape(down, rows, across, columns, bands)
    return whole.swapaxes(1, 2).reshape(down * across, rows * columns, bands)


def _equations(ratio: LightRatio, sweeps: int, basis: Floats) -> tuple[Floats, Floats]:
    known = np.isfinite(ratio.log_ratio)
    weight = 1 / np.hypot(ratio.error[known], ERROR_FLOOR)
    rows = np.zeros((int(known.sum()), sweeps, basis.shape[1]))
    rows[:, ratio.moving] += basis[known]
    rows[:, ratio.reference] -= basis[known]
    return rows.reshape(len(rows), -1) * weight[:, None], ratio.log_ratio[known] * weight
