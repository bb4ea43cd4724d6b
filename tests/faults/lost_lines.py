"""Count the lines that a capture loses when it is killed: ``python tests/faults lost_lines``.

A killed process loses no written line, as the system has it. After a power failure a file has its last synced bytes.
Later bytes may be missing, cut off, zero or random.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from spectralzoom.pipeline.source import Line
from spectralzoom.storage.arrays.spool import SYNC_LINES, Spool
from tests.faults.fault_table import Row, reported_wrong
from tests.faults.nursery import ROOT
from tests.source_paths import PYTHON_PATH

SAMPLES, BANDS = 20, 7
LINES = 5 * SYNC_LINES + 13
KILLS, CUTS = 20, 400
HEADER = {"sweep": "a"}
FATES = ("as written", "cut off", "cut short", "zeros", "other bytes", "some pages")

WRITER = """
import os, sys
from pathlib import Path
from spectralzoom.storage.arrays.spool import Spool
from tests.faults.lost_lines import BANDS, HEADER, SAMPLES, line
with Spool.open(Path(sys.argv[1]), SAMPLES, BANDS, header=HEADER) as spool:
    while True:
        spool.append(line(spool.count))
        os.write(1, spool.count.to_bytes(8, "little"))
"""


@dataclass(frozen=True)
class Moment:
    """A moment of a capture: number of appended lines, and bytes of its file, written and synced."""

    appended: int
    written: int
    synced: int


@dataclass
class Losses:
    """Count the results of killed processes and power failures."""

    lost: Counter[int] = field(default_factory=Counter)  # lines lost -> number of cases
    wrong: list[str] = field(default_factory=list)

    def words(self) -> str:
        """Return the figures as text."""
        each = sorted(self.lost.elements()) or [0]
        at = [each[len(each) * fraction // 100] for fraction in (50, 90)]
        return (
            f"lines lost: none in {self.lost[0]}, median {at[0]}, 9 of 10 at most {at[1]}, at most {each[-1]};"
            f" {reported_wrong(self.wrong)}"
        )


def line(number: int) -> Line:
    """Return the line of this number, with the same values on each call."""
    data = np.random.default_rng(number).integers(0, 4096, (SAMPLES, BANDS), dtype=np.uint16)
    return Line(number, data, 0.0, 1e-3 * number, 0.01 * number, 10.0)


def record(folder: Path) -> list[Moment]:
    """Capture without a fault, and record the appended and synced data before and after each line and each sync."""
    moments: list[Moment] = []
    path = folder / "lines.lines"
    real = os.fdatasync
    synced = 0
    appended = 0

    def note() -> None:
        moments.append(Moment(appended, path.stat().st_size, synced))

    def watched(descriptor: int) -> None:
        nonlocal synced
        note()
        real(descriptor)
        synced = path.stat().st_size
        note()

    os.fdatasync = watched
    try:
        with Spool.open(folder, SAMPLES, BANDS, header=HEADER) as spool:
            for number in range(LINES):
                spool.append(line(number))
                appended = number + 1
                note()
    finally:
        os.fdatasync = real
    return moments


def cut_power(whole: Path, moment: Moment, folder: Path, chance: random.Random) -> str:
    """Write a file as a power failure at this moment may leave it; return what happened to its last bytes."""
    content = (whole / "lines.lines").read_bytes()
    begun = content.index(b"\n") + 1  # the header is synced before the first line
    fate = chance.choice(FATES)
    left = _left(content[: moment.written], max(moment.synced, begun), fate, chance)
    (folder / "lines.lines").write_bytes(left)
    return fate


def _left(content: bytes, synced: int, fate: str, chance: random.Random) -> bytes:
    """Return the file after a power failure: its synced bytes, and a possible result for the others."""
    safe, rest = content[:synced], content[synced:]
    if fate == "cut off":
        return safe
    if fate == "cut short":
        return safe + rest[: chance.randint(0, len(rest))]
    if fate == "zeros":
        return safe + bytes(len(rest))
    if fate == "other bytes":
        return safe + chance.randbytes(len(rest))
    if fate == "some pages":  # whole blocks of the disk are written in any order
        blocks = [rest[start : start + 512] for start in range(0, len(rest), 512)]
        return safe + b"".join(block if chance.random() < 0.5 else bytes(len(block)) for block in blocks)
    return content


def try_power(cuts: int, folder: Path, seed: int = 0) -> Losses:
    """Cut the power at random moments of one capture, and resume from each resulting file."""
    chance = random.Random(seed)
    found = Losses()
    moments = record(folder / "whole")
    truth = _contents(folder / "whole")
    for number in range(cuts):
        moment = chance.choice(moments)
        place = folder / str(number)
        place.mkdir()
        fates = cut_power(folder / "whole", moment, place, chance)
        wrong = list(_go_on(place, moment.appended, found))
        if _contents(place) != truth:
            wrong.append("not the undisturbed bytes after going on")
        found.wrong += [f"{moment.appended} lines, {fates}: {one}" for one in wrong]
    return found


def _go_on(place: Path, appended: int, found: Losses) -> Iterator[str]:
    with Spool.open(place, SAMPLES, BANDS, header=HEADER) as spool:
        lost = max(appended - spool.count, 0)
        found.lost[lost] += 1
        if lost > SYNC_LINES:
            yield f"{lost} lines lost"
        kept = [one for block in spool.blocks() for one in block]
        yield from (f"line {one.number} is another" for one in kept if not same(one, line(one.number)))
        while spool.count < LINES:
            spool.append(line(spool.count))


def try_kills(kills: int, folder: Path, seed: int = 0) -> Losses:
    """Kill captures at random moments, and compare the appended lines with the stored ones."""
    chance = random.Random(seed)
    found = Losses()
    command = [sys.executable, "-c", WRITER]
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    for number in range(kills):
        place = folder / f"killed-{number}"
        with subprocess.Popen([*command, str(place)], cwd=ROOT, env=environment, stdout=subprocess.PIPE) as process:
            told = process.stdout.read(8)  # the first line is stored
            time.sleep(chance.uniform(0.0, 0.1))
            process.send_signal(signal.SIGKILL)
            told += process.stdout.read()
        appended = len(told) // 8
        with Spool.open(place, SAMPLES, BANDS, header=HEADER) as spool:
            found.lost[max(appended - spool.count, 0)] += 1
            kept = [one for block in spool.blocks() for one in block]
            if appended > spool.count:
                found.wrong.append(f"{appended - spool.count} of {appended} lines lost")
            found.wrong += [f"line {one.number} is another" for one in kept if not same(one, line(one.number))]
    return found


def same(one: Line, other: Line) -> bool:
    return np.array_equal(one.data, other.data) and _facts(one) == _facts(other)


def _facts(one: Line) -> tuple[Any, ...]:
    return one.number, one.mirror_x, one.mirror_y, one.time_s, one.exposure_ms, one.valid


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def rows(quick: bool = False) -> Iterator[Row]:
    demanded = f"at most {SYNC_LINES} lines lost, the capture goes on to the same bytes"
    garbled = "the file as of the last fdatasync, what came later cut off, zeroed, garbled or kept"
    cases = (
        ("capture killed", "SIGKILL of the process that appends lines", "no appended line lost", try_kills, (KILLS, 3)),
        ("power fails in a capture", garbled, demanded, try_power, (CUTS, 40)),
    )
    with tempfile.TemporaryDirectory(prefix="lost-") as name:
        for fault, injected, demanded, tried, counts in cases:
            count = counts[quick]
            losses = tried(count, Path(name))
            yield Row(fault, injected, count, demanded, losses.words(), not losses.wrong)
