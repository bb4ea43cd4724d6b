"""Choose a uniform scan: one pass over the field by line spacing and exposure, within a time.

The expected scores come from the scan performance that was measured with the weights: a table by step and exposure.
Between two exposures interpolation is linear in the logarithm; beyond the table there is no score.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import BudgetError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import CostModel, Sweep
from spectralzoom.pipeline.planning.coverage import raw_bytes

EXPOSURES_AN_OCTAVE = 8  # candidates
LOSS = 0.001  # of mIoU: scans that differ by less count as equal
REFERENCE_LOSS = 0.005  # of mIoU: the reference for savings is this near the best scan
MIOU = "mIoU"  # the mean over classes
_DIGITS = 1  # of an exposure in ms, so that settings can be read


@dataclass(frozen=True)
class UniformScan:
    """A scan of the whole field, its costs and the expected scores of its map."""

    step: int  # pixels from line to line
    exposure_ms: float
    seconds: float
    bytes_raw: int
    expected: Mapping[str, float]  # mIoU, 0..1, by the key `MIOU`, and IoU by the names of classes
    spread: float | None = None  # standard deviation of the mIoU from scene to scene; None if unknown

    @property
    def summary(self) -> str:
        """Return a summary, such as "every 2nd line, 25 ms"."""
        return format_scan(self.step, self.exposure_ms)


def format_scan(step: int, *exposures_ms: float) -> str:
    """Return a summary of a scan in one exposure or several, such as "every 2nd line, 25 ms"."""
    every = {1: "every line", 2: "every 2nd line", 3: "every 3rd line"}.get(step, f"every {step}th line")
    return f"{every}, {' and '.join(f'{one_ms:g} ms' for one_ms in exposures_ms)}"


@dataclass(frozen=True)
class ScanPerformance:
    """Scores of uniform scans on scenes kept from training, by step and exposure."""

    steps: tuple[int, ...]
    exposures_ms: tuple[float, ...]  # ascending
    scores: Mapping[str, NDArray[np.float64]]  # mIoU and IoU by class, (step, exposure) 0..1
    spread: NDArray[np.float64] | None = None  # of mIoU, (step, exposure), from scene to scene
    light_fraction: float = 1.0  # of today's light over a clear sky's, in which the scenes were scanned

    @staticmethod
    def read(content: Mapping[str, Any], light_fraction: float = 1.0) -> ScanPerformance:
        """Return the table of a record of weights, with its exposures in ascending order.

        At a fraction of a clear sky's light an exposure has the score of one that is shorter by that fraction.
        """
        order = np.argsort(content["exposures_ms"])
        tables = {MIOU: content["miou"], **content["per_class_iou"]}
        return ScanPerformance(
            tuple(content["steps"]),
            tuple(float(content["exposures_ms"][i]) / light_fraction for i in order),
            {name: np.asarray(table, np.float64)[:, order] for name, table in tables.items()},
            None if content.get("spread") is None else np.asarray(content["spread"], np.float64)[:, order],
            light_fraction,
        )

    def offered_ms(self, camera: LineCamera) -> tuple[float, float]:
        """Return the shortest and the longest exposure to choose from; the camera's own is for a clear sky."""
        return self.exposures_ms[0], min(camera.exposure_ms / self.light_fraction, self.exposures_ms[-1])

    def knows(self, exposure_ms: float) -> bool:
        """Return whether a rounded exposure lies within the table."""
        rounding = 0.5 * 10.0**-_DIGITS
        return self.exposures_ms[0] - rounding <= exposure_ms <= self.exposures_ms[-1] + rounding

    def expected(self, step: int, exposure_ms: float) -> dict[str, float]:
        """Return the scores of a scan of a step and exposure within the table."""
        return {name: self.between(table, step, exposure_ms) for name, table in self.scores.items()}

    def error_rates(self, step: int, exposure_ms: float, class_names: Sequence[str]) -> NDArray[np.float64]:
        """Return (1 - IoU) / (1 + IoU) of each class in a scan; a class that the table lacks has the mean IoU."""
        expected = self.expected(step, exposure_ms)
        iou = np.array([expected.get(name, expected[MIOU]) for name in class_names])
        return np.asarray((1 - iou) / (1 + iou))

    def between(self, table: NDArray[np.float64], step: int, exposure_ms: float) -> float:
        """Return a table's value for a step, interpolated over the logarithm of the exposure."""
        return float(np.interp(math.log(exposure_ms), np.log(self.exposures_ms), table[self.steps.index(step)]))


def uniform_scans(
    record: ScanPerformance,
    sweeps: Mapping[int, Sequence[Sweep]],
    camera: LineCamera,
    cost: CostModel,
    bands: int,
    *,
    seconds: float | None = None,
    recorded_ms: Mapping[int, float] | None = None,
) -> list[UniformScan]:
    """Return candidate scans of every step and many exposures, none longer than the camera's own.

    ``sweeps`` cover the field, by steps of the record, whatever their exposure. With ``seconds`` the longest exposure
    of each step that ends in time is a candidate. With ``recorded_ms``, exposures by step, only those are tried that
    the record knows.
    """
    found = []
    shortest, longest = record.offered_ms(camera)
    for step in sweeps:
        tried = exposures_between(shortest, longest)
        if recorded_ms is not None:
            tried = [recorded_ms[step]] if record.knows(recorded_ms[step]) else []
        elif seconds is not None and tried:
            last = longest_exposure(seconds, sweeps[step], camera, cost, shortest, longest)
            tried += [] if last is None else [last]
        found += [priced_scan(record, sweeps[step], camera, cost, bands, exposure_ms) for exposure_ms in tried]
    return found


def priced_scan(
    record: ScanPerformance,
    sweeps: Sequence[Sweep],
    camera: LineCamera,
    cost: CostModel,
    bands: int,
    exposure_ms: float,
) -> UniformScan:
    """Return one scan with its costs and scores, by its sweeps and an exposure, of a step that the record has."""
    step = sweeps[0].step
    exposed = [replace(sweep, exposure_ms=exposure_ms) for sweep in sweeps]
    return UniformScan(
        step,
        exposure_ms,
        cost.seconds(exposed, camera),
        bytes_raw=raw_bytes(exposed, camera, bands),
        expected=record.expected(step, exposure_ms),
        spread=None if record.spread is None else record.between(record.spread, step, exposure_ms),
    )


def exposures_between(shortest: float, longest: float) -> list[float]:
    """Return candidate exposures, even in their logarithm, with both ends; empty if ``longest`` is the shorter one."""
    if longest < shortest:
        return []
    count = max(math.ceil(EXPOSURES_AN_OCTAVE * math.log2(longest / shortest)), 1)
    return [round(float(one), _DIGITS) for one in np.geomspace(shortest, longest, count + 1)]


def longest_exposure(
    seconds: float, sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, shortest: float, longest: float
) -> float | None:
    """Return the longest exposure of such sweeps that ends in time, to .1 ms or ``shortest``; None if none does."""

    def taken_s(exposure_ms: float) -> float:
        return cost.seconds([replace(sweep, exposure_ms=exposure_ms) for sweep in sweeps], camera)

    if taken_s(shortest) > seconds:
        return None
    scale = 10.0**_DIGITS
    tenths = range(math.ceil(shortest * scale), math.floor(longest * scale) + 1)
    in_time = bisect_right(tenths, seconds, key=lambda tenth: taken_s(tenth / scale))
    return tenths[in_time - 1] / scale if in_time else shortest


def choose_scan(scans: Sequence[UniformScan], seconds: float) -> UniformScan:
    """Return the scan with the highest expected mIoU in the time.

    Scans within `LOSS` of the best count as equal, and the cheapest of them is taken. Ties go to the higher mIoU, then
    to the first. Raises BudgetError: no scan ends in time; names the least time.
    """
    paid = [scan for scan in scans if scan.seconds <= seconds]
    if not paid:
        fastest = min(scans, key=lambda scan: scan.seconds)
        raise BudgetError(
            f"no uniform scan that the weights know ends within --seconds {seconds:g}; the least is "
            f"{fastest.seconds + 0.005:.2f} s ({fastest.summary})"
        )
    best = max(scan.expected[MIOU] for scan in paid)
    equal = [scan for scan in paid if scan.expected[MIOU] >= best - LOSS]
    return min(equal, key=lambda scan: (scan.seconds, scan.bytes_raw, -scan.expected[MIOU]))


def reference_scan(scans: Sequence[UniformScan]) -> UniformScan:
    """Return the cheapest scan within `REFERENCE_LOSS` of the best, the reference for savings."""
    best = max(scan.expected[MIOU] for scan in scans)
    return min((scan for scan in scans if scan.expected[MIOU] >= best - REFERENCE_LOSS), key=lambda scan: scan.seconds)


def frontier(scans: Sequence[UniformScan]) -> list[UniformScan]:
    """Return the Pareto front of scans in seconds and score, by ascending seconds."""
    kept: list[UniformScan] = []
    for scan in sorted(scans, key=lambda one: (one.seconds, -one.expected[MIOU])):
        if not kept or scan.expected[MIOU] > kept[-1].expected[MIOU]:
            kept.append(scan)
    return kept
