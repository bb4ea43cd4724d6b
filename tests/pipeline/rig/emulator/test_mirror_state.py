"""How the emulated mirror moves, against the closed form of a second-order system; its vector unit, trigger and log."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.geometry.scan import Ends
from pipeline.rig.emulator.mirror_device import MirrorDevice
from pipeline.rig.emulator.mirror_state import AxisMotion, Stiffness, VectorPlayer
from pipeline.rig.mirror.pro_mode import (
    FEEDBACK_X,
    FEEDBACK_Y,
    LOG_RATE,
    LOG_RUN,
    VECTOR_MEMORY,
    ErrorCode,
    Frame,
    FrameReader,
    Trigger,
    Unit,
    Value,
    VectorRegister,
    X,
    Y,
    cell_float,
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
from tests.pipeline.rig.mirror.mirror_bytes import set_value

STIFF = Stiffness(20.0, 0.7)


def step_response(time_s: NDArray[np.float64], stiffness: Stiffness) -> NDArray[np.float64]:
    """The textbook's step response of an underdamped system."""
    damping, pace = stiffness.damping, stiffness.pace
    turned = pace * math.sqrt(1 - damping**2)
    wave = np.cos(turned * time_s) + damping / math.sqrt(1 - damping**2) * np.sin(turned * time_s)
    return np.where(time_s < 0, 0.0, 1 - np.exp(-damping * pace * time_s) * wave)


@pytest.mark.parametrize("damping", [0.05, 0.7, 0.99])
def test_a_step_is_answered_as_the_closed_form_says(damping: float) -> None:
    """From rest, at any time, before and after the step."""
    stiffness = Stiffness(20.0, damping)
    axis = AxisMotion(stiffness)
    axis.command(0.5, -0.3)
    times = np.linspace(0.4, 1.5, 500)
    np.testing.assert_allclose(axis.places(times), -0.3 * step_response(times - 0.5, stiffness), atol=1e-12)


def test_steps_add_up() -> None:
    """The system is linear: many steps, taken while it still moves, answer as the sum of theirs, one time or many."""
    random = np.random.default_rng(3)
    when, where = np.sort(random.uniform(0, 0.3, 40)), random.uniform(-1, 1, 40)
    axis = AxisMotion(STIFF)
    for time_s, place in zip(when.tolist(), where.tolist(), strict=True):
        axis.command(time_s, place)
    times = np.linspace(-0.1, 0.6, 300)
    heights = np.diff(where, prepend=0.0)
    expected_places = sum(h * step_response(times - t, STIFF) for t, h in zip(when, heights, strict=True))
    np.testing.assert_allclose(axis.places(times), expected_places, atol=1e-11)
    for time_s in (0.0, 0.2, 0.3, 3.0):
        assert axis.place(time_s) == pytest.approx(float(axis.places(time_s)), abs=1e-14)


def player(**settings: object) -> VectorPlayer:
    """A unit that plays cells 4 to 7 at 100 Hz."""
    return VectorPlayer(**{"start": 4, "end": 7, "frequency_hz": 100.0, "cycles": 2, **settings})  # type: ignore[arg-type]


@pytest.mark.parametrize(("ends", "cells"), [("exclusive", [4, 5, 6]), ("inclusive", [4, 5, 6, 7])])
def test_cells_are_played_in_turn_as_often_as_asked(ends: Ends, cells: list[int]) -> None:
    """Both readings of a range's end; each cell is held for a period, the last one too, and the run is over."""
    unit = player(ends=ends)
    unit.run(10.0)
    steps = list(unit.due(10.0 + 0.01 * (2 * len(cells)) - 0.001))
    assert [cell for _, cell in steps] == 2 * cells
    np.testing.assert_allclose([time_s for time_s, _ in steps], 10 + 0.01 * np.arange(2 * len(cells)))
    assert unit.running
    assert not list(unit.due(10.0 + 0.01 * (2 * len(cells)) + 0.001))
    assert not unit.running
    assert unit.index == cells[-1]


@pytest.mark.parametrize(
    ("kind", "cells"), [(Trigger.RISING_EDGE, [4, 5, 6, 4]), (Trigger.BOTH_EDGES, [4, 5, 6, 4, 5, 6])]
)
def test_edges_take_one_cell_each(kind: Trigger, cells: list[int]) -> None:
    """The run command takes the first cell, then each rising edge, or each edge, one more; earlier ones are lost."""
    unit = player(external=kind)
    unit.trigger(np.array([-0.1]), np.array([-0.05]))
    unit.run(0.0)
    rises = np.array([0.5, 0.6, 0.7])
    unit.trigger(rises, rises + 0.01)
    assert [cell for _, cell in unit.due(0.55)] == cells[: 2 if kind is Trigger.RISING_EDGE else 3]
    assert [cell for _, cell in unit.due(2.0)][-1] == cells[-1]
    assert unit.index == cells[-1]


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


def pulse(device: MirrorDevice, *rises_s: float) -> None:
    """Short pulses at the trigger input."""
    device.state.trigger(np.array(rises_s), np.array(rises_s) + 1e-4)


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


def test_a_cameras_pulses_step_through_the_path() -> None:
    """The first position is taken at the run command, each pulse takes the next; pulses may lie in the future."""
    clock = ManualClock()
    device = loaded(clock, Trigger.RISING_EDGE)
    run(device)
    clock.advance(5.0)
    np.testing.assert_allclose(device.positions(clock.now()), PATH[0], atol=1e-6)
    pulse(device, clock.now())
    clock.advance(1.0)
    np.testing.assert_allclose(device.positions(clock.now()), PATH[1], atol=1e-6)
    pulse(device, clock.now() + 1.0, clock.now() + 2.0)
    clock.advance(3.0)
    np.testing.assert_allclose(device.positions(clock.now() - np.array([2.01, 1.01, 0.0])), PATH[1:], atol=1e-6)


def test_the_log_holds_the_true_positions() -> None:
    """Rows at the set rate, of the registers chosen, from the run command on; it fills and then stops by itself."""
    clock = ManualClock(3.0)
    device = loaded(clock)
    chosen: dict[int, Value] = {log_slot(0): FEEDBACK_X, log_slot(1): FEEDBACK_Y, LOG_RATE: 1000.0}
    do(device, set_values(chosen))
    do(device, set_value(LOG_RUN, 1))
    run(device)
    clock.advance(0.0995)
    do(device, set_value(LOG_RUN, 0))
    clock.advance(1.0)
    rows = [ask(device, get_vector(log_slot(slot), 40, 10)).payload for slot in (0, 1)]
    times = 3.0 + np.arange(40, 50) / 1000
    read = np.stack([np.frombuffer(row, ">f4") for row in rows], axis=-1)
    np.testing.assert_allclose(read, expected(times, 3.0), atol=1e-7)
    assert len(ask(device, get_vector(log_slot(0), 95, 5)).payload) == 20
    beyond = get_vector(log_slot(0), 96, 5)
    assert ask(device, beyond) == refuse(beyond.command, ErrorCode.VECTOR_INDEX)
