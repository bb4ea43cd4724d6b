"""Choice of the part of a field with a prior map that a visit looks at: lines by expected gain, and those due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.settings.values import format_extent
from flows.tasks.capture_plan import PassLayout
from flows.tasks.prior_maps import Prior
from models.reading.expected_errors import PatchExpectedErrors
from models.reading.prior_map import COME_TRUE, ClassProbabilities, PriorMap, carried, in_classes
from models.weights.files import Description, load_reader
from pipeline.errors import BudgetError, NothingToMend, SettingsError, WeightsError
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import patches_shown
from pipeline.planning.partial_scans import PartialScan, PatchRows, cheapest_row_seconds, partial_scan, sweeps_of_runs
from pipeline.planning.uniform_scans import LOSS, MIOU, ScanPerformance, exposures_between, format_scan
from storage.arrays.class_maps import ProbabilityStore

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
SWATH_PATCHES = 4  # rows of patches whose class probabilities are read at a time
POORER = 0.05  # of mIoU below the best scan of the record: poorer looks spoil what is remembered better
DUE = 1e3  # times what looks at all of a field can gain: what is due comes first


@dataclass(frozen=True)
class ExtentChoice:
    """The part of a field that a visit looks at, and why."""

    seconds: float
    expected_gain: float  # of mIoU, 0..1, by expected errors of which rare classes have most: rather too much
    expected_wrong: float  # fraction of the remembered pixels, before the look
    due: int  # patches that had to be seen again
    due_left: int  # of these, those that the seconds did not pay for

    @property
    def sentence(self) -> str:
        """Return what was chosen, for who asked."""
        seen = self.due - self.due_left
        due = f"; {seen} of the {self.due} patches that were due are among them" if self.due else ""
        return (
            f"looks, in {self.seconds:.1f} s, where most is to be mended: about {self.expected_wrong:.1%} of what is"
            f" remembered is expected to be wrong{due}"
        )


@dataclass(frozen=True)
class ExtentGains:
    """Expected gains of looks at the patches of a field."""

    record: ScanPerformance
    class_names: tuple[str, ...]
    expected_errors: PatchExpectedErrors
    due: Mask  # (patch,)
    shown: Mask  # (patch,) that may be looked at

    def gains(self, step: int, exposure_ms: float) -> Floats:
        """Return what a look at each patch adds to the mIoU, (patch,)."""
        expected = self.record.expected(step, exposure_ms)
        iou = np.array([expected.get(name, expected[MIOU]) for name in self.class_names])
        return np.where(self.shown, self.expected_errors.expected_gain((1 - iou) / (1 + iou)), 0.0)

    def expected_gain(self, gains: Floats) -> Floats:
        """The same with what is due before all else; where nothing is gained, the longer ago the more."""
        expected_gain = gains + np.where(self.due, DUE * max(float(gains.sum()), LOSS), 0.0)
        if expected_gain.any():
            return expected_gain
        return np.where(self.shown, LOSS * (1 + np.nan_to_num(self.expected_errors.age_days, posinf=1e6)), 0.0)


def choose_extent(
    layout: PassLayout,
    prior: Prior,
    weights: Description,
    path: Path,
    light_fraction: float,
    *,
    seconds: float,
    max_age: float | None,
    skip_below_error: float | None,
) -> tuple[PassLayout, ExtentChoice, str]:
    """Choose the lines that a visit takes of a field that is remembered, in so many seconds; say why.

    Gives the layout of these lines, the choice, and a sentence. Patches that would be older than ``max_age`` days come
    first. Raises NothingToMend: less than ``skip_below_error`` of what is remembered is expected to be wrong, and
    nothing is due; WeightsError: the weights have no record of scans; BudgetError: no line of any scan ends in time,
    with the least that does; PoseError: the field is beyond the mirror's range.
    """
    content, grid = weights.record.get("scans"), layout.grid
    if content is None:
        raise WeightsError(
            f"the weights {path.name} have no record of uniform scans, by which a part of a field is chosen: leave "
            "--extent out, or train weights with --min-exposure-ms 3, some scenes kept for validation"
        )
    there = grid.valid_fraction().ravel() > 0 if layout.shown is None else layout.shown
    swaths, classes = _swaths(prior, grid, weights, path), len(weights.class_names)
    expected_errors = PatchExpectedErrors.of(
        swaths, grid, classes, come_true=1.0 if weights.reader is None else COME_TRUE
    )
    due = np.zeros(len(expected_errors.age_days), np.bool_)
    if max_age is not None:  # older than allowed if this visit did not look, nor the next as long after it
        due = np.asarray(expected_errors.age_days + prior.days > max_age)
    record = ScanPerformance.read(content, light_fraction)
    wanted = ExtentGains(record, weights.class_names, expected_errors, there & due, there)
    if skip_below_error is not None and expected_errors.expected_wrong() < skip_below_error and not wanted.due.any():
        raise NothingToMend(
            prior.run,
            f"nothing is looked at: {expected_errors.expected_wrong():.1%} of what is remembered is expected to be "
            f"wrong, and a look is asked for from {skip_below_error:.1%} on; the map of {prior.run} stands",
        )
    free = replace(layout, recorded=None)
    step, exposure_ms, extent = _best_extent(free, wanted, seconds)
    seen = patches_shown(sweeps_of_runs(free.uniform(step, exposure_ms).sweeps()[1], extent.runs), grid, layout.camera)
    choice = ExtentChoice(
        seconds=extent.seconds,
        expected_gain=float(wanted.gains(step, exposure_ms)[seen].sum()),
        expected_wrong=expected_errors.expected_wrong(),
        due=int(np.count_nonzero(wanted.due)),
        due_left=int(np.count_nonzero(wanted.due & ~seen)),
    )
    chosen = replace(layout, extent=format_extent(extent.runs), step=step, exposure_ms=exposure_ms)
    return chosen, choice, f"{choice.sentence} ({format_scan(step, exposure_ms)})"


def _best_extent(layout: PassLayout, wanted: ExtentGains, seconds: float) -> tuple[int, float, PartialScan]:
    """Step, exposure and lines of the look worth most, the cheapest of those that are as good but for `LOSS`."""
    record, camera, cost = wanted.record, layout.camera, layout.cost
    found: list[tuple[int, float, PartialScan]] = []
    least: list[float] = []
    enough = float(record.scores[MIOU].max()) - POORER
    shortest, longest = record.offered_ms(camera)
    for step in record.steps:
        rows = PatchRows.of(layout.uniform(step).sweeps()[1], layout.grid, camera)
        for exposure_ms in exposures_between(shortest, longest):
            if record.expected(step, exposure_ms)[MIOU] < enough:
                continue
            expected_gain = wanted.expected_gain(wanted.gains(step, exposure_ms))
            extent = partial_scan(rows, expected_gain, camera, cost, exposure_ms=exposure_ms, seconds=seconds)
            found += [] if extent is None else [(step, exposure_ms, extent)]
            least.append(cheapest_row_seconds(rows, camera, cost, exposure_ms))
    if not least:
        raise SettingsError(
            f"camera.exposure_ms = {camera.exposure_ms:g}: no scan of so short exposures is good enough for a part of a"
            " field; leave --extent out"
        )
    if not found:
        raise BudgetError(
            f"--seconds {seconds:g}: no look at any part of the field ends in time; the least takes {min(least):.1f} s"
        )
    best = max(extent.expected_gain for _, _, extent in found)
    near = [one for one in found if one[2].expected_gain >= best - LOSS]
    return min(near, key=lambda one: (one[2].seconds, -one[2].expected_gain))


def _swaths(
    prior: Prior, grid: SceneGrid, weights: Description, path: Path
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Yield class probabilities of a field without a capture today, and their ages, some rows of patches at a time."""
    store, high = ProbabilityStore(prior.probabilities.path / "class_probabilities.zarr"), SWATH_PATCHES * grid.patch
    read = None if weights.reader is None else load_reader(path)
    for top in range(0, grid.height, high):
        probabilities, age, light = store.read(slice(top, min(top + high, grid.height)))
        before = ClassProbabilities(in_classes(probabilities, prior.classes), age, light)
        today = carried(PriorMap(before, None, prior.days), read)
        yield today.log_probability, today.age_days
