"""Uniform scans: one pass over the field for each line spacing and exposure, and the one that is worth its price.

What a scan's map is likely to score stands in a record that was made with the weights: a table by step and exposure.
Between two exposures the logarithm of the exposure counts; outside the table nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import BudgetError, NoScanPaidFor
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import CostModel, Sweep
from pipeline.planning.prices import raw_bytes

EXPOSURES_AN_OCTAVE = 8  # that are tried
LOSS = 0.001  # of mIoU: a scan that is as much worse than another is as good
REFERENCE_LOSS = 0.005  # of mIoU: so near the best is the scan that savings are told against
MIOU = "mIoU"  # as a goal: the mean over classes
_DIGITS = 1  # of an exposure in ms, so that settings can be read


@dataclass(frozen=True)
class UniformScan:
    """A scan of the whole field, what it costs, and what its map is likely to score."""

    step: int  # pixels from line to line
    exposure_ms: float
    seconds: float
    bytes_raw: int
    expected: Mapping[str, float]  # mIoU, 0..1, by the key `MIOU`, and IoU by the names of classes
    spread: float | None = None  # of the mIoU from scene to scene, as a standard deviation; None where not known

    @property
    def words(self) -> str:
        """Such as "every 2nd line, 25 ms"."""
        return format_scan(self.step, self.exposure_ms)


def format_scan(step: int, exposure_ms: float) -> str:
    """A uniform scan in words, such as "every 2nd line, 25 ms"."""
    every = {1: "every line", 2: "every 2nd line", 3: "every 3rd line"}.get(step, f"every {step}th line")
    return f"{every}, {exposure_ms:g} ms"


@dataclass(frozen=True)
class ScanPerformance:
    """Scores of uniform scans on scenes kept from training, by step and exposure."""

    steps: tuple[int, ...]
    exposures_ms: tuple[float, ...]  # ascending
    scores: Mapping[str, NDArray[np.float64]]  # by the goals' names, (step, exposure) 0..1
    scenes: int
    spread: NDArray[np.float64] | None = None  # of mIoU, (step, exposure), from scene to scene
    light_fraction: float = 1.0  # in which these are the exposures, over a clear sky's, in which scenes were scanned

    @staticmethod
    def read(content: Mapping[str, Any], light_fraction: float = 1.0) -> ScanPerformance:
        """Take the table from a record of weights, in whatever order its exposures are.

        In a fraction of a clear sky's light an exposure scores what the record has of one shorter by that fraction.
        """
        order = np.argsort(content["exposures_ms"])
        tables = {MIOU: content["miou"], **content["per_class_iou"]}
        return ScanPerformance(
            tuple(content["steps"]),
            tuple(float(content["exposures_ms"][i]) / light_fraction for i in order),
            {name: np.asarray(table, np.float64)[:, order] for name, table in tables.items()},
            int(content["scenes"]),
            None if content.get("spread") is None else np.asarray(content["spread"], np.float64)[:, order],
            light_fraction,
        )

    def offered_ms(self, camera: LineCamera) -> tuple[float, float]:
        """Return the shortest and the longest exposure to choose from; the camera's own is for a clear sky."""
        return self.exposures_ms[0], min(camera.exposure_ms / self.light_fraction, self.exposures_ms[-1])

    def knows(self, exposure_ms: float) -> bool:
        """Return whether an exposure, rounded as those that are offered, lies within the record."""
        rounding = 0.5 * 10.0**-_DIGITS
        return self.exposures_ms[0] - rounding <= exposure_ms <= self.exposures_ms[-1] + rounding

    def expected(self, step: int, exposure_ms: float) -> dict[str, float]:
        """Scores of a scan of a step and exposure within the record."""
        return {name: self.between(table, step, exposure_ms) for name, table in self.scores.items()}

    def between(self, table: NDArray[np.float64], step: int, exposure_ms: float) -> float:
        """Return a table's value for a step, between its exposures by their logarithm."""
        return float(np.interp(math.log(exposure_ms), np.log(self.exposures_ms), table[self.steps.index(step)]))


@dataclass(frozen=True)
class ScanLimits:
    """Limits of a scan's cost, and goals of its score; None and {} set no limit."""

    seconds: float | None = None
    bytes_raw: float | None = None
    goals: Mapping[str, float] = field(default_factory=dict)  # by name, 0..1

    def afford(self, scan: UniformScan) -> bool:
        """Return whether a scan costs no more."""
        return (self.seconds is None or scan.seconds <= self.seconds) and (
            self.bytes_raw is None or scan.bytes_raw <= self.bytes_raw
        )

    def reached_by(self, scan: UniformScan) -> bool:
        """Return whether a scan is expected to reach the goals."""
        return all(scan.expected[name] >= least for name, least in self.goals.items())


def uniform_scans(
    record: ScanPerformance,
    sweeps: Mapping[int, Sequence[Sweep]],
    camera: LineCamera,
    cost: CostModel,
    bands: int,
    *,
    seconds: float | None = None,
    exposures_ms: Sequence[float] | None = None,
) -> list[UniformScan]:
    """Price scans of every step of a record and many exposures, none that takes more light than the camera's own.

    ``sweeps`` cover the field, by those steps of the record that can be taken, whatever their exposure. With
    ``seconds`` the longest exposure of each step that ends in time is among the scans. Where ``exposures_ms`` are
    given, no others are tried than those of them that the record knows.
    """
    found = []
    shortest, longest = record.offered_ms(camera)
    for step in sweeps:
        tried = exposures_between(shortest, longest)
        if exposures_ms is not None:
            tried = [exposure_ms for exposure_ms in exposures_ms if record.knows(exposure_ms)]
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
    """Price one scan, by its sweeps and an exposure, of a step that the record has."""
    step, exposed = sweeps[0].step, [replace(sweep, exposure_ms=exposure_ms) for sweep in sweeps]
    size, expected = raw_bytes(exposed, camera, bands), record.expected(step, exposure_ms)
    spread = None if record.spread is None else record.between(record.spread, step, exposure_ms)
    return UniformScan(step, exposure_ms, cost.seconds(exposed, camera), size, expected, spread)


def exposures_between(shortest: float, longest: float) -> list[float]:
    """Give exposures to try, evenly by their logarithm, both ends among them; none from a longer to a shorter."""
    if longest < shortest:
        return []
    count = max(math.ceil(EXPOSURES_AN_OCTAVE * math.log2(longest / shortest)), 1)
    return [round(float(one), _DIGITS) for one in np.geomspace(shortest, longest, count + 1)]


def longest_exposure(
    seconds: float, sweeps: Sequence[Sweep], camera: LineCamera, cost: CostModel, shortest: float, longest: float
) -> float | None:
    """Return the longest exposure of such sweeps that ends in time, to .1 ms; None where none does."""
    ends = [cost.seconds([replace(sweep, exposure_ms=one) for sweep in sweeps], camera) for one in (shortest, longest)]
    if not ends[0] <= seconds:
        return None
    scale = 10.0**_DIGITS
    low, high = math.ceil(shortest * scale), math.floor(longest * scale)
    while low < high:  # the camera's highest rate bends the line
        middle = (low + high + 1) // 2
        taken_s = cost.seconds([replace(sweep, exposure_ms=middle / scale) for sweep in sweeps], camera)
        low, high = (middle, high) if taken_s <= seconds else (low, middle - 1)
    return low / scale


def choose_scan(scans: Sequence[UniformScan], limits: ScanLimits) -> UniformScan:
    """Choose the scan within the limits that is expected to score most; with goals the cheapest that reaches them.

    Of those that are as good but for `LOSS` the cheapest is taken, and of those as cheap the better one; ties go to the
    first. Raises NoScanPaidFor: no scan is within the limits; names the least that would be. BudgetError: none reaches
    the goals; names the best there is.
    """
    paid = [scan for scan in scans if limits.afford(scan)]
    if not paid:
        raise NoScanPaidFor(_too_little(scans, limits))
    reaching = [scan for scan in paid if limits.reached_by(scan)]
    if not reaching:
        raise BudgetError(_too_much(scans, paid, limits))
    if limits.goals:
        return min(reaching, key=lambda scan: (scan.seconds, scan.bytes_raw, -scan.expected[MIOU]))
    best = max(scan.expected[MIOU] for scan in reaching)
    near = [scan for scan in reaching if scan.expected[MIOU] >= best - LOSS]
    return min(near, key=lambda scan: (scan.seconds, scan.bytes_raw, -scan.expected[MIOU]))


def reference_scan(scans: Sequence[UniformScan]) -> UniformScan:
    """The cheapest scan within `REFERENCE_LOSS` of the best: what a scan of everything need not cost more than."""
    best = max(scan.expected[MIOU] for scan in scans)
    return min((scan for scan in scans if scan.expected[MIOU] >= best - REFERENCE_LOSS), key=lambda scan: scan.seconds)


def frontier(scans: Sequence[UniformScan]) -> list[UniformScan]:
    """Return the Pareto front of scans in seconds and score, by ascending seconds."""
    kept: list[UniformScan] = []
    for scan in sorted(scans, key=lambda one: (one.seconds, -one.expected[MIOU])):
        if not kept or scan.expected[MIOU] > kept[-1].expected[MIOU]:
            kept.append(scan)
    return kept


def _too_little(scans: Sequence[UniformScan], limits: ScanLimits) -> str:
    """Name the limit that no scan meets, with the least that one takes."""
    fastest, smallest = min(scans, key=lambda scan: scan.seconds), min(scans, key=lambda scan: scan.bytes_raw)
    asked, least = [], []
    if limits.seconds is not None:
        asked.append(f"--seconds {limits.seconds:g}")
        least.append(f"{fastest.seconds:.1f} s ({fastest.words})")
    if limits.bytes_raw is not None:
        asked.append(f"--bytes-raw {limits.bytes_raw:g}")
        least.append(f"{smallest.bytes_raw:.4g} bytes ({smallest.words})")
    return f"no uniform scan that the weights know pays with {' and '.join(asked)}; the least is {', '.join(least)}"


def _too_much(scans: Sequence[UniformScan], paid: Sequence[UniformScan], limits: ScanLimits) -> str:
    """Name the goal beyond the weights' record, or beyond what the limits pay for."""
    for name, least in limits.goals.items():
        best = max(scan.expected[name] for scan in scans)
        if best < least:
            return f"--goal {_goal(name, least)}: the most that these weights' scans reached is {100 * best:.1f}"
    able = [scan for scan in scans if limits.reached_by(scan)]
    goals = " and ".join(_goal(name, least) for name, least in limits.goals.items())
    if not able:
        return f"--goal {goals}: no one scan of these weights reaches all of them; ask for less"
    cheapest = min(able, key=lambda scan: scan.seconds)
    return (
        f"--goal {goals} is not reached within --seconds and --bytes-raw; the cheapest scan that does takes"
        f" {cheapest.seconds:.1f} s and {cheapest.bytes_raw:.4g} bytes ({cheapest.words})"
    )


def _goal(name: str, least: float) -> str:
    return f"{100 * least:g}" if name == MIOU else f"{name}={100 * least:g}"
