"""The emulated controller's vector run, trigger and logger, through frames, against the closed form of the motion."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.rig.clock import ManualClock
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_motion import AxisMotion, Stiffness
from pipeline.rig.emulator.mirror_state import MirrorUnit
from pipeline.rig.mirror.pro_mode import ErrorCode, Frame, FrameReader, encode
from pipeline.rig.mirror.pro_payloads import (
    Value,
    cell_float,
    cell_int,
    get_value,
    get_vector,
    refuse,
    set_value,
    set_values,
    set_vector,
)
from pipeline.rig.mirror.registers import (
    FEEDBACK_X,
    FEEDBACK_Y,
    LOG_RATE,
    LOG_RUN,
    VECTOR_MEMORY,
    Trigger,
    Unit,
    VectorRegister,
    X,
    Y,
    log_slot,
)

PATH = np.array([(0.1, 0.0), (0.2, 0.1), (0.3, -0.1), (0.2, 0.2)])


def ask(device: MirrorDevice, frame: Frame) -> Frame:
    """The controller's reply to a frame."""
    (reply,) = FrameReader().feed(b"".join(data for _, data in device.receive(encode(frame))))
    assert isinstance(reply, Frame)
    assert reply.crc_good
    return reply


def do(device: MirrorDevice, frame: Frame) -> None:
    """Let the controller do something, which it acknowledges."""
    assert ask(device, frame) == Frame(frame.command)


def loaded(clock: ManualClock, trigger: Trigger = Trigger.OFF, cycles: int = 1) -> MirrorDevice:
    """A controller that is set up to play PATH at 50 Hz."""
    device = MirrorDevice(clock)
    device.receive(b"GOPROCRC\r\n")
    do(device, set_vector(VECTOR_MEMORY, 0, PATH.T.astype(">f4").tobytes()))
    for number, channel in enumerate((X, Y)):
        values: dict[VectorRegister, Value] = {
            VectorRegister.UNIT: int(Unit.XY),
            VectorRegister.START: 4 * number,
            VectorRegister.END: 4 * number + 4,
            VectorRegister.FREQUENCY: 50.0,
            VectorRegister.CYCLES: cycles,
            VectorRegister.TRIGGER: int(trigger),
        }
        do(device, set_values({channel.vector(name): value for name, value in values.items()}))
    return device


def run(device: MirrorDevice) -> None:
    """Let the channels follow their vector units, and run those."""
    follow: dict[int, Value] = {X.input: X.vector_system, Y.input: Y.vector_system}
    do(device, set_values({**follow, X.vector(VectorRegister.RUN): 1, Y.vector(VectorRegister.RUN): 1}))


def expected(times: NDArray[np.float64], began_s: float) -> NDArray[np.float64]:
    """Where the mirror is, by axes that were sent the path one position after the other."""
    axes = [AxisMotion(Stiffness()) for _ in range(2)]
    for number, xy in enumerate(PATH.astype(np.float32)):
        for axis, place in zip(axes, xy.tolist(), strict=True):
            axis.command(began_s + number / 50, place)
    return np.stack([axis.places(times) for axis in axes], axis=-1)


def test_a_run_moves_the_mirror_along_the_path() -> None:
    """The true positions of a run are those of the closed form; so is the feedback register, at its time."""
    clock = ManualClock(7.0)
    device = loaded(clock)
    run(device)
    clock.advance(0.031)
    feedback = cell_float(ask(device, get_value(FEEDBACK_Y)).payload)
    assert feedback == pytest.approx(expected(np.array([7.031]), 7.0)[0, 1], abs=1e-7)
    clock.advance(1.0)
    times = np.linspace(6.9, 8.0, 200)
    np.testing.assert_allclose(device.positions(times), expected(times, 7.0), atol=1e-7)
    assert cell_int(ask(device, get_value(X.vector(VectorRegister.RUN))).payload) == 0


def test_the_index_and_the_output_tell_the_cell() -> None:
    """While it runs, index and output are those of the cell that is held."""
    clock = ManualClock()
    device = loaded(clock, cycles=-1)
    run(device)
    for number in range(6):
        clock.advance(0.01)
        assert cell_int(ask(device, get_value(Y.vector(VectorRegister.INDEX))).payload) == 4 + number % 4
        output = cell_float(ask(device, get_value(Y.vector(VectorRegister.OUTPUT))).payload)
        assert output == pytest.approx(PATH[number % 4, 1], abs=1e-7)
        clock.advance(0.01)
    clock.advance(0.01)
    do(device, set_values({X.vector(VectorRegister.RUN): 0, Y.vector(VectorRegister.RUN): 0}))
    clock.advance(1.0)
    np.testing.assert_allclose(device.positions(clock.now()), PATH[2], atol=1e-6)


def test_a_unit_that_is_not_followed_moves_nothing() -> None:
    """A vector unit runs without effect while the channels follow their held positions."""
    clock = ManualClock()
    device = loaded(clock)
    do(device, set_values({X.vector(VectorRegister.RUN): 1, Y.vector(VectorRegister.RUN): 1}))
    clock.advance(1.0)
    np.testing.assert_array_equal(device.positions(clock.now()), (0, 0))


def test_a_cameras_pulses_step_through_the_path() -> None:
    """The first position is taken at the run command, each pulse takes the next; pulses may lie in the future."""
    clock = ManualClock()
    device = loaded(clock, Trigger.RISING_EDGE)
    run(device)
    clock.advance(5.0)
    np.testing.assert_allclose(device.positions(clock.now()), PATH[0], atol=1e-6)
    device.trigger()
    clock.advance(1.0)
    np.testing.assert_allclose(device.positions(clock.now()), PATH[1], atol=1e-6)
    device.trigger(2, period_s=1.0, started_s=clock.now() + 1.0)
    clock.advance(3.0)
    np.testing.assert_allclose(device.positions(clock.now() - np.array([2.01, 1.01, 0.0])), PATH[1:], atol=1e-6)


def test_the_log_holds_the_true_positions() -> None:
    """Rows at the set rate, of the registers chosen, from the run command on; it fills and then stops by itself."""
    clock = ManualClock(3.0)
    device = loaded(clock)
    chosen: dict[int, Value] = {log_slot(0): FEEDBACK_X, log_slot(1): FEEDBACK_Y, LOG_RATE: 1000.0}
    do(device, set_values({**chosen, log_slot(2): X.vector(VectorRegister.INDEX)}))
    do(device, set_value(LOG_RUN, 1))
    run(device)
    clock.advance(0.0995)
    do(device, set_value(LOG_RUN, 0))
    clock.advance(1.0)
    rows = [ask(device, get_vector(log_slot(slot), 40, 10)).payload for slot in range(3)]
    times = 3.0 + np.arange(40, 50) / 1000
    read = np.stack([np.frombuffer(row, ">f4") for row in rows[:2]], axis=-1)
    np.testing.assert_allclose(read, expected(times, 3.0), atol=1e-7)
    assert set(np.frombuffer(rows[2], ">u4").tolist()) == {2}
    assert len(ask(device, get_vector(log_slot(0), 95, 5)).payload) == 20
    beyond = get_vector(log_slot(0), 96, 5)
    assert ask(device, beyond) == refuse(beyond.command, ErrorCode.VECTOR_INDEX)


def test_a_log_that_is_full_stops() -> None:
    """The logger runs no longer than it has rows, and says so."""
    clock = ManualClock()
    device = MirrorDevice(clock, unit=MirrorUnit(log_rows=20))
    device.receive(b"GOPRO\r\n")
    do(device, set_value(LOG_RUN, 1))
    assert cell_int(ask(device, get_value(LOG_RUN)).payload) == 1
    clock.advance(1.0)
    assert cell_int(ask(device, get_value(LOG_RUN)).payload) == 0
    assert ask(device, get_vector(log_slot(0), 10, 10)).payload == bytes(40)


def test_a_log_can_be_run_anew() -> None:
    """A second run begins at row 0 again."""
    clock = ManualClock()
    device = MirrorDevice(clock)
    device.receive(b"X=0.5\r\nGOPRO\r\n")
    do(device, set_value(log_slot(0), FEEDBACK_X))
    for _ in range(2):
        do(device, set_value(LOG_RUN, 1))
        clock.advance(1.0)
    assert cell_float(ask(device, get_vector(log_slot(0), 0, 1)).payload) == pytest.approx(0.5, abs=1e-6)
