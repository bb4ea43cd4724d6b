"""The emulated mirror's motion, vector unit, trigger and log, through frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.rig import pro_mode as pro
from pipeline.rig.emulator.mirror_device import MirrorDevice
from tests.pipeline.rig.in_process import ManualClock

PATH = np.array([(0.1, 0.0), (0.2, 0.1), (0.3, -0.1), (0.2, 0.2)], np.float32).astype(float)
RATE_HZ = 50.0


def ask(device: MirrorDevice, frame: pro.Frame) -> pro.Frame:
    """Return the controller's reply to a frame."""
    (reply,) = pro.FrameReader().feed(b"".join(data for _, data in device.receive(pro.encode(frame))))
    assert isinstance(reply, pro.Frame)
    assert reply.crc_good
    return reply


def do(device: MirrorDevice, frame: pro.Frame) -> None:
    """Send a frame and assert that it is acknowledged."""
    assert ask(device, frame) == pro.Frame(frame.command)


def running(clock: ManualClock, trigger: pro.Trigger = pro.Trigger.OFF) -> MirrorDevice:
    """Return a controller that starts to play PATH."""
    device = MirrorDevice(clock)
    device.receive(b"GOPROCRC\r\n")
    do(device, pro.set_vector(pro.VECTOR_MEMORY, 0, PATH.T.astype(">f4").tobytes()))
    for number, channel in enumerate((pro.X, pro.Y)):
        values: dict[pro.VectorRegister, pro.Value] = {
            pro.VectorRegister.UNIT: pro.UNIT_XY,
            pro.VectorRegister.START: 4 * number,
            pro.VectorRegister.END: 4 * number + 4,
            pro.VectorRegister.FREQUENCY: RATE_HZ,
            pro.VectorRegister.TRIGGER: int(trigger),
        }
        do(device, pro.set_values({channel.vector(name): value for name, value in values.items()}))
    run: dict[int, pro.Value] = {pro.X.input: pro.X.vector_system, pro.Y.input: pro.Y.vector_system}
    run |= {channel.vector(pro.VectorRegister.RUN): 1 for channel in (pro.X, pro.Y)}
    do(device, pro.set_values(run))
    return device


def index(device: MirrorDevice) -> int:
    """Return the cell of X."""
    return pro.cell_int(ask(device, pro.get_value(pro.X.vector(pro.VectorRegister.INDEX))).payload)


def expected(times_s: NDArray[np.float64], began_s: float) -> NDArray[np.float64]:
    """Return the positions of the path at times after its start."""
    return PATH[np.minimum(np.floor((times_s - began_s) * RATE_HZ + 1e-9).astype(int), 3)]


def test_a_run_moves_the_mirror_along_the_path() -> None:
    """Each position is held for a period, the last one permanently. A halt after the run changes nothing."""
    clock = ManualClock(7.0)
    device = running(clock)
    clock.sleep(3 / RATE_HZ + 0.001)
    assert (index(device), device.state.playbacks[0].running) == (3, True)
    clock.sleep(1 / RATE_HZ)
    assert (index(device), device.state.playbacks[0].running) == (3, False)
    do(device, pro.set_values({pro.X.vector(pro.VectorRegister.RUN): 0, pro.Y.vector(pro.VectorRegister.RUN): 0}))
    clock.sleep(1.0)
    times_s = np.linspace(7.0, 8.0, 200)
    np.testing.assert_allclose(device.positions(times_s), expected(times_s, 7.0), atol=1e-7)
    np.testing.assert_array_equal(device.positions(6.9), (0.0, 0.0))


def test_pulses_step_through_the_path() -> None:
    """The run command plays the first position and each pulse the next one. A pulse after the last ends the run."""
    clock = ManualClock()
    device = running(clock, pro.Trigger.RISING_EDGE)
    for pulses, place, runs in ((0, 0, True), (1, 1, True), (2, 3, True), (1, 3, False)):
        clock.sleep(1.0)
        device.state.trigger(clock.now() + np.arange(pulses) * 0.01)
        clock.sleep(1.0)
        np.testing.assert_allclose(device.positions(clock.now()), PATH[place])
        assert (index(device), device.state.playbacks[0].running) == (place, runs)


def test_status_is_not_stable_during_a_move() -> None:
    """NOT_STABLE is set after a move and cleared within a second."""
    clock = ManualClock()
    device = MirrorDevice(clock)
    device.receive(b"GOPROCRC\r\n")
    follow = {**pro.X.followed(pro.X.static_system), **pro.Y.followed(pro.Y.static_system)}
    do(device, pro.set_values({pro.X.static_xy: 0.5, pro.Y.static_xy: 0.0, **follow}))
    assert device.state.status() == pro.Status.NOT_STABLE
    clock.sleep(1.0)
    assert device.state.status() == pro.Status(0)
    np.testing.assert_allclose(device.positions(clock.now()), (0.5, 0.0), atol=1e-7)


def test_the_log_contains_the_positions() -> None:
    """The log has rows at the set rate from the run command on, and keeps them after it is stopped."""
    clock = ManualClock(3.0)
    device = running(clock)
    chosen: dict[int, pro.Value] = {pro.log_slot(0): pro.FEEDBACK_X, pro.log_slot(1): pro.FEEDBACK_Y}
    do(device, pro.set_values({**chosen, pro.LOG_RATE: 1000.0}))
    do(device, pro.set_values({pro.LOG_RUN: 1}))
    clock.sleep(0.0995)
    do(device, pro.set_values({pro.LOG_RUN: 0}))
    clock.sleep(1.0)
    rows = [ask(device, pro.get_vector(pro.log_slot(slot), 35, 10)).payload for slot in (0, 1)]
    read = np.stack([np.frombuffer(row, ">f4") for row in rows], axis=-1)
    np.testing.assert_allclose(read, expected(3.0 + np.arange(35, 45) / 1000, 3.0), atol=1e-7)
    assert len(ask(device, pro.get_vector(pro.log_slot(0), 95, 5)).payload) == 20
    beyond = pro.get_vector(pro.log_slot(0), 96, 5)
    assert ask(device, beyond) == pro.refuse(beyond.command, pro.ErrorCode.VECTOR_INDEX)
