"""Positions in the precision of the wire, uploads and their read-back."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import PoseError, RigError, ShapeError
from spectralzoom.pipeline.geometry.mirror import wire_positions
from spectralzoom.pipeline.rig.device_settings import SurveyRig
from spectralzoom.pipeline.rig.fakes import FakeClock
from spectralzoom.pipeline.rig.mirror_controller import MirrorController
from spectralzoom.pipeline.rig.pro_mode import SET_VALUES, SET_VECTOR, Frame, FrameReader, encode
from spectralzoom.pipeline.rig.transports import DeadlinePassed


@given(st.floats(0, 1), st.floats(-7, 7))
def test_no_position_is_rounded_beyond_the_rim(radius: float, angle: float):
    """Positions stay in the disk, move by at most 2e-7, and are not rounded twice."""
    given_ = np.array([[radius * np.cos(angle), radius * np.sin(angle)]])
    rounded = wire_positions(given_)
    assert rounded.dtype == np.float32
    assert np.hypot(*rounded[0].astype(np.float64)) <= 1
    np.testing.assert_allclose(rounded, given_, atol=2e-7)
    np.testing.assert_array_equal(wire_positions(rounded), rounded)


def test_a_float32_position_on_the_rim_is_accepted():
    """A float32 position that rounding put beyond the rim is moved back to it."""
    beyond = np.array([[0.6, 0.8]], np.float32) * np.float32(1 + 3e-7)
    assert np.hypot(*wire_positions(beyond)[0].astype(np.float64)) <= 1


@pytest.mark.parametrize(("x", "y"), [(1.0001, 0), (0.8, 0.8), (float("nan"), 0), (0, float("inf"))])
def test_targets_outside_of_the_disk_are_refused(x: float, y: float):
    """Positions beyond the rim or that are not finite raise an error with their index."""
    with pytest.raises(PoseError, match=r"index 1\)"):
        wire_positions([(0, 0), (x, y)])


@pytest.mark.parametrize("shape", [(0, 2), (2,), (3, 3), (2, 2, 2)])
def test_a_path_has_two_columns(shape: tuple[int, ...]):
    """Any shape but (position, 2), and an empty path, are refused."""
    with pytest.raises(ShapeError, match=r"\(position, 2\), at least one, got shape"):
        wire_positions(np.zeros(shape))


BAUD = 115200


class Memory:
    """A vector memory behind a transport, with ``wrong`` cells that it does not keep, and the delays of the wire."""

    port = "memory"

    def __init__(self, wrong: tuple[int, ...] = (), deaf_after: int = 10**9) -> None:
        self.clock = FakeClock()
        self.cells = bytearray(0x10000)
        self.frames: list[Frame] = []
        self._wrong = wrong
        self._deaf_after = deaf_after
        self._reader = FrameReader()
        self._reply = b""
        self.passed = 0  # bytes, in both directions

    def write(self, data: bytes) -> None:
        """Accept a frame and prepare the reply."""
        self.clock.sleep(len(data) * 10 / BAUD)
        self.passed += len(data)
        (frame,) = self._reader.feed(data)
        assert isinstance(frame, Frame)
        if frame.command == SET_VALUES:  # the path is halted before
            self._reply = encode(Frame(frame.command))
            return
        self.frames.append(frame)
        _, offset, size = struct.unpack(">HHB", frame.payload[:5])
        if len(self.frames) > self._deaf_after:
            return
        if frame.command == SET_VECTOR:
            self.cells[offset : offset + size] = frame.payload[5:]
            for cell in self._wrong:
                if offset <= 4 * cell < offset + size:
                    self.cells[4 * cell + 3] ^= 1
            self._reply = encode(Frame(frame.command))
        else:
            self._reply = encode(Frame(frame.command, bytes(self.cells[offset : offset + size])))

    def read(self, at_most: int, deadline: float) -> bytes:
        """Return the reply, or wait until the deadline."""
        reply, self._reply = self._reply, b""
        self.passed += len(reply)
        self.clock.sleep(len(reply) * 10 / BAUD if reply else deadline - self.clock.now())
        return reply

    def close(self) -> None:
        """Do nothing."""


def mirror(memory: Memory) -> MirrorController:
    """Return a controller in pro mode over the memory."""
    return MirrorController(memory, SurveyRig(), memory.clock)


def path(count: int) -> NDArray[np.float32]:
    """Return positions on a spiral, (position, 2)."""
    turn = np.linspace(0, 40, count)
    return wire_positions(np.stack([np.cos(turn), np.sin(turn)], axis=-1) * (turn / 40)[:, None])


@given(st.integers(1, 120))
@settings(max_examples=30, deadline=None)
def test_an_uploaded_path_is_stored(count: int):
    """Paths of any length arrive complete, ten cells per frame."""
    memory = Memory()
    cells = path(count).T.astype(">f4").tobytes()
    mirror(memory).load_path(path(count))
    assert memory.cells[: len(cells)] == cells
    assert not any(memory.cells[len(cells) :])
    written = [frame for frame in memory.frames if frame.command == SET_VECTOR]
    assert len(written) == -(-2 * count // 10)


@pytest.mark.parametrize("cell", [0, 98, 101, 199])
def test_a_wrong_cell_is_found_by_reading_back(cell: int):
    """Reading back finds errors at the ends of both channels, where ranges fail most often."""
    first = cell // 10 * 10
    with pytest.raises(RigError, match=rf"cells {first} to {first + 10} of .* on memory hold other values"):
        mirror(Memory(wrong=(cell,))).load_path(path(100))


@given(st.integers(1, 400))
@settings(max_examples=30, deadline=None)
def test_few_frames_are_read_back(count: int):
    """First and last frame are always read, and at most five frames more than a tenth."""
    memory = Memory()
    mirror(memory).load_path(path(count))
    places = [frame.payload[2:4] for frame in memory.frames]
    written, read = places[: -(-count // 5)], places[-(-count // 5) :]
    assert {written[0], written[-1]} <= set(read) <= set(written)
    assert len(read) <= len(written) / 10 + 5


def test_a_lost_frame_ends_the_upload():
    """A write is not retried, and the message names its cells."""
    memory = Memory(deaf_after=3)
    with pytest.raises(DeadlinePassed, match="no answer to writing cells 30 to 40 from memory"):
        mirror(memory).load_path(path(100))
    assert len(memory.frames) == 4


def test_an_upload_takes_the_wire_time():
    """1500 positions are 300 frames of 52 bytes and acknowledgements of 7; reading back takes a tenth of it again.

    Escaped bytes add less than 1 %. The clock advances by exactly the time of all bytes.
    """
    memory = Memory()
    mirror(memory).load_path(path(1500))
    plain_s, wire_s = 300 * (52 + 7) * 10 / BAUD, memory.passed * 10 / BAUD
    assert wire_s == pytest.approx(plain_s * 1.11, rel=0.02)
    assert memory.clock.now() == pytest.approx(wire_s)
