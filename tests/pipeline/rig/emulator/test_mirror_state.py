"""The emulated mirror's motion, vector unit, trigger and log, through frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.mirror_controller import hold_values
from pipeline.rig.pro_mode import (
    FEEDBACK_X,
    FEEDBACK_Y,
    LOG_RATE,
    LOG_RUN,
    UNIT_XY,
    VECTOR_MEMORY,
    ErrorCode,
    Frame,
    FrameReader,
    Status,
    Trigger,
    Value,
    VectorRegister,
    X,
    Y,
    cell_int,
    encode,
    get_value,
    get_vector,
    log_slot,
    refuse,
    set_values,
    set_vector,
)
from tests.pipeline.rig.in_process import ManualClock

PATH = np.array([(0.1, 0.0), (0.2, 0.1), (0.3, -0.1), (0.2, 0.2)], np.float32).astype(float)
RATE_HZ = 50.0


def ask(device: MirrorDevice, frame: Frame) -> Frame:
    """Return the controller's reply to a frame."""
    (reply,) = FrameReader().feed(b"".join(data for _, data in device.receive(encode(frame))))
    assert isinstance(reply, Frame)
    assert reply.crc_good
    return reply


def do(device: MirrorDevice, frame: Frame) -> None:
    """Send a frame that is acknowledged."""
    assert ask(device, frame) == Frame(frame.command)


def running(clock: ManualClock, trigger: Trigger = Trigger.OFF) -> MirrorDevice:
    """Return a controller that begins to play PATH."""
    device = MirrorDevice(clock)
    device.receive(b"GOPROCRC\r\n")
    do(device, set_vector(VECTOR_MEMORY, 0, PATH.T.astype(">f4").tobytes()))
    for number, channel in enumerate((X, Y)):
        values: dict[VectorRegister, Value] = {
            VectorRegister.UNIT: UNIT_XY,
            VectorRegister.START: 4 * number,
            VectorRegister.END: 4 * number + 4,
            VectorRegister.FREQUENCY: RATE_HZ,
            VectorRegister.TRIGGER: int(trigger),
        }
        do(device, set_values({channel.vector(name): value for name, value in values.items()}))
    run: dict[int, Value] = {X.input: X.vector_system, Y.input: Y.vector_system}
    do(device, set_values({**run, X.vector(VectorRegister.RUN): 1, Y.vector(VectorRegister.RUN): 1}))
    return device


def index(device: MirrorDevice) -> int:
    """Return the cell of X."""
    return cell_int(ask(device, get_value(X.vector(VectorRegister.INDEX))).payload)


def expected(times_s: NDArray[np.float64], began_s: float) -> NDArray[np.float64]:
    """Return where the path is at times from its start on."""
    return PATH[np.minimum(np.floor((times_s - began_s) * RATE_HZ + 1e-9).astype(int), 3)]


def test_a_run_moves_the_mirror_along_the_path() -> None:
    """Each cell is held for a period, the last one for good; then the run is over, and halting changes nothing."""
    clock = ManualClock(7.0)
    device = running(clock)
    clock.sleep(3 / RATE_HZ + 0.001)
    assert (index(device), device.state.playbacks[0].running) == (3, True)
    clock.sleep(1 / RATE_HZ)
    assert (index(device), device.state.playbacks[0].running) == (3, False)
    do(device, set_values({X.vector(VectorRegister.RUN): 0, Y.vector(VectorRegister.RUN): 0}))
    clock.sleep(1.0)
    times_s = np.linspace(7.0, 8.0, 200)
    np.testing.assert_allclose(device.positions(times_s), expected(times_s, 7.0), atol=1e-7)
    np.testing.assert_array_equal(device.positions(6.9), (0.0, 0.0))


def test_pulses_step_through_the_path() -> None:
    """The run command plays the first cell, each pulse the next; pulses beyond the last end the run."""
    clock = ManualClock()
    device = running(clock, Trigger.RISING_EDGE)
    for pulses, place, runs in ((0, 0, True), (1, 1, True), (2, 3, True), (1, 3, False)):
        clock.sleep(1.0)
        device.state.trigger(clock.now() + np.arange(pulses) * 0.01)
        clock.sleep(1.0)
        np.testing.assert_allclose(device.positions(clock.now()), PATH[place])
        assert (index(device), device.state.playbacks[0].running) == (place, runs)


def test_status_while_it_moves() -> None:
    """NOT_STABLE for a short time after each move."""
    clock = ManualClock()
    device = MirrorDevice(clock)
    device.receive(b"GOPROCRC\r\n")
    do(device, set_values(hold_values(0.5, 0.0)))
    assert device.state.status() == Status.NOT_STABLE
    clock.sleep(1.0)
    assert device.state.status() == Status(0)
    np.testing.assert_allclose(device.positions(clock.now()), (0.5, 0.0), atol=1e-7)


def test_the_log_holds_the_positions() -> None:
    """Rows at the set rate from the run command on; it keeps them when it is stopped."""
    clock = ManualClock(3.0)
    device = running(clock)
    chosen: dict[int, Value] = {log_slot(0): FEEDBACK_X, log_slot(1): FEEDBACK_Y, LOG_RATE: 1000.0}
    do(device, set_values(chosen))
    do(device, set_values({LOG_RUN: 1}))
    clock.sleep(0.0995)
    do(device, set_values({LOG_RUN: 0}))
    clock.sleep(1.0)
    rows = [ask(device, get_vector(log_slot(slot), 35, 10)).payload for slot in (0, 1)]
    read = np.stack([np.frombuffer(row, ">f4") for row in rows], axis=-1)
    np.testing.assert_allclose(read, expected(3.0 + np.arange(35, 45) / 1000, 3.0), atol=1e-7)
    assert len(ask(device, get_vector(log_slot(0), 95, 5)).payload) == 20
    beyond = get_vector(log_slot(0), 96, 5)
    assert ask(device, beyond) == refuse(beyond.command, ErrorCode.VECTOR_INDEX)
