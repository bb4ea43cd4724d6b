"""Test whole sweeps through a rig under every fault of the emulated camera and some of the mirror, with many seeds.

Each session captures a small sweep with drivers of both devices and a manual clock. Returned lines are right, no
acknowledged line is captured twice, and a later process with the same files completes the sweep.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.geometry.scan import Sweep
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.device_settings import ControlPatience
from pipeline.rig.drivers import RigDevices
from pipeline.rig.pro_mode import Status
from pipeline.source import Line
from tests.pipeline.rig.camera_faults import CameraFault, CameraFaults
from tests.pipeline.rig.mirror.test_fault_suite import moves
from tests.pipeline.rig.mirror_faults import Fault, make_fault
from tests.pipeline.rig.small_rig import SmallRig, assert_simulated, small_rig

SEEDS = range(6)
SWEEP = Sweep("fine-5", "fine", "x", 1.5, -4.5, 7)
PAIRS = 5  # of the vector memory, with its lead-in: four lines per capture
COMMANDS, TRANSFERS = 12, 8  # occasions of an undisturbed sweep, slightly fewer than there are
PATIENCE = ControlPatience()
# duration of a request with all retries: each opens a connection, reads its prompt and waits for the reply
MOST_ASKED_S = (PATIENCE.retries + 1) * 2 * PATIENCE.deadline_s + PATIENCE.retries * PATIENCE.pause_s
MOST_CAPTURED_S = 4 * MOST_ASKED_S  # four requests: the check before, the capture, and its effect if the reply is lost
MOST_TAKEN_S = 300.0  # a sweep with all retries
HARMLESS = (CameraFault.SLOW, CameraFault.SPLIT)
OF_FILES = (CameraFault.BREAKS_OFF, CameraFault.REFUSES_FILES)
OF_MIRROR = (
    *("no-reply", "reply-bit-flipped", "request-byte-lost", "silent-reset", "reset-in-upload"),
    *("gone-after", "cell-lost", "split-replies"),
)
PLACES = re.compile(r"emulat|127\.0\.0\.1|/captured/|camera")


@pytest.fixture(scope="module")
def undisturbed() -> list[Line]:
    """Return the sweep's lines from an undisturbed rig, which equal those of the simulated source."""
    with small_rig(vector_pairs=PAIRS) as rig:
        lines = list(rig.source().lines(SWEEP))
    assert_simulated(lines, SWEEP)
    return lines


@dataclass
class Polls:
    """Sweeps through one emulated rig, each with its fault, with a record of requests, durations and errors."""

    rig: SmallRig
    asked_s: list[float] = field(default_factory=list)
    captured_s: list[float] = field(default_factory=list)
    errors: list[RigError] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        connect = self.rig.devices

        def devices() -> RigDevices:
            opened = connect()
            control = opened.camera
            for name, noted in {"_ask": self.asked_s, "capture": self.captured_s}.items():
                setattr(control, name, self.timed(getattr(control, name), noted))
            self.sent = self.rig.line.transport.sent
            return opened

        self.rig.devices = devices  # type: ignore[method-assign]

    def timed(self, call: Callable[..., Any], noted: list[float]) -> Callable[..., Any]:
        """Return the call with a record of its duration."""

        def timing(*given: Any, **named: Any) -> Any:
            began = self.rig.line.clock.now()
            try:
                return call(*given, **named)
            finally:
                noted.append(self.rig.line.clock.now() - began)

        return timing

    def strike(self, camera: CameraFaults, mirror: tuple[Fault, ...] = ()) -> None:
        """Set the faults from now on."""
        self.rig.emulated.camera.faults, self.rig.emulated.mirror.faults = camera, mirror

    def mend(self) -> None:
        """Remove all faults and restart the mirror."""
        self.strike(CameraFaults())
        self.rig.emulated.camera.files()  # computes finished frames, because a restarted mirror forgets its positions
        mirror = self.rig.emulated.mirror
        mirror.gone = mirror.hung = False
        mirror.state.flags = Status(0)
        mirror.restart()

    def go_on(self, kept: KeptInMemory, lines: list[Line]) -> None:
        """Capture the missing lines as another process would, and record the error that ends it."""
        try:
            for line in self.rig.source(kept).lines(SWEEP, first=len(lines)):
                lines.append(line)
        except RigError as error:
            self.errors.append(error)


@pytest.fixture(scope="module")
def scan_passes() -> Iterator[Polls]:
    """Yield one rig for all sessions of this file."""
    with small_rig(vector_pairs=PAIRS) as rig:
        yield Polls(rig)


def assert_right(lines: list[Line], undisturbed: list[Line]) -> None:
    """Assert that lines from the first one on equal those of an undisturbed rig."""
    for number, (line, expected) in enumerate(zip(lines, undisturbed, strict=False)):
        assert line.number == number
        np.testing.assert_array_equal(line.data, expected.data)
        assert (line.mirror_x, line.mirror_y, line.valid) == (expected.mirror_x, expected.mirror_y, True)


def session(scan_passes: Polls, undisturbed: list[Line], camera: CameraFaults, mirror: tuple[Fault, ...] = ()) -> None:
    """Capture a sweep with a fault and its rest without: every line is captured once and right."""
    kept = KeptInMemory()
    lines: list[Line] = []
    for noted in (scan_passes.asked_s, scan_passes.captured_s, scan_passes.errors):
        noted.clear()
    began_s = scan_passes.rig.line.clock.now()
    captures = scan_passes.rig.emulated.camera.captures
    captures.clear()  # of the previous session
    scan_passes.strike(camera, mirror)
    scan_passes.go_on(kept, lines)
    assert scan_passes.rig.line.clock.now() - began_s <= MOST_TAKEN_S
    assert max(scan_passes.asked_s, default=0.0) <= MOST_ASKED_S, max(scan_passes.asked_s)
    assert max(scan_passes.captured_s, default=0.0) <= MOST_CAPTURED_S, max(scan_passes.captured_s)
    assert_right(lines, undisturbed)
    assert scan_passes.errors or len(lines) == SWEEP.lines
    for error in scan_passes.errors:
        words = str(error)
        assert PLACES.search(words), words
        assert "\n" not in words
        assert "Traceback" not in words
        assert 20 < len(words) < 900, words
    motions = [data for data in scan_passes.sent if moves(data)]  # alternating: to the start, along the path
    assert all(one != other for one, other in pairwise(motions)), "a motion was sent twice"
    broke = len(scan_passes.errors)
    scan_passes.mend()
    scan_passes.go_on(kept, lines)
    assert len(scan_passes.errors) == broke, scan_passes.errors[-1]
    assert len(lines) == SWEEP.lines
    assert_right(lines, undisturbed)
    told = scan_passes.rig.source(kept).record["captures"]
    ranges = [(one["first"], one["stop"]) for one in told if "spent" not in one]
    assert sorted(ranges) == ranges
    assert all(one[1] <= other[0] for one, other in pairwise(ranges)), ranges
    assert len(captures) >= len(told)


@pytest.mark.parametrize("fault", CameraFault, ids=lambda fault: fault.name)
def test_no_camera_fault_loses_lines_or_hangs(fault: CameraFault, scan_passes: Polls, undisturbed: list[Line]) -> None:
    """Six sweeps per fault: it strikes once at a random occasion, or so often that retries do not help."""
    ended, struck = 0, 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        often = 1 if seed % 2 == 0 else int(rng.integers(3, 7))
        usual = TRANSFERS if fault in OF_FILES else COMMANDS
        occasions = 2 if fault in (CameraFault.FULL, CameraFault.BUSY, CameraFault.CUT_CUBE) else usual
        faults = CameraFaults({fault: often}, seed, int(rng.integers(occasions)))
        session(scan_passes, undisturbed, faults)
        struck += faults.left[fault] < often
        ended += bool(scan_passes.errors)
        if fault in HARMLESS:
            assert not scan_passes.errors, (seed, scan_passes.errors)
        if fault in OF_FILES and often == 1:
            assert not scan_passes.errors, (seed, scan_passes.errors)
    assert struck == len(SEEDS)
    assert ended > 0 or fault in (*HARMLESS, CameraFault.CUT_CUBE, CameraFault.BREAKS_OFF)


@pytest.mark.parametrize("name", OF_MIRROR)
def test_no_mirror_fault_spoils_a_sweep(name: str, scan_passes: Polls, undisturbed: list[Line]) -> None:
    """Six sweeps per fault: returned lines are right, and the sweep is completed after the mirror's repair."""
    ended = 0
    for seed in SEEDS:
        at = 4 * seed + 2 if name == "no-reply" else None  # most requests are reads, which are retried
        session(scan_passes, undisturbed, CameraFaults(), (make_fault(name, seed, at),))
        ended += bool(scan_passes.errors)
    assert ended > 0 or name in ("split-replies", "reply-bit-flipped")
