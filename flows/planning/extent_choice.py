"""Choose the lines of a partial scan of a field with a prior map: by expected gain and by age."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spectralzoom.flows.frame import Prior
from spectralzoom.flows.planning.capture_plan import PassLayout
from spectralzoom.flows.settings.values import format_extent
from spectralzoom.flows.terminal.figures import format_percent
from spectralzoom.models.reading.expected_errors import Floats, PatchExpectedErrors
from spectralzoom.models.reading.prior_map import (
    COME_TRUE,
    EVERY_PX,
    HALO,
    ClassProbabilities,
    PriorMap,
    carried,
    in_classes,
)
from spectralzoom.models.weights.files import Description, load_reader
from spectralzoom.pipeline.errors import BudgetError, SettingsError, WeightsError
from spectralzoom.pipeline.geometry.grid import SceneGrid, cuts
from spectralzoom.pipeline.planning.coverage import patches_shown
from spectralzoom.pipeline.planning.partial_scans import (
    PartialScan,
    PatchRows,
    RunTimes,
    cheapest_row_seconds,
    choose_runs,
    sweeps_of_runs,
)
from spectralzoom.pipeline.planning.uniform_scans import LOSS, MIOU, ScanPerformance, exposures_between, format_scan
from spectralzoom.storage.arrays.class_maps import ProbabilityStore

Mask = NDArray[np.bool_]
SWATH_PATCHES = 4  # rows of patches whose class probabilities are read at a time
WHOLE = "--extent whole --scan-step N without --seconds"
POORER = 0.05  # mIoU below the best scan: poorer scans would degrade the prior map
DUE = 1e3  # gain of a patch that is too old: that of all others together is at most 1


@dataclass(frozen=True)
class ExtentChoice:
    """Partial scan of a visit, and its reasons."""

    seconds: float
    expected_gain: float  # of mIoU, 0..1; overestimated for rare classes
    expected_wrong: float  # fraction of the pixels of the prior map
    due: int  # patches that are too old
    due_left: int  # of these, patches without time


@dataclass(frozen=True)
class ExtentGains:
    """Expected gains of capturing the patches of a field."""

    record: ScanPerformance
    class_names: tuple[str, ...]
    expected_errors: PatchExpectedErrors
    due: Mask  # (patch,)
    shown: Mask  # (patch,) that may be captured

    def gains(self, step: int, exposure_ms: float) -> Floats:
        """Return the expected gain in mIoU of each patch, (patch,)."""
        rates = self.record.error_rates(step, exposure_ms, self.class_names)
        return np.where(self.shown, self.expected_errors.expected_gain(rates), 0.0)

    def expected_gain(self, gains: Floats) -> Floats:
        """Return gains with patches that are too old first; without any gain, older patches first."""
        expected_gain = gains + np.where(self.due, DUE, 0.0)
        if expected_gain.any():
            return expected_gain
        return np.where(self.shown, LOSS * (1 + np.nan_to_num(self.expected_errors.age_days, posinf=1e6)), 0.0)


def choose_extent(
    layout: PassLayout,
    prior: Prior,
    weights: Description,
    path: Path,
    law: str,
    light_fraction: float,
    *,
    seconds: float,
    max_age: float | None,
    left_out: Mask | None = None,
    scored: bool = True,
) -> tuple[PassLayout, ExtentChoice, str]:
    """Choose the lines of a partial scan within a time; return their layout, the choice, and a sentence.

    Patches that would become older than ``max_age`` days come first. Pixels of ``left_out`` (y, x) are not of interest:
    they lie outside of zones or have no data. The sentence has the expected errors only if ``scored``.
    Raises WeightsError: the weights have no scan performance table; BudgetError: no line fits the time; names the least
    time; PoseError: the field exceeds the mirror's range.
    """
    content = weights.scans(law)
    if content is None:
        raise WeightsError(
            f"the weights {path.name} have no record of uniform scans to choose a part of the field by: capture all of "
            f"it ({WHOLE}), or train weights with --min-exposure-ms 3 and validation scenes"
        )
    expected_errors = PatchExpectedErrors.of(
        _swaths(prior, layout.grid, weights, path),
        layout.grid,
        len(weights.class_names),
        come_true=1.0 if weights.reader is None else COME_TRUE,
        left_out=left_out,
    )
    available = np.asarray(expected_errors.pixels.any(axis=(1, 2)))
    if layout.shown is not None:
        available = available & layout.shown
    due = np.zeros(len(expected_errors.age_days), np.bool_)
    if max_age is not None:  # after an equally long time without a capture
        due = np.asarray(expected_errors.age_days + prior.days > max_age)
    record = ScanPerformance.read(content, light_fraction)
    extent_gains = ExtentGains(record, weights.class_names, expected_errors, available & due, available)
    wrong = expected_errors.expected_wrong()
    free = replace(layout, recorded=None)
    step, exposure_ms, extent = _best_extent(free, extent_gains, seconds)
    captured = patches_shown(
        sweeps_of_runs(free.uniform(step, exposure_ms).sweeps()[1], extent.runs), layout.grid, layout.camera
    )
    choice = ExtentChoice(
        seconds=extent.seconds,
        expected_gain=float(extent_gains.gains(step, exposure_ms)[captured].sum()),
        expected_wrong=wrong,
        due=int(np.count_nonzero(extent_gains.due)),
        due_left=int(np.count_nonzero(extent_gains.due & ~captured)),
    )
    chosen = replace(layout, extent=format_extent(extent.runs), step=step, exposure_ms=exposure_ms)
    aged = f"; patches beyond --max-age: {choice.due - choice.due_left} of {choice.due} included" if choice.due else ""
    what = f"captures the lines of highest expected gain, {format_scan(step, exposure_ms)}, in {choice.seconds:.1f} s"
    own = f"; by its own probabilities, the prior map is wrong at {format_percent(wrong)} of its pixels"
    sentence = f"{what}{own if scored else ''}{aged}"
    return chosen, choice, sentence


def _best_extent(layout: PassLayout, extent_gains: ExtentGains, seconds: float) -> tuple[int, float, PartialScan]:
    """Return step, exposure and lines of the scan with the highest gain, or of the cheapest within `LOSS` of it."""
    found: list[tuple[int, float, PartialScan]] = []
    least: list[float] = []
    enough = float(extent_gains.record.scores[MIOU].max()) - POORER
    shortest, longest = extent_gains.record.offered_ms(layout.camera)
    for step in extent_gains.record.steps:
        rows = PatchRows.of(layout.uniform(step).sweeps()[1], layout.grid, layout.camera)
        for exposure_ms in exposures_between(shortest, longest):
            if extent_gains.record.expected(step, exposure_ms)[MIOU] < enough:
                continue
            expected_gain = extent_gains.expected_gain(extent_gains.gains(step, exposure_ms))
            times = RunTimes.of_scan(rows.sweeps, layout.camera, layout.cost, exposure_ms)
            extent = choose_runs(rows, expected_gain, times, seconds=seconds)
            found += [] if extent is None else [(step, exposure_ms, extent)]
            least.append(cheapest_row_seconds(rows, expected_gain, layout.camera, layout.cost, exposure_ms))
    if not least:
        raise SettingsError(
            f"camera.exposure_ms = {layout.camera.exposure_ms:g} is too short for a partial scan; give a longer one, or"
            f" capture all of the field ({WHOLE})"
        )
    if not found:
        raise BudgetError(
            f"--seconds {seconds:g} is below the minimum scan time of {min(least) + 0.005:.2f} s; give at least that"
        )
    best = max(extent.expected_gain for _, _, extent in found)
    near = [one for one in found if one[2].expected_gain >= best - LOSS]
    return min(near, key=lambda one: (one[2].seconds, -one[2].expected_gain))


def _swaths(
    prior: Prior, grid: SceneGrid, weights: Description, path: Path
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Yield class probabilities of the prior map at the time of the visit, and their ages, in blocks of rows.

    Probabilities are those of the nearest pixel among every second row and column.
    """
    store = ProbabilityStore(prior.probabilities.path / "class_probabilities.zarr")
    read = None if weights.reader is None else load_reader(path, weights)
    across = np.arange(grid.width) // EVERY_PX
    for rows in cuts(grid.height, SWATH_PATCHES * grid.patch):
        first, last = max(rows.start - EVERY_PX * HALO, 0), min(rows.stop + EVERY_PX * HALO, grid.height)
        probabilities, age, light = store.read(slice(first, last))
        probabilities = in_classes(probabilities, prior.classes, weights.config.untaught)
        sampled = (part[::EVERY_PX, ::EVERY_PX] for part in (probabilities, age, light))
        today = carried(PriorMap(ClassProbabilities(*sampled), None, prior.days, prior.day_of_year), read)
        own = np.arange(rows.start, rows.stop) - first
        yield today.log_probability[own[:, None] // EVERY_PX, across], age[own] + np.float32(prior.days)
