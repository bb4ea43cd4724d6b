"""Looks at a part of a field: every seat has its line, and no run of lines in the same seconds is worth more."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SettingsError
from pipeline.geometry.camera import LineCamera
from pipeline.geometry.grid import SceneGrid
from pipeline.geometry.scan import Axis, CostModel, exposing
from pipeline.planning.coverage import plain_sweeps, seats_shown
from pipeline.planning.part_looks import SeatRows, cheapest_row_seconds, part_look, sweeps_of_runs

GRID, CAMERA, COST = SceneGrid(320, 416, 16, 4), LineCamera(samples=160), CostModel()
WIDER = LineCamera(samples=240)
EXPOSURE_MS = 5.0


def rows_of(along: Axis = "x", step: int = 2) -> SeatRows:
    """Rows of seats in the sweeps of a scan, three strips of them."""
    return SeatRows.of(plain_sweeps(GRID, CAMERA, along, step=step, exposure_ms=EXPOSURE_MS), GRID, CAMERA)


ROWS = rows_of()
WHOLE_S = COST.seconds(list(ROWS.sweeps), CAMERA)
worths = st.integers(0, 2**32 - 1).map(lambda seed: _patchy(np.random.default_rng(seed)))


def _patchy(rng: np.random.Generator) -> np.ndarray:
    """Worth of the seats, much of it in a few places."""
    worth = rng.random(GRID.seat_shape) * 0.1
    top, left = rng.integers(0, GRID.seat_shape[0] - 4), rng.integers(0, GRID.seat_shape[1] - 4)
    worth[top : top + 4, left : left + 4] += 5 * rng.random()
    return np.asarray(worth.ravel())


@pytest.mark.parametrize("along", ["x", "y"])
@pytest.mark.parametrize("step", [1, 2, 4])
def test_every_seat_is_in_a_row_whose_lines_show_it(along: Axis, step: int) -> None:
    """The lines of a row show the seats of that row, and all rows together the field."""
    rows = rows_of(along, step)
    assert (rows.row[GRID.valid_seats()] >= 0).all()
    for number, place in np.argwhere(rows.there)[:: 7 if step > 1 else 3]:
        run = (int(number), int(rows.first[number, place]), int(rows.stop[number, place]))
        shown = seats_shown(sweeps_of_runs(rows.sweeps, [run]), GRID, CAMERA)
        assert shown[rows.row == number * rows.first.shape[1] + place].all()


@given(worths, st.floats(0.02, 1.2))
def test_no_run_of_the_same_sweep_is_worth_more_in_its_seconds(worth: np.ndarray, share: float) -> None:
    """Each chosen run is worth most of all runs of its sweep that have as many lines or fewer."""
    look = part_look(ROWS, worth, CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=share * WHOLE_S)
    sums = ROWS.sums(worth)
    for number, first, stop in () if look is None else look.runs:
        firsts, stops, values = ROWS.first[number], ROWS.stop[number], sums[number]
        taken = values[(firsts >= first) & (stops <= stop)].sum()
        for begin, end in combinations(range(len(values) + 1), 2):
            if stops[end - 1] - firsts[begin] <= stop - first:
                assert values[begin:end].sum() <= taken * (1 + 1e-9)


@given(worths, st.floats(0.1, 1.0), st.floats(0.1, 4.0))
def test_no_run_of_one_strip_that_ends_in_time_is_worth_more(worth: np.ndarray, share: float, power: float) -> None:
    """Whatever the strip: also where rows are worth the same, and no price of a second divides them."""
    seconds = share * WHOLE_S
    look = part_look(ROWS, worth**power, CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=seconds)
    found = 0.0 if look is None else look.worth
    for number, values in enumerate(ROWS.sums(worth**power)):
        for begin, end in combinations(range(len(values) + 1), 2):
            run = (number, int(ROWS.first[number, begin]), int(ROWS.stop[number, end - 1]))
            if COST.seconds(sweeps_of_runs(ROWS.sweeps, [run]), CAMERA) <= seconds:
                assert values[begin:end].sum() <= found * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("share", [0.66, 0.8, 0.95])
def test_hardly_any_runs_of_two_strips_are_worth_more(seed: int, share: float) -> None:
    """In the same seconds, set-ups included, where one load of the mirror's memory holds all lines."""
    cost, worth = CostModel(vector_pairs=100_000, capture_start_s=0.3), _patchy(np.random.default_rng(seed)) ** 4
    rows = SeatRows.of(plain_sweeps(GRID, WIDER, "x", step=4, exposure_ms=EXPOSURE_MS), GRID, WIDER)
    assert len(rows.sweeps) == 2
    given_s = share * cost.seconds(list(rows.sweeps), WIDER)
    look = part_look(rows, worth, WIDER, cost, exposure_ms=EXPOSURE_MS, seconds=given_s)
    assert look is not None
    sums, setup_s = rows.sums(worth), cost.setup_seconds(exposing(WIDER, rows.sweeps[0]))
    line_s = exposing(WIDER, rows.sweeps[0]).frame_ms * 1e-3
    options = []
    for values, first, stop in zip(sums, rows.first, rows.stop, strict=True):
        pairs = [(begin, end - 1) for begin, end in combinations(range(len(values) + 1), 2)]
        runs = [(setup_s + line_s * (stop[end] - first[begin]), values[begin : end + 1].sum()) for begin, end in pairs]
        options.append(np.array([(0.0, 0.0), *runs]))
    seconds, values = (np.add.outer(options[0][:, one], options[1][:, one]) for one in (0, 1))
    best = values[seconds + cost.reload_s <= given_s + 1e-9].max()
    assert 0.98 * best <= look.worth <= best * (1 + 1e-9)


def test_rows_worth_the_same_are_looked_at_as_far_as_time_goes() -> None:
    """Of a block that the seconds do not pay for as much as they do, and no lines beside it."""
    worth = np.zeros(GRID.seat_shape)
    worth[4:16, 3:6] = 1.0
    look = part_look(ROWS, worth.ravel(), CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=2.2)
    assert look is not None
    shown = seats_shown(sweeps_of_runs(ROWS.sweeps, look.runs), GRID, CAMERA).reshape(GRID.seat_shape)
    assert np.count_nonzero(shown[4:16, 3:6].all(axis=1)) >= 4
    assert not shown[:3].any()
    assert not shown[17:].any()


@pytest.mark.parametrize("along", ["x", "y"])
def test_a_seat_that_two_strips_show_is_of_the_nearer(along: Axis) -> None:
    """By how far its middle lies from the middle of their lines."""
    rows = rows_of(along)
    seats = GRID.valid_seats()
    across = (GRID.seat_origin(seats) + GRID.patch / 2 - np.array([GRID.height, GRID.width]) / 2)[:, "yx".index(along)]
    off = np.abs(across[:, None] - np.array([sweep.strip_px for sweep in rows.sweeps]))
    own = off[np.arange(len(seats)), rows.row[seats] // rows.first.shape[1]]
    assert (own <= off.min(axis=1) + 1).all()  # lines are turned by a pixel at most


@given(worths, st.floats(0.02, 1.2))
def test_looks_end_in_time_and_are_worth_what_they_show(worth: np.ndarray, share: float) -> None:
    """Seconds are those of the cost model, at most those given; the worth is that of the rows the lines show."""
    look = part_look(ROWS, worth, CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=share * WHOLE_S)
    if look is None:
        assert cheapest_row_seconds(ROWS, CAMERA, COST, EXPOSURE_MS) > share * WHOLE_S
        return
    sweeps = sweeps_of_runs(ROWS.sweeps, look.runs)
    assert look.seconds == COST.seconds(sweeps, CAMERA) <= share * WHOLE_S
    assert look.worth <= worth[seats_shown(sweeps, GRID, CAMERA)].sum() * (1 + 1e-9)


@given(worths)
def test_more_seconds_are_worth_no_less(worth: np.ndarray) -> None:
    """And all the seconds of the whole scan buy all that a scan is worth."""
    shares = (0.3, 0.5, 0.7, 0.9, 1.0)
    looks = [part_look(ROWS, worth, CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=one * WHOLE_S) for one in shares]
    found = [0.0 if look is None else look.worth for look in looks]
    assert found == sorted(found)
    assert found[-1] == pytest.approx(ROWS.sums(worth).sum())


def test_what_is_worth_much_is_looked_at_first() -> None:
    """Of a field known but for one block, a look of few seconds is at the lines that show that block."""
    worth = np.zeros(GRID.seat_shape)
    worth[5:8, 3:6] = 1.0
    look = part_look(ROWS, worth.ravel(), CAMERA, COST, exposure_ms=EXPOSURE_MS, seconds=2.5)
    assert look is not None
    assert seats_shown(sweeps_of_runs(ROWS.sweeps, look.runs), GRID, CAMERA)[worth.ravel() > 0].all()
    assert len(look.runs) == 1


@pytest.mark.parametrize(
    ("runs", "told"),
    [
        ([(3, 0, 5)], "look is at sweep 3, the scan has sweeps 0 to 2"),
        ([(0, 0, 100_000)], "lines 0 to 100000 of sweep 0, which has lines 0 to"),
        ([(1, 0, 5), (1, 9, 12)], "names sweep 1 twice"),
    ],
)
def test_lines_that_a_scan_does_not_have_are_refused(runs: list[tuple[int, int, int]], told: str) -> None:
    """With what it has."""
    with pytest.raises(SettingsError, match=told):
        sweeps_of_runs(ROWS.sweeps, runs)
