"""A day of 72 real surveys over three fields in turn, with kills, pulled cables and full disks.

The surveys go through an emulated rig behind a pty and sockets, and into an archive on a small disk (a tmpfs). Each is
a visit of its due time, in this process; where one is to be killed, another process begins it, and this one again.
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
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pipeline.errors import PipelineError
from storage.archive.archive import Archive
from tests.faults.disk_full import can_mount, small_disk
from tests.faults.fault_table import Clock, Row
from tests.faults.nursery import ROOT
from tests.soak.leftovers import Leftovers, Survey, clear, problems_of
from tests.soak.pulled_rig import LINK, RigControl, RigProcess
from tests.soak.resident_memory import Growth, resident_bytes
from tests.soak.serving import FIELDS, scene_settings, survey_due, write_fields

Due = tuple[str, datetime]  # field and due time
NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)
HOURS, QUICK_HOURS = 24, 4
TROUBLES = {"kill": 10, "mirror": 3, "camera": 2, "disk": 2}
QUICK_TROUBLES = {"kill": 1, "mirror": 1, "camera": 1, "disk": 1}
DISK_BYTES = 1 << 30
LEFT_BYTES = (1_500_000, 2_600_000)  # of a full disk: lines of the coarse sweep, and of a fine one, go beyond
SPEED = 4.0  # of the rig's clock, at 100 lines a second
LONGEST_LIFE_S = 4.0  # of a survey that is killed
DEVICES = {"mirror": f"/{LINK}", "camera": "127.0.0.1:"}  # as a reason names them
CABLE = ("went away", "no connection to", "no answer", "hung up")
FULL = "disk is full"


@dataclass
class Day:
    """What happens, by the number of the survey that begins, and what became of it."""

    folder: Path
    disk: Path
    rig: RigControl
    chance: random.Random
    plan: dict[int, str]
    endings: dict[Due, str] = field(default_factory=dict)  # "" of a survey that is done, else why it failed
    struck: dict[str, list[Due]] = field(default_factory=lambda: defaultdict(list))  # trouble -> surveys
    samples: list[int] = field(default_factory=list)  # resident memory of this process after each of its surveys
    spools: dict[str, Survey] = field(default_factory=dict)  # name -> the look that it appeared in

    def __post_init__(self) -> None:
        self.planned = tuple(self.plan.values())

    @property
    def archive(self) -> Path:
        """Folder of the archive."""
        return self.disk / "archive"

    def live(self, hours: int) -> None:
        """Survey the fields in turn, every hour."""
        dues = [(name, NOON + timedelta(hours=hour)) for hour in range(hours) for name in FIELDS]
        for number, due in enumerate(dues, 1):
            trouble = self.plan.pop(number, None)
            self.rig.ask("scan_pass", due[0])
            if trouble == "kill" and not self.kill(due):
                self._later(number, trouble)
            if trouble in DEVICES:
                self.rig.ask("pull", trouble, self.chance.randint(1, 8))
            if trouble == "disk":
                self._fill(LEFT_BYTES[len(self.struck["disk"]) % len(LEFT_BYTES)])
                self.struck["disk"].append(due)
            self.endings[due] = self.survey(due)
            if trouble in DEVICES:
                if self.rig.ask("plug"):
                    self.struck[trouble].append(due)
                else:  # the survey had no line to take any more: another one will
                    self._later(number, trouble)
            (self.disk / "ballast").unlink(missing_ok=True)
            print(f"  {due[0]} {due[1]:%H:%M} {self.endings[due] or 'done'}", file=sys.stderr, flush=True)

    def survey(self, due: Due) -> str:
        """Survey in this process; gives why it failed, nothing where it did not."""
        try:
            survey_due(self.folder, *due)
        except PipelineError as error:
            return str(error) or type(error).__name__
        finally:
            self.samples.append(resident_bytes())
            self._check_spools(*due)
        return ""

    def kill(self, due: Due) -> bool:
        """Kill a process within this survey; False where it had ended before."""
        words = [sys.executable, "-m", "tests.soak.serving", str(self.folder), due[0], due[1].isoformat()]
        known, begun = len(Archive.open(self.archive).runs()), set((self.archive / "spool").glob("*"))
        child = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while child.poll() is None and set((self.archive / "spool").glob("*")) <= begun:  # until it captures
                time.sleep(0.01)
            with suppress(subprocess.TimeoutExpired):
                child.wait(self.chance.uniform(0.0, LONGEST_LIFE_S))
        finally:
            child.kill()
            code = child.wait()
        self._check_spools(*due)
        if code != -signal.SIGKILL or len(Archive.open(self.archive).runs()) > known:
            return False
        print(f"  {due[0]} {due[1]:%H:%M} is killed", file=sys.stderr, flush=True)
        self.struck["kill"].append(due)
        return True

    def _check_spools(self, name: str, due: datetime) -> None:
        for path in (self.archive / "spool").glob("*"):
            self.spools.setdefault(path.name, survey_of(name, due))

    def _later(self, number: int, trouble: str) -> None:
        number += 1
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
        day = _live(Path(name), disk, quick)
        archive = Archive.open(day.archive)
        before = problems_of(archive)
        failed = {survey_of(*due) for due, why in day.endings.items() if why}
        left = clear(archive, failed, day.spools)
        return judged(day, left, (before, problems_of(archive)), clock.seconds, quick=quick)


def _live(folder: Path, disk: Path, quick: bool) -> Day:
    hours, troubles = (QUICK_HOURS, QUICK_TROUBLES) if quick else (HOURS, TROUBLES)
    kinds = [kind for kind, count in troubles.items() for _ in range(count)]
    chance = random.Random(3)
    with RigProcess(folder, scene_settings(), SPEED) as rig:
        write_fields(folder, disk / "archive", rig.table)
        Archive.open(disk / "archive")
        numbers = chance.sample(range(2, len(FIELDS) * hours * 5 // 6), len(kinds))
        day = Day(folder, disk, RigControl(folder), chance, dict(zip(numbers, kinds, strict=True)))
        day.live(hours)
    return day


def survey_of(name: str, due: datetime) -> Survey:
    """The seed of a field's scene and the name of the visit of a due time."""
    return FIELDS[name], due.isoformat().replace("+00:00", "Z")


def judged(
    day: Day, left: Leftovers, problems: tuple[list[str], list[str]], seconds: float, *, quick: bool
) -> list[Row]:
    """A row for each demand, and whether it was met."""
    wanted, grown, struck = Counter(day.planned), Growth.of(day.samples), day.struck
    failed = {due: why for due, why in day.endings.items() if why}
    again = sum(not day.endings[due] for due in struck["kill"])
    full = sum(FULL in failed.get(due, "") for due in struck["disk"])
    named = {
        which: sum(name in failed.get(due, "") and any(word in failed[due] for word in CABLE) for due in struck[which])
        for which, name in DEVICES.items()
    }
    pulls = {which: len(struck[which]) for which in DEVICES}
    unexplained = failed.keys() - {due for dues in struck.values() for due in dues}
    first = next((one for part in problems for one in part), "")
    whole = f"{len(problems[0])} problems before gc, {len(problems[1])} after{': ' + first if first else ''}"
    return [
        Row(
            "a day of surveys",
            "three fields in turn through an emulated rig, as visits of their due times",
            len(day.endings),
            "each done, or failed by what was done to it",
            f"{len(day.endings) - len(failed)} done, {len(failed)} failed, {len(unexplained)} of them by nothing",
            not unexplained,
            seconds,
        ),
        Row(
            "kills",
            "SIGKILL of the process that surveys",
            len(struck["kill"]),
            "the same visit, begun again, is done",
            f"{again} of those that were killed",
            again == len(struck["kill"]) == wanted["kill"],
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
            "failed, in words that say so",
            f"{full} failed by it",
            full == len(struck["disk"]) == wanted["disk"],
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
            "resident, after each survey of this process",
            len(day.samples),
            "not judged: too few" if quick else "last quarter within 5 % of the second",
            grown.words(),
            quick or grown.is_flat,
            0.0,
        ),
    ]


if __name__ == "__main__":
    print(json.dumps([asdict(row) for row in _rows("--quick" in sys.argv)]))
