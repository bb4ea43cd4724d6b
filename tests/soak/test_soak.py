"""How a soak judges: surveys that trouble struck, what may be left, memory that grows, due times of changed clocks."""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import cast

import pytest

from storage.archive.archive import Archive
from tests.soak.day_of_surveys import NOON, Day, judged
from tests.soak.leftovers import Leftovers, clear
from tests.soak.pulled_rig import RigControl
from tests.soak.resident_memory import Growth
from tests.soak.served_week import changed_week, due_between

DUE = [("north", NOON + timedelta(hours=number)) for number in range(4)]
MIRROR, CAMERA = "/rig/mirror went away", "no connection to 127.0.0.1:5000 within 3 s"


@pytest.mark.parametrize(
    ("endings", "missed"),
    [
        (["", MIRROR, CAMERA, ""], []),
        (["its process was gone", MIRROR, CAMERA, ""], ["kills"]),
        (["", MIRROR, MIRROR, ""], ["pulled cables"]),
        (["", "", CAMERA, ""], ["pulled cables"]),
        (["", MIRROR, CAMERA, "the sky fell"], ["a day of surveys"]),
    ],
)
def test_a_day_is_judged_by_the_surveys_that_trouble_struck(
    tmp_path: Path, endings: list[str], missed: list[str]
) -> None:
    """One that was killed must be done in the end, a reason must name the device that was pulled, others are done."""
    struck = {"kill": DUE[:1], "mirror": DUE[1:2], "camera": DUE[2:3]}
    plan = dict(enumerate(struck))
    day = Day(tmp_path, tmp_path, cast(RigControl, None), random.Random(0), plan, samples=[1] * 4)
    day.endings, day.struck = dict(zip(DUE, endings, strict=True)), defaultdict(list, struck)
    left = Leftovers(Counter(), Counter(), [])
    assert [row.fault for row in judged(day, left, ([], []), 0.0, quick=True) if not row.met] == missed


def test_spools_are_left_only_by_looks_that_failed(tmp_path: Path) -> None:
    """A spool of a failed look is explained, one of a look that is done, or of none, is not."""
    archive = Archive.open(tmp_path)
    for name in ("a", "b", "c"):
        (tmp_path / "spool" / name).mkdir(parents=True)
    left = clear(archive, {(1, "first")}, {"a": (1, "first"), "b": (2, "first")})
    assert left.kept["lines under way of a failed run"] == 1
    assert left.unexplained == ["spool/b of (2, 'first')", "spool/c of None"]


def test_memory_that_grows_is_told_from_memory_that_does_not() -> None:
    """The first quarter is warming up; the last is held against the second."""
    flat = Growth.of([*range(0, 100, 10), *[100] * 30])
    rising = Growth.of([1000 + 10 * number for number in range(40)])
    assert flat.is_flat
    assert flat.fraction == 0.0
    assert not rising.is_flat
    assert round(rising.each, 6) == 10.0


@pytest.mark.parametrize(("month", "hours"), [(10, 168), (3, 167)])
def test_due_times_of_changed_clocks(month: int, hours: int) -> None:
    """A doubled hour is due once, one that is left out never; six o'clock comes once a day."""
    first, until = changed_week(datetime(2026, 11, 23, tzinfo=UTC), month)
    assert len(due_between("hourly", first, until)) == hours
    daily = due_between("daily", first, until)
    assert len(daily) == 7
    assert {due.hour for due in daily} == {4, 5}
    assert first <= datetime(2026, month, 25 if month == 10 else 29, 1, tzinfo=UTC) < until
