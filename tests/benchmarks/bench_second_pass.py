"""Compare the second pass with free swaths, and with a spacing and exposure for each row of patches.

Each survey of `bench_regimes` stops after its first pass, with the plan of the second one. Free swaths are moved by
whole patches, and take every line of a run. Rows with a spacing and exposure of their own are compared with the best
single pair. Both are bounds without set-up times. `python tests/benchmarks second_pass` takes seven minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from unittest import mock

import numpy as np
from bench_regimes import SWATHS, asked, land, scenes
from measure import Row
from numpy.typing import NDArray
from rich.console import Console

from flows.survey_command import run_survey
from pipeline.geometry.scan import exposing, merged_ms
from pipeline.planning.fine_pass import FinePlan, SecondPass
from pipeline.planning.uniform_scans import ScanPerformance

CASES = ((1.0, 22.1, 1 / 16), (1.0, 22.1, 1 / 8), (0.25, 58.2, 1 / 8))  # light, seconds, fraction of interest
FARMS = (61, 62, 63, 71, 72, 73)
SHAPE = (512, 640)
EXPOSURES = 15  # of a row
Gains = Callable[[int, float], NDArray[np.float64]]
best = SecondPass.best


class Planned(BaseException):
    """The second pass is planned: expected gains [points] of the plan, of free swaths, of one pair and own pairs."""


def compare(second: SecondPass, record: ScanPerformance, gain_of: Gains) -> FinePlan:
    """Raise Planned in place of the capture."""
    moved = []
    for shift in range(0, second.camera.samples, second.grid.patch):
        full = [replace(one, swath_px=one.swath_px + shift) for one in second.full]
        full = [replace(full[0], swath_px=full[0].swath_px - second.camera.samples), *full]
        moved.append(best(replace(second, full=full, margin_px=1e-9), record, gain_of).expected_gain)
    first, (shortest, longest) = second.first_pass[0], record.offered_ms(second.camera)
    first_ms = exposing(second.camera, first).exposure_ms
    gains, times = [], []
    for step in (1, 2):
        for exposure_ms in np.geomspace(shortest, longest, EXPOSURES):
            mean_ms = merged_ms((first_ms, exposure_ms), (step, first.step - step))
            gains.append(
                second.rows.sums(np.fmax(gain_of(step, float(np.clip(mean_ms, shortest, longest))), 0)).ravel()
            )
            line_s = replace(second.camera, exposure_ms=float(exposure_ms)).frame_ms * 1e-3
            times.append(second.grid.patch * (1 / step - 1 / first.step) * line_s)
    table, price = np.array(gains), np.array(times)[:, None]
    single = max(bound(table[[one]], price[[one]], second.seconds) for one in range(len(table)))
    found = (best(second, record, gain_of).expected_gain, max(moved), single, bound(table, price, second.seconds))
    raise Planned(*(100 * one for one in found))


def bound(gains: NDArray[np.float64], times: NDArray[np.float64], seconds: float) -> float:
    """Return the largest sum of (choice, row) gains in the time, by Lagrange's dual; it is an upper bound."""

    def dual(price: float) -> float:
        return float(np.fmax((gains - price * times).max(axis=0), 0).sum() + price * seconds)

    return min(map(dual, np.geomspace(1e-9, 1e3, 2000)))


def rows() -> list[Row]:
    """Return a row for each field: the plan's expected gain, and how much more the other ways expect."""
    found = []
    for light, seconds, share in CASES:
        for farm in FARMS:
            given = mock.patch.object(scenes, "built_in_scene", return_value=land(farm, SHAPE, share)[0])
            with tempfile.TemporaryDirectory() as out, given, mock.patch.object(SecondPass, "best", compare):
                try:
                    run_survey(asked(farm, light, SWATHS, seconds, "always", out), Console(quiet=True))
                except Planned as planned:
                    plan, free, single, own = planned.args
            words = f"free swaths {free - plan:+.2f}; own spacing and exposure at most {own - single:+.2f}"
            found.append(
                Row(f"light {light:g}, {seconds:g} s, share {share:g}, farm {farm}", f"{plan:.2f}", "", None, words)
            )
    return found
