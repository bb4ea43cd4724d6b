"""Let several processes write one archive at the same time: ``python tests/faults many_writers``.

The cases are two and four equal surveys, surveys with common first stages, and a survey that is killed while
others wait for its stages.
"""

from __future__ import annotations

import random
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from spectralzoom.storage.store import Archive
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import Nursery
from tests.faults.small_survey import Stored, Subject, prepare, problems, stored, words

OTHER = ("--policy", "sobel")  # shares the coarse pass, the geolocation grid and the mosaic


@dataclass
class Writings:
    """Count the results of simultaneous writers."""

    waited: int = 0  # processes that used a stage of another process
    wrong: list[str] = field(default_factory=list)

    def words(self, rounds: int) -> str:
        """Return the figures as text."""
        return f"{rounds} archives, {self.waited} times one was given what another made; {reported_wrong(self.wrong)}"


def write_together(
    subject: Subject,
    out: Path,
    commands: Sequence[tuple[str, ...]],
    truth: Stored,
    found: Writings,
    chance: random.Random,
    *,
    kill: bool = False,
) -> None:
    """Start surveys at nearly the same time, kill the first one if asked, and check the archive."""
    children = []
    for more in commands:
        children.append(subject.nursery.start(words(out, *more)))
        time.sleep(chance.uniform(0.0, 0.1))
    wrong: list[str] = []
    if kill:
        time.sleep(chance.uniform(0.0, subject.whole_s))
        children[0].kill()
    ended = [child.wait() for child in children]
    given = [one for one in ended if "% cached" in one.text and "% ran" in one.text]  # a stage that it had requested
    found.waited += sum("waiting for another run" in one.text or one in given for one in ended)
    wrong += [f"exit {one.code}: {one.message[-200:]}" for one in ended[int(kill) :] if one.code != 0]
    if kill:
        wrong += [f"killed, but exit {one.code}" for one in ended[:1] if one.code not in (0, -9)]
    wrong += problems(out)
    now = stored(out)
    if now != truth:
        odd = sorted(uri for uri in {*now, *truth} if now.get(uri) != truth.get(uri))
        wrong.append(f"other than undisturbed: {', '.join(odd)}")
    runs = len(Archive.open(out, create=False, write=False).runs())
    good = sum(one.code == 0 for one in ended)
    listed_then_killed = int(kill and ended[0].code != 0)  # the kill may come between the listing and the exit
    if not good <= runs <= good + listed_then_killed:
        wrong.append(f"{runs} runs are listed, {good} ended well")
    found.wrong += wrong
    found.wrong += _left(out, killed=kill)
    shutil.rmtree(out)


def _left(out: Path, *, killed: bool) -> list[str]:
    """Return unfinished folders that are left; those of a killed process are reclaimed first, as by the next run."""
    if killed:
        Archive.open(out).reclaim()
    parts = [path.relative_to(out).as_posix() for path in out.rglob("*.part")]
    spools = [path.relative_to(out).as_posix() for path in (out / "spool").glob("*")]
    return [f"{name} was left" for name in (*parts, *spools)]


def rows(quick: bool = False) -> Iterator[Row]:
    """Yield the rows for two and four equal surveys, for common stages, and for a killed writer."""
    rounds = 1 if quick else 10
    with tempfile.TemporaryDirectory(prefix="writers-") as name, Nursery(Path(name)) as nursery:
        subject = prepare(nursery)
        both = dict(subject.truth)
        other = nursery.run(words(subject.folder / "other", *OTHER))
        assert other.code == 0, other.text
        both |= stored(subject.folder / "other")
        cases: list[tuple[str, str, Sequence[tuple[str, ...]], Stored, bool]] = [
            ("two writers", "the same survey twice at once", ((), ()), subject.truth, False),
            ("four writers", "the same survey four times at once", ((), (), (), ()), subject.truth, False),
            ("shared stages", "two surveys that begin alike at once, each twice", ((), OTHER, (), OTHER), both, False),
            ("a writer killed", "SIGKILL of the first of three at a random moment", ((), (), ()), subject.truth, True),
        ]
        for fault, injected, commands, truth, kill in cases[::3] if quick else cases:
            found = Writings()
            chance = random.Random(0)
            for number in range(rounds):
                out = subject.folder / f"{fault.replace(' ', '-')}-{number}"
                write_together(subject, out, commands, truth, found, chance, kill=kill)
            ended = "every other one exit 0" if kill else "exit 0 each"
            demanded = f"{ended}, one copy of each store, same bytes, a run listed for each, nothing left"
            yield Row(fault, injected, rounds, demanded, found.words(rounds), not found.wrong)
