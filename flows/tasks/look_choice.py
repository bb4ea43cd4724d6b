"""What of a remembered field a visit looks at: the lines that promise most there, and those that are due."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flows.settings.survey_settings import Settings
from flows.settings.values import LOOK_PART, LOOK_WHOLE, look_words
from flows.tasks.capture_plan import lay_out_sweeps
from flows.tasks.memory import Prior
from models.reading.doubts import SeatDoubts
from models.reading.remembered import COME_TRUE, Belief, Remembered, carried, in_classes
from models.weights.files import Description, load_reader
from pipeline.errors import BudgetError, NothingToMend, SettingsError, WeightsError
from pipeline.geometry.grid import SceneGrid
from pipeline.planning.coverage import seats_shown
from pipeline.planning.part_looks import PartLook, SeatRows, cheapest_row_seconds, part_look, sweeps_of_runs
from pipeline.planning.plain_scans import LOSS, MIOU, ScanRecord, exposures_between, scan_words
from storage.arrays.class_maps import BeliefStore

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
STRIP_SEATS = 4  # rows of seats of a belief that are read at a time
POORER = 0.05  # of mIoU below the best scan of the record: poorer looks spoil what is remembered better
DUE = 1e3  # times what looks at all of a field can gain: what is due comes first


@dataclass(frozen=True)
class LookChoice:
    """The part of a field that a visit looks at, and why."""

    seconds: float
    expected_gain: float  # of mIoU, 0..1, by doubts of which rare classes have most: rather too much
    expected_wrong: float  # share of the remembered pixels, before the look
    due: int  # seats that had to be seen again
    due_left: int  # of these, those that the seconds did not pay for

    @property
    def sentence(self) -> str:
        """What was chosen, for who asked."""
        seen = self.due - self.due_left
        due = f"; {seen} of the {self.due} seats that were due are among them" if self.due else ""
        return (
            f"looks, in {self.seconds:.1f} s, where most is to be mended: about {self.expected_wrong:.1%} of what is"
            f" remembered is expected to be wrong{due}"
        )


@dataclass(frozen=True)
class LookWorth:
    """What looks at the seats of a field are worth."""

    record: ScanRecord
    class_names: tuple[str, ...]
    doubts: SeatDoubts
    due: Mask  # (seat,)
    shown: Mask  # (seat,) that may be looked at

    def gains(self, step: int, exposure_ms: float) -> Floats:
        """What a look at each seat adds to the mIoU, (seat,)."""
        expected = self.record.expected(step, exposure_ms)
        iou = np.array([expected.get(name, expected[MIOU]) for name in self.class_names])
        return np.where(self.shown, self.doubts.worth((1 - iou) / (1 + iou)), 0.0)

    def worth(self, gains: Floats) -> Floats:
        """The same with what is due before all else; where nothing is gained, the longer ago the more."""
        worth = gains + np.where(self.due, DUE * max(float(gains.sum()), LOSS), 0.0)
        if worth.any():
            return worth
        return np.where(self.shown, LOSS * (1 + np.nan_to_num(self.doubts.age_days, posinf=1e6)), 0.0)


def choose_look(
    settings: Settings,
    prior: Prior | None,
    weights: Description,
    path: Path,
    grid: SceneGrid,
    shown: Mask | None = None,
) -> tuple[Settings, LookChoice | None, tuple[str, ...]]:
    """Settings with the lines that a visit takes of a field that is remembered, the choice, and what to say of it.

    Lines are wanted of the ``shown`` (seat,) seats, of all where it is None. Without a memory the whole field is looked
    at. Raises NothingToMend: it is remembered as surely as was asked for, and nothing is due; WeightsError: the weights
    have no record of scans; BudgetError: no line of any scan ends in time, with the least that does; PoseError: the
    field is beyond the mirror's range.
    """
    if settings.look != LOOK_PART:
        return settings, None, ()
    if prior is None:
        whole = replace(settings, look=LOOK_WHOLE, refresh=None, doubt=None)  # as it can be asked for again
        return whole, None, ("nothing is remembered: the whole field is looked at",)
    content = weights.record.get("scans")
    if content is None:
        raise WeightsError(
            f"the weights {path.name} have no record of plain scans, by which a part of a field is chosen: leave --look"
            " out, or train weights with --darkest-ms 3, some scenes kept for validation"
        )
    there = grid.valid_share().ravel() > 0 if shown is None else shown
    strips, classes = _strips(prior, grid, weights, path), len(weights.class_names)
    doubts = SeatDoubts.of(strips, grid, classes, come_true=1.0 if weights.reader is None else COME_TRUE)
    wanted = LookWorth(
        ScanRecord.read(content), weights.class_names, doubts, there & _is_due(settings, prior, doubts), there
    )
    if settings.doubt is not None and doubts.expected_wrong() < settings.doubt and not wanted.due.any():
        raise NothingToMend(
            prior.run,
            f"nothing is looked at: {doubts.expected_wrong():.1%} of what is remembered is expected to be wrong, and a "
            f"look is asked for from {settings.doubt:.1%} on; the map of {prior.run} stands",
        )
    step, exposure_ms, look = _best_look(settings, grid, wanted, shown)
    chosen = replace(settings, look=look_words(look.runs), scan_step=step, scan_exposure_ms=exposure_ms)
    sweeps = sweeps_of_runs(lay_out_sweeps(replace(chosen, look=LOOK_WHOLE), grid, shown)[1], look.runs)
    seen = seats_shown(sweeps, grid, settings.camera)
    choice = LookChoice(
        seconds=look.seconds,
        expected_gain=float(wanted.gains(step, exposure_ms)[seen].sum()),
        expected_wrong=doubts.expected_wrong(),
        due=int(np.count_nonzero(wanted.due)),
        due_left=int(np.count_nonzero(wanted.due & ~seen)),
    )
    return chosen, choice, (f"{choice.sentence} ({scan_words(step, exposure_ms)})",)


def _best_look(
    settings: Settings, grid: SceneGrid, wanted: LookWorth, shown: Mask | None
) -> tuple[int, float, PartLook]:
    """Step, exposure and lines of the look worth most, the cheapest of those that are as good but for `LOSS`."""
    record, camera, cost, seconds = wanted.record, settings.camera, settings.cost, settings.seconds
    assert seconds is not None  # checked with the settings
    found: list[tuple[int, float, PartLook]] = []
    least: list[float] = []
    enough = float(record.scores[MIOU].max()) - POORER
    shortest, longest = record.exposures_ms[0], min(camera.exposure_ms, record.exposures_ms[-1])
    for step in record.steps:
        whole = replace(settings, look=LOOK_WHOLE, scan_step=step, scan_exposure_ms=None)
        rows = SeatRows.of(lay_out_sweeps(whole, grid, shown)[1], grid, camera)
        for exposure_ms in exposures_between(shortest, longest):
            if record.expected(step, exposure_ms)[MIOU] < enough:
                continue
            worth = wanted.worth(wanted.gains(step, exposure_ms))
            look = part_look(rows, worth, camera, cost, exposure_ms=exposure_ms, seconds=seconds)
            found += [] if look is None else [(step, exposure_ms, look)]
            least.append(cheapest_row_seconds(rows, camera, cost, exposure_ms))
    if not least:
        raise SettingsError(
            f"camera.exposure_ms = {camera.exposure_ms:g}: no scan of so short exposures is good enough for a part of a"
            " field; leave --look out"
        )
    if not found:
        raise BudgetError(
            f"--seconds {seconds:g}: no look at any part of the field ends in time; the least takes {min(least):.1f} s"
        )
    best = max(look.worth for _, _, look in found)
    near = [one for one in found if one[2].worth >= best - LOSS]
    return min(near, key=lambda one: (one[2].seconds, -one[2].worth))


def _is_due(settings: Settings, prior: Prior, doubts: SeatDoubts) -> Mask:
    """(seat,) that would be older than `--refresh` allows if this visit did not look, nor the next as long after it."""
    if settings.refresh is None:
        return np.zeros(len(doubts.age_days), np.bool_)
    return np.asarray(doubts.age_days + prior.days > settings.refresh)


def _strips(
    prior: Prior, grid: SceneGrid, weights: Description, path: Path
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """What is believed of a field today if nobody looks, and how old that is, some rows of seats at a time."""
    store, high = BeliefStore(prior.belief.path / "belief.zarr"), STRIP_SEATS * grid.patch
    read = None if weights.reader is None else load_reader(path)
    for top in range(0, grid.height, high):
        belief, age, light = store.read(slice(top, min(top + high, grid.height)))
        before = Belief(in_classes(belief, prior.classes), age, light)
        today = carried(Remembered(before, None, prior.days), read)
        yield today.log_probability, today.age_days
