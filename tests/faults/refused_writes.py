"""Refuse a survey one call of the system, or all from one on: ``python tests/faults refused_writes``.

Rights do not hinder root, so the calls are refused from the inside: whatever changes something in the archive, by
whichever library, counts as a place. Places are drawn at random over a whole survey, each with a random refusal.
"""

from __future__ import annotations

import random
import shutil
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.fault_table import Clock, Row
from tests.faults.injection import errors_by_name, logged_calls
from tests.faults.nursery import Nursery
from tests.faults.small_survey import Subject, prepare, words, wrong_after_fault, wrong_after_rerun

PLACES = 150


@dataclass
class Refusals:
    """What came of refusing."""

    places: int  # calls that a survey makes
    refused: Counter[str] = field(default_factory=Counter)  # by the call's name
    kinds: Counter[str] = field(default_factory=Counter)  # by the error's name
    told: int = 0  # one clear message, exit 1
    done: int = 0  # the survey could do without: exit 0
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """The figures."""
        calls = ", ".join(f"{name} {count}" for name, count in self.refused.most_common())
        kinds = ", ".join(f"{name} {count}" for name, count in self.kinds.most_common())
        return (
            f"{self.told} failed with one message, {self.done} went on without; {len(self.wrong)} wrong"
            f"{': ' + '; '.join(self.wrong[:3]) if self.wrong else ''} (of {self.places} places; {calls}; {kinds})"
        )


def refuse_places(subject: Subject, count: int, seed: int = 0) -> Refusals:
    """Refuse at ``count`` random places, one survey each, and run every survey again without."""
    chance, places = random.Random(seed), len(subject.changing_calls)
    found = Refusals(places)
    for at in _spread(places, count, chance):
        name, lasting = chance.choice(list(errors_by_name())), chance.random() < 0.5
        found.kinds[name] += 1
        _refuse_one(subject, at, name, lasting, found)
    return found


def _spread(places: int, count: int, chance: random.Random) -> list[int]:
    """One random place in each of ``count`` equal parts."""
    return [1 + int((part + chance.random()) * places / count) for part in range(count)]


def _refuse_one(subject: Subject, at: int, name: str, lasting: bool, found: Refusals) -> None:
    out, log = subject.folder / f"refused-{at}", subject.folder / f"refused-{at}.calls"
    ended = subject.nursery.run(
        words(out), "refuse", root=str(out), at=at, number=errors_by_name()[name], lasting=lasting, log=str(log)
    )
    hit = logged_calls(log)
    found.refused[hit[0][1] if hit else "none"] += 1
    found.told += ended.told
    found.done += ended.code == 0
    wrong = wrong_after_fault(subject, out)
    if not hit or not (ended.told or ended.code == 0):
        wrong.append(f"exit {ended.code}, {ended.message[-300:]}")
    again = subject.nursery.run(words(out))
    wrong += wrong_after_rerun(subject, out, again, runs=None if ended.code == 0 else _runs(hit))
    found.wrong += [f"{name} at {at} ({hit[0][1] if hit else 'none'}, {ended.place[-60:]}): {one}" for one in wrong]
    shutil.rmtree(out, ignore_errors=True)
    log.unlink(missing_ok=True)


def _runs(hit: list[tuple[int, str, str]]) -> int | None:
    """How many runs there are after the rerun: one, unless the refusal came when the run was published already."""
    return (
        None if not hit or Path(hit[0][2]).name in ("runs",) or "runs-" in hit[0][2] or "use.lock" in hit[0][2] else 1
    )


def rows(quick: bool = False) -> list[Row]:
    clock, count = Clock(), 12 if quick else PLACES
    with tempfile.TemporaryDirectory(prefix="refused-") as name, Nursery(Path(name)) as nursery:
        found = refuse_places(prepare(nursery), count)
    return [
        Row(
            "writes refused",
            "EACCES, EROFS, EIO, ENOSPC or EDQUOT at a random call that changes the archive, once or from there on",
            count,
            "one message and exit 1, archive verifies, rerun bit-identical",
            found.words(),
            not found.wrong and found.told > count // 2,
            clock.seconds,
        )
    ]
