"""Fill the disk during a survey, or refuse its system calls: ``python tests/faults disk_full refused_writes``.

The archive is on a small tmpfs, which is filled up at a chosen file. Then it grows, and the same command runs again.
If no tmpfs can be mounted, the calls are refused inside of the process instead, and the table says so.

File permissions do not stop root, so other errors are raised inside of the process, at any call that changes the
archive, by any library. Calls are drawn at random over a whole survey, each with a random error.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.fault_table import Row, reported_wrong
from tests.faults.injection import ERRORS, label, logged_calls
from tests.faults.nursery import Ended, Nursery
from tests.faults.small_survey import Subject, prepare, words, wrong_after_fault, wrong_after_rerun

LARGE = 64 << 20  # bytes: more than a survey needs
KINDS = ("spool", "segment", "segment manifest", "run")  # of written files
FULL = "disk is full"
# Functions of this project that meet a full disk.
WHERE = {"spool": "capture.take", "manifest": "store.write_manifest"}


@dataclass
class Refusals:
    """Count the results of surveys on disks that refuse writes."""

    met_at: Counter[str] = field(default_factory=Counter)  # kind of the written file, or names of call and error
    told: int = 0  # one clear message, exit code 1
    done: int = 0  # the survey had enough space, or did not need the call: exit code 0
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """Return the figures as text."""
        at = ", ".join(f"{name} {count}" for name, count in sorted(self.met_at.items()))
        return f"{self.told} failed with one message, {self.done} ended well; {reported_wrong(self.wrong)} (at: {at})"


# --- full disks -------------------------------------------------------------------------------------------------------


def can_mount() -> bool:
    """Return whether this process may mount a tmpfs."""
    with tempfile.TemporaryDirectory() as name:
        done = subprocess.run(["mount", "-t", "tmpfs", "none", name], capture_output=True, check=False).returncode == 0
        if done:
            subprocess.run(["umount", name], check=True)
        return done


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mount a tmpfs of ``size`` bytes for the block."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)
        folder.rmdir()


def fill_at_places(subject: Subject, each: int, *, mounted: bool, seed: int = 0) -> Refusals:
    """Fill the disk ``each`` times while each kind of file is written, and rerun the survey on a larger disk."""
    found = Refusals()
    chance = random.Random(seed)
    counts = Counter(label(path) for _, call, path in subject.changing_calls if call == "open")
    for name in KINDS:
        for at in sorted(chance.sample(range(1, counts[name] + 1), min(each, counts[name]))):
            disk = subject.folder / f"disk-{name}-{at}".replace(" ", "-")
            place = {"root": str(disk / "a"), "at": at, "kind": name}
            if mounted:
                with small_disk(disk, LARGE // 8):
                    ended = subject.nursery.run(words(disk / "a"), "fill_disk", **place)
                    _judge(subject, disk / "a", ended, name, found)
            else:
                full = {"number": ERRORS["ENOSPC"], "lasting": True}
                ended = subject.nursery.run(words(disk / "a"), "refuse", **place, **full)
                _judge(subject, disk / "a", ended, name, found)
                shutil.rmtree(disk)
    return found


def _judge(subject: Subject, out: Path, ended: Ended, name: str, found: Refusals) -> None:
    """Check the archive after the failure, enlarge the disk, and check again after a rerun."""
    wrong = wrong_after_fault(subject, out)
    if not (ended.told and FULL in ended.message):
        wrong.append(f"exit {ended.code}, {ended.message[-200:]}")
    found.told += ended.told
    found.met_at[name] += 1
    wrong += [f"met at {ended.place}" for word, where in WHERE.items() if word in name and where not in ended.place]
    if os.path.ismount(out.parent):
        subprocess.run(["mount", "-o", f"remount,size={LARGE}", str(out.parent)], check=True)
    wrong += wrong_after_rerun(subject, out, subject.nursery.run(words(out)))
    found.wrong += [f"{name}: {one}" for one in wrong]


def full_rows(quick: bool = False) -> list[Row]:
    mounted = can_mount()
    with tempfile.TemporaryDirectory(prefix="full-") as name, Nursery(Path(name)) as nursery:
        found = fill_at_places(prepare(nursery), 1 if quick else 5, mounted=mounted)
    injected = "a tmpfs filled up while each kind of file is written; then it grows"
    if not mounted:
        injected = "ENOSPC refused from the inside (no tmpfs can be mounted here), from each kind of file on"
    demanded = "one message and exit 1, archive verifies, nothing published is lost, rerun bit-identical"
    met = not found.wrong and set(found.met_at) == set(KINDS)
    return [Row("disk full", injected, found.told, demanded, found.words(), met)]


# --- calls that are refused -------------------------------------------------------------------------------------------


def refuse_places(subject: Subject, count: int, seed: int = 0) -> Refusals:
    """Refuse one random call in each of ``count`` parts of a survey, and rerun each survey without the fault."""
    chance = random.Random(seed)
    found = Refusals()
    for part in range(count):
        at = 1 + int((part + chance.random()) * len(subject.changing_calls) / count)
        _refuse_one(subject, at, chance.choice(list(ERRORS)), chance.random() < 0.5, found)
    return found


def _refuse_one(subject: Subject, at: int, name: str, lasting: bool, found: Refusals) -> None:
    out, log = subject.folder / f"refused-{at}", subject.folder / f"refused-{at}.calls"
    about = {"root": str(out), "at": at, "number": ERRORS[name], "lasting": lasting, "log": str(log)}
    ended = subject.nursery.run(words(out), "refuse", **about)
    hit = logged_calls(log)
    call, path = hit[0][1:] if hit else ("none", "")
    found.met_at.update((call, name))
    found.told += ended.told
    found.done += ended.code == 0
    wrong = wrong_after_fault(subject, out)
    if not hit or not (ended.told or ended.code == 0):
        wrong.append(f"exit {ended.code}, {ended.message[-300:]}")
    # One run after the rerun, unless the run was already published at the refusal.
    published = ended.code == 0 or not hit or Path(path).name == "runs" or "runs-" in path or "use.lock" in path
    wrong += wrong_after_rerun(subject, out, subject.nursery.run(words(out)), runs=None if published else 1)
    found.wrong += [f"{name} at {at} ({call}, {ended.place[-60:]}): {one}" for one in wrong]
    shutil.rmtree(out, ignore_errors=True)
    log.unlink(missing_ok=True)


def refused_rows(quick: bool = False) -> list[Row]:
    count = 12 if quick else 150
    with tempfile.TemporaryDirectory(prefix="refused-") as name, Nursery(Path(name)) as nursery:
        found = refuse_places(prepare(nursery), count)
    injected = f"{', '.join(ERRORS)} at a random call that changes the archive, once or from there on"
    demanded = "one message and exit 1, archive verifies, rerun bit-identical"
    met = not found.wrong and found.told > count // 2
    return [Row("writes refused", injected, count, demanded, found.words(), met)]
