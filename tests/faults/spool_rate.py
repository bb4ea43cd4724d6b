"""Lines into a spool at a camera's pace: ``python tests/faults spool_rate``.

A camera has line n ready n periods after the first, and keeps some until they are fetched; what is not fetched by then
is dropped. ``--load`` lets a second process read the disk and sync files of its own meanwhile.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.source import Line
from storage.arrays.spool import SYNC_LINES, Spool
from tests.faults.fault_table import Clock, Row

SAMPLES, BANDS, RATE_HZ = 640, 270, 100.0
HELD = 64  # lines that a camera or its driver keeps: 22 MB
MOST_CORE = 0.20
LOAD_BLOCK = 1 << 22


@dataclass(frozen=True)
class Pace:
    """How a spool kept up. Latency is from when a line was ready to when the spool had taken it."""

    lines: int
    dropped: int
    late: int  # taken more than one period after they were ready
    behind: int  # most lines ready at a time and not yet taken
    slowest_s: float
    median_s: float
    cpu_s: float
    wall_s: float
    kept: int  # lines that a reader finds afterwards, as captured

    @property
    def core(self) -> float:
        """Share of one core."""
        return self.cpu_s / self.wall_s

    @property
    def met(self) -> bool:
        """No line dropped or changed, and a fifth of a core at most."""
        return self.dropped == 0 and self.kept == self.lines and self.core <= MOST_CORE

    def words(self) -> str:
        """The figures."""
        return (
            f"{self.lines} lines, {self.dropped} dropped, {self.kept} read back as captured; {self.core:.1%} of a core;"
            f" {self.late} late, {self.behind} waiting at most, latency {self.median_s * 1e3:.1f} ms,"
            f" slowest {self.slowest_s * 1e3:.0f} ms"
        )


def keep_pace(folder: Path, seconds: float, *, samples: int = SAMPLES, bands: int = BANDS, check: bool = True) -> Pace:
    """Append lines at ``RATE_HZ`` for some seconds, then read them again where ``check``."""
    frames = _frames(samples, bands)
    count, period = round(seconds * RATE_HZ), 1 / RATE_HZ
    latency, dropped, number = np.zeros(count), 0, 0
    with Spool.open(folder, samples, bands, header={"sweep": "pace"}) as spool:
        cpu, began = time.process_time(), time.monotonic()
        for ready in range(count):
            at = began + ready * period
            if (wait := at - time.monotonic()) > 0:
                time.sleep(wait)
            if time.monotonic() > at + HELD * period:
                dropped += 1  # the camera has overwritten it
                continue
            spool.append(Line(number, frames[number % len(frames)], 0.0, 1e-4 * ready, ready * period, 10.0))
            latency[number] = time.monotonic() - at
            number += 1
        spool.sync()
        cpu, wall = time.process_time() - cpu, max(time.monotonic() - began, count * period)
        taken = latency[:number]
        kept = sum(_as_captured(block, frames) for block in spool.blocks()) if check else number
    slowest = float(taken.max(initial=0.0))
    return Pace(
        count,
        dropped,
        int((taken > period).sum()),
        int(slowest / period),
        slowest,
        float(np.median(taken)),
        cpu,
        wall,
        kept,
    )


def _frames(samples: int, bands: int) -> list[NDArray[np.uint16]]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 4096, (samples, bands), dtype=np.uint16) for _ in range(SYNC_LINES)]


def _as_captured(block: list[Line], frames: list[NDArray[np.uint16]]) -> int:
    return sum(np.array_equal(line.data, frames[line.number % len(frames)]) for line in block)


@contextmanager
def loaded_disk(folder: Path) -> Iterator[None]:
    """Let another process write, sync and read 4 MB at a time in ``folder`` while the block runs."""
    child = os.fork()
    if child == 0:
        _load(folder / "load.bin")
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _load(path: Path) -> None:
    block = os.urandom(LOAD_BLOCK)
    while True:
        with path.open("wb") as file:
            for _ in range(16):
                file.write(block)
                file.flush()
                os.fsync(file.fileno())
                time.sleep(0.02)
        path.read_bytes()


def rows(quick: bool = False) -> list[Row]:
    """Five minutes of the paper's line, and half a minute beside a busy disk."""
    found = []
    for seconds, busy in ((2.0, False),) if quick else ((300.0, False), (30.0, True)):
        clock = Clock()
        with tempfile.TemporaryDirectory() as name:
            if busy:
                with loaded_disk(Path(name)):
                    pace = keep_pace(Path(name) / "spool", seconds)
            else:
                pace = keep_pace(Path(name) / "spool", seconds)
        beside = ", another process writing and syncing beside it" if busy else ""
        found.append(
            Row(
                "camera's pace",
                f"lines of {SAMPLES} x {BANDS} at {RATE_HZ:.0f} Hz for {seconds:.0f} s{beside}",
                pace.lines,
                f"none dropped ({HELD} held by the camera), at most {MOST_CORE:.0%} of a core",
                pace.words(),
                pace.met,
                clock.seconds,
            )
        )
    return found
