"""Test whole sessions of the driver under every fault of the emulated controller, with many seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.mirror_controller import MirrorController
from pipeline.rig.pro_mode import Command, Frame, FrameReader, VectorRegister, X, Y, cell_int, read_registers
from pipeline.rig.transports import StateUnknown
from tests.pipeline.rig.in_process import InProcessTransport, ManualClock
from tests.pipeline.rig.mirror_faults import HARMLESS, KINDS, FaultyMirror, make_fault

SEEDS = range(8)
SETTINGS = SurveyRig(expected_id="MR-E", read_back="all")
PATH = np.stack([np.linspace(-0.5, 0.5, 47), np.linspace(0.3, 0.1, 47)], axis=-1)
MOST_QUIET = 6  # longest wait for silence before a request, in units of quiet_s
EPSILON_S = 1e-6
STATIC = (X.static_xy, Y.static_xy)
RUNS = (X.vector(VectorRegister.RUN), Y.vector(VectorRegister.RUN))
ALWAYS_FATAL = ("mute", "gone-before", "gone-after", "hangs", "echo", "wrong-firmware")


def moves(data: bytes) -> bool:
    """Return whether a write of the driver moves the mirror."""
    if data[:2] in (b"X=", b"Y=", b"XY") or data.startswith(b"RESET"):
        return True
    for found in FrameReader().feed(data):
        if isinstance(found, Frame) and found.command == Command.SET_VALUES:
            for register, cell in read_registers(found.payload).items():
                if register in STATIC or (register in RUNS and cell_int(cell)):
                    return True
    return False


@dataclass
class Session:
    """A driver, a controller with one fault, and a record of their session."""

    name: str
    seed: int
    at: int | None = None  # opportunity at which the fault strikes; None: by the seed
    baud: int = 0
    quiet_s: list[float] = field(default_factory=list)  # of each transaction, until its first byte is sent
    waits_s: list[float] = field(default_factory=list)  # and after that
    errors: list[RigError] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = ManualClock()
        self.fault = make_fault(self.name, self.seed, self.at)
        self.device = FaultyMirror(self.clock, [self.fault])
        self.transport = InProcessTransport(self.device, self.clock, self.baud)
        settings = replace(SETTINGS, with_crc=self.seed % 2 == 1)  # every other session sends CRCs
        self.driver = MirrorController(self.transport, settings, self.clock)
        self.times()

    def times(self) -> None:
        """Record the duration of each transaction: the wait before its first byte, and the rest."""
        exchange = self.driver.wire.exchange
        write = self.transport.write
        first: list[float] = []

        def written(data: bytes, deadline: float) -> None:
            first.append(self.clock.now())
            write(data, deadline)

        def timed(*given: object) -> object:
            began = self.clock.now()
            first.clear()
            try:
                return exchange(*given)  # type: ignore[arg-type]
            finally:
                self.quiet_s.append((first or [began])[0] - began)
                self.waits_s.append(self.clock.now() - (first or [began])[0])

        self.transport.write = written  # type: ignore[method-assign]
        self.driver.wire.exchange = timed  # type: ignore[method-assign, assignment]

    def does(self, act: Callable[[], object], motions: int) -> bool:
        """Perform one action with at most ``motions`` motions, and return whether the session has no error."""
        sent = len(self.transport.sent)
        try:
            act()
        except RigError as error:
            self.errors.append(error)
        assert sum(map(moves, self.transport.sent[sent:])) <= motions
        return not self.errors

    def goes(self, x: float, y: float) -> None:
        """Go to a place, and assert the device's target if it is acknowledged."""
        self.driver.goto(x, y)
        assert [axis.place[-1] for axis in self.device.state.axes] == [float(np.float32(x)), float(np.float32(y))]

    def loads(self) -> None:
        """Load a path, and assert the device's memory if it is acknowledged."""
        self.driver.load_path(PATH)
        np.testing.assert_array_equal(self.device.state.memory[: PATH.size], PATH.T.ravel().astype(np.float32))

    def plays(self) -> None:
        """Play the path, and assert the final position if it is acknowledged."""
        self.driver.run(100.0)
        self.clock.sleep(1.0)
        np.testing.assert_allclose(self.device.positions(self.clock.now()), PATH[-1], atol=1e-5)

    def run(self) -> None:
        """Perform the steps of a survey until one fails, then disconnect."""
        steps: list[tuple[Callable[[], object], int]] = [
            (self.driver.connect, 0),
            (self.driver.status, 0),
            (lambda: self.goes(0.1, -0.2), 1),
            (lambda: self.driver.settle(1.0), 0),
            (self.loads, 0),
            (lambda: self.driver.start_log(100.0), 0),
            (self.plays, 1),
            (self.driver.index, 0),
            (self.driver.read_log, 0),
            (lambda: self.goes(0.0, 0.0), 1),
        ]
        for act, motions in steps:
            if not self.does(act, motions):
                break
        self.ends()

    def ends(self) -> None:
        """Assert that an unknown state stays blocked, and that the port closes in any state."""
        if self.errors and isinstance(self.errors[0], StateUnknown):
            sent = len(self.transport.sent)
            with pytest.raises(StateUnknown, match="then run again, which connects anew"):
                self.driver.goto(0.0, 0.0)
            assert not any(map(moves, self.transport.sent[sent:]))
        self.driver.close()


@pytest.mark.parametrize("name", KINDS)
def test_no_fault_hangs_moves_twice_or_loses_acknowledged_data(name: str) -> None:
    """Each of eight sessions per fault succeeds or ends with one error that names the place and the remedy."""
    struck = 0
    for seed in SEEDS:
        session = Session(name, seed)
        session.run()
        struck += session.fault.chance.struck > 0
        assert max(session.quiet_s) <= MOST_QUIET * SETTINGS.quiet_s, (seed, max(session.quiet_s))
        assert max(session.waits_s) <= SETTINGS.deadline_s + EPSILON_S, (seed, max(session.waits_s))
        for error in session.errors:
            words = str(error)
            assert "emulator" in words, words
            assert "Traceback" not in words
            assert "\n" not in words
            assert 20 < len(words) < 600, words
        if name in HARMLESS:
            assert not session.errors, (seed, session.errors)
        if session.fault.chance.struck and name in ALWAYS_FATAL:
            assert session.errors, seed
    assert struck >= len(SEEDS) // 2, f"{name} struck in {struck} of {len(SEEDS)} sessions"


@pytest.mark.parametrize("name", ["no-reply", "silent-reset", "gone-after"])
def test_no_lost_reply_moves_twice_or_goes_unnoticed(name: str) -> None:
    """The fault strikes each request of a session in turn, motions included."""
    kinds = set()
    for at in range(200):
        session = Session(name, seed=at, at=at, baud=115200)
        session.run()
        if not session.fault.chance.struck:
            break
        kinds |= {type(error) for error in session.errors}
        assert max(session.waits_s) <= SETTINGS.deadline_s + EPSILON_S
    assert at > 30
    assert StateUnknown in kinds
