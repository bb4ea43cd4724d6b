"""A day of 72 real surveys over three fields in turn, with kills, pulled cables and full disks.

The surveys go through an emulated rig behind a pty and sockets, and into an archive on a small disk (a tmpfs). One
process serves, by a clock turned by hand; where it is to be killed, another process serves the same ledgers for that
round, and is killed for good.
"""

from __future__ import annotations

import json
import logging
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from flows.schedule.field_schedule import moment_words
from storage.archive.archive import Archive
from tests.faults.disk_full import can_mount, small_disk
from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT
from tests.flows.schedule.schedule_days import NOON, HandClock
from tests.soak.accounts import Account, Leftovers, Look, clear, problems_of
from tests.soak.pulled_rig import LINK, RigProcess
from tests.soak.resident_memory import Growth, resident_bytes
from tests.soak.serving import FIELDS, Serving, scene_settings, write_fields

HOURS, QUICK_HOURS = 24, 4
TROUBLES = {"kill": 10, "mirror": 3, "camera": 2, "disk": 2}
QUICK_TROUBLES = {"kill": 1, "mirror": 1, "camera": 1, "disk": 1}
DISK_BYTES = 1 << 30
LEFT_BYTES = (1_500_000, 2_600_000)  # of a full disk: lines of the coarse sweep, and of a fine one, go beyond
SPEED = 4.0  # of the rig's clock, at 100 lines a second
AGAIN_S = (5.0, 300.0, 900.0, 4000.0)  # after a kill, until somebody serves again
LOOK_S = 300.0
LONGEST_LIFE_S = 4.0  # of a survey that is killed
DEVICES = {"mirror": f"/{LINK}", "camera": "127.0.0.1:"}  # as a reason names them
CABLE = ("went away", "no connection to", "no answer", "hung up")
FULL = "disk is full"


@dataclass
class Day:
    """What happens, by the number of the run that begins, and what became of it."""

    serving: Serving
    disk: Path
    chance: random.Random
    plan: dict[int, str]
    struck: dict[str, list[tuple[str, datetime]]] = field(default_factory=lambda: defaultdict(list))  # trouble -> runs
    samples: list[int] = field(default_factory=list)  # resident memory of this process after each of its surveys
    told: list[str] = field(default_factory=list)
    spools: dict[str, Look] = field(default_factory=dict)  # name -> the look that it appeared in
    look: tuple[str, datetime] = ("", NOON)  # field and due time of the survey under way, or of the last
    armed: str | None = None

    def __post_init__(self) -> None:
        self.planned = tuple(self.plan.values())

    def tell(self, words: str) -> None:
        """Keep a line, and show it."""
        self.told.append(words)
        print(f"  {self.serving.clock.now():%d %H:%M} {words}", file=sys.stderr, flush=True)

    def live(self, until: datetime) -> None:
        """Serve until a moment."""
        self.serving.before, self.serving.after = self.before, self.after
        while self.serving.clock.now() < until:
            self.free_disk()
            self._put_off()
            if self.serving.is_waiting() and (number := self._next_kill()) is not None:
                self.kill(number)
            else:
                self.serving.run(self.tell)
            self.serving.clock.sleep(LOOK_S)
        self.free_disk()

    def before(self, name: str, due: datetime) -> None:
        """As a survey begins: what is planned for its number."""
        self.look, trouble = (name, due), self.plan.pop(self.serving.begun(), None)
        if trouble in ("mirror", "camera"):
            self.serving.rig.ask("pull", trouble, self.chance.randint(1, 8))
        elif trouble == "disk":
            self._fill(LEFT_BYTES[len(self.struck["disk"]) % len(LEFT_BYTES)])
            self.struck["disk"].append(self.look)
        elif trouble == "kill":  # for a process that may be killed
            self._later("kill")
        self.armed = trouble

    def after(self) -> None:
        """As a survey has ended: cables are put in again, and the process is looked at."""
        self.samples.append(resident_bytes())
        self._look_at_spools(*self.look)
        if self.armed in ("mirror", "camera"):
            if self.serving.rig.ask("plug"):
                self.struck[self.armed].append(self.look)
            else:  # the survey had no line to take any more: another one will
                self._later(self.armed)
        self.armed = None

    def kill(self, number: int) -> None:
        """Have this round served by another process, and kill it in the ``number``-th run of all."""
        now = self.serving.clock.now().isoformat()
        words = [sys.executable, "-m", "tests.soak.serving", str(self.serving.folder), now]
        child = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while child.poll() is None and self.serving.begun() < number:
                time.sleep(0.01)
            life_s = self.chance.uniform(0.0, LONGEST_LIFE_S)
            with suppress(subprocess.TimeoutExpired):
                child.wait(life_s)
        finally:
            child.kill()
            code = child.wait()
        broken = [(name, due) for name, one in self.serving.schedules.items() for due in one.state().open]
        for look in broken:
            self._look_at_spools(*look)
        if code == -signal.SIGKILL and broken:
            self.struck["kill"].append(broken[0])
            self.tell(f"the process that serves is killed {life_s:.2f} s into a run of {broken[0][0]}")
        else:
            self.tell(f"the process that was to be killed was between runs, or had ended ({code})")
            self._later("kill")
        self.serving.clock.sleep(self.chance.choice(AGAIN_S))
        for schedule in self.serving.schedules.values():
            schedule.open()

    def free_disk(self) -> None:
        """Make room on the disk."""
        (self.disk / "ballast").unlink(missing_ok=True)

    def _next_kill(self) -> int | None:
        next_one = self.serving.begun() + 1
        for number in range(next_one, next_one + len(self.serving.fields)):
            if self.plan.get(number) == "kill":
                del self.plan[number]
                return number
            if number in self.plan:  # that is for this process
                return None
        return None

    def _look_at_spools(self, name: str, due: datetime) -> None:
        for path in (self.serving.archive / "spool").glob("*"):
            self.spools.setdefault(path.name, (FIELDS[name], moment_words(due)))

    def _put_off(self) -> None:
        """Have what was planned for runs that a process to be killed got through meanwhile happen later."""
        for number in sorted(self.plan):
            if number <= self.serving.begun():
                self._later(self.plan.pop(number))

    def _later(self, trouble: str) -> None:
        number = self.serving.begun() + 1
        while number in self.plan:
            number += 1
        self.plan[number] = trouble

    def _fill(self, leave: int) -> None:
        state = os.statvfs(self.disk)
        with (self.disk / "ballast").open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, state.f_bavail * state.f_frsize - leave))


def rows(quick: bool) -> list[Row]:
    """The day, and what it left; in a namespace of its own where this process may not mount a small disk."""
    if can_mount():
        return _rows(quick)
    command = ["unshare", "-rm", sys.executable, "-m", "tests.soak.day_of_surveys", *(["--quick"] if quick else [])]
    said = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return [Row(**row) for row in json.loads(said.stdout)]


def _rows(quick: bool) -> list[Row]:
    logging.disable(logging.ERROR)  # the drivers' words on every reset and every cable
    clock = Clock()
    with tempfile.TemporaryDirectory(prefix="soak-day-") as name, small_disk(Path(name) / "disk", DISK_BYTES) as disk:
        day, account = _live(Path(name), disk, quick)
        archive = Archive.open(day.serving.archive)
        before = problems_of(archive)
        left = clear(archive, {(FIELDS[name], visit) for name, visit in account.failed}, day.spools)
        return judged(day, account, left, (before, problems_of(archive)), clock.seconds, quick=quick)


def _live(folder: Path, disk: Path, quick: bool) -> tuple[Day, Account]:
    hours, troubles = (QUICK_HOURS, QUICK_TROUBLES) if quick else (HOURS, TROUBLES)
    kinds = [kind for kind, count in troubles.items() for _ in range(count)]
    chance = random.Random(3)
    with RigProcess(folder, scene_settings(), SPEED) as rig:
        write_fields(folder, disk / "archive", rig.table)
        serving = Serving.of(folder, HandClock())
        numbers = chance.sample(range(2, len(serving.fields) * hours * 5 // 6), len(kinds))
        day = Day(serving, disk, chance, dict(zip(numbers, kinds, strict=True)))
        for schedule in serving.schedules.values():
            schedule.open()
        day.live(NOON + timedelta(hours=hours, minutes=30))
    account = Account()
    for name, schedule in serving.schedules.items():
        schedule.close()
        account.add(name, schedule.ledger.lines(), schedule.timetable.due_between(NOON, NOON + timedelta(hours=hours)))
        account.wrong += [f"{name} {due:%H:%M:%S} is still open" for due in schedule.state().open]
    return day, account


def judged(
    day: Day, account: Account, left: Leftovers, problems: tuple[list[str], list[str]], seconds: float, *, quick: bool
) -> list[Row]:
    """A row for each demand, and whether it was met."""
    wanted, grown, struck = Counter(day.planned), Growth.of(day.samples), day.struck
    disks, refused = account.failed_by(FULL), sum(FULL in words for words in day.told)
    again, gone = account.after_kills(struck["kill"])
    named = {which: sum(account.names(*run, name, CABLE) for run in struck[which]) for which, name in DEVICES.items()}
    pulls = {which: len(struck[which]) for which in DEVICES}
    first = next((one for part in problems for one in part), "")
    whole = f"{len(problems[0])} problems before gc, {len(problems[1])} after{': ' + first if first else ''}"
    return [
        Row(
            "a day of surveys",
            "three fields in turn through an emulated rig, by a clock turned by hand",
            account.due,
            "each due run done, skipped by rule, or failed with a reason",
            account.words(),
            not account.wrong,
            seconds,
        ),
        Row(
            "kills",
            "SIGKILL of the process that serves, within a survey",
            len(struck["kill"]),
            "begun again under the same due time, or failed once the next was due",
            f"of the runs that were killed {again} begun again, {gone} failed for it",
            again + gone == len(struck["kill"]) == wanted["kill"],
            0.0,
        ),
        Row(
            "pulled cables",
            "pty, or the camera's sockets, closed within a capture",
            sum(pulls.values()),
            "failed, and the reason names that device",
            ", ".join(f"{which}: {named[which]} of {pulls[which]} runs" for which in DEVICES),
            all(named[which] == pulls[which] == wanted[which] for which in DEVICES),
            0.0,
        ),
        Row(
            "full disks",
            "the archive's disk (a tmpfs) filled up as a survey begins",
            len(struck["disk"]),
            "failed, or told and resumed, in words that say so",
            f"{disks} failed by it, told {refused} times",
            refused >= len(struck["disk"]) == wanted["disk"],
            0.0,
        ),
        Row("the archive", "verify, before and after gc", 2, "whole", whole, not first, 0.0),
        Row(
            "clearing up",
            "gc --keep-days 0",
            1,
            "what stays is named by a run, or is of a failed one",
            left.words(),
            not left.unexplained,
            0.0,
        ),
        Row(
            "memory",
            "resident, after each survey of the process that serves",
            len(day.samples),
            "not judged: too few" if quick else "last quarter within 5 % of the second",
            grown.words(),
            quick or grown.is_flat,
            0.0,
        ),
    ]


if __name__ == "__main__":
    print(json.dumps([asdict(row) for row in _rows("--quick" in sys.argv)]))
