"""Uploads: frames of ten cells, what is read back, and what it costs on the wire."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import RigError
from pipeline.rig.clock import ManualClock
from pipeline.rig.device_errors import DeadlinePassed
from pipeline.rig.mirror.mirror_requests import ProLink
from pipeline.rig.mirror.mirror_settings import Patience
from pipeline.rig.mirror.path_player import frames_to_check, upload
from pipeline.rig.mirror.pro_mode import Command, Frame, FrameReader, encode
from pipeline.rig.mirror.pro_payloads import acknowledge, read_vector
from pipeline.rig.mirror.steering import ReadBack, as_cells, wire_positions
from pipeline.rig.mirror.transactions import BITS_PER_BYTE, Wire

BAUD = 115200


class Memory:
    """A vector memory behind a transport: keeps what is written, but for ``wrong`` cells, and takes the wire's time."""

    port = "memory"

    def __init__(self, wrong: tuple[int, ...] = (), deaf_after: int = 10**9) -> None:
        self.clock = ManualClock()
        self.cells = bytearray(0x10000)
        self.frames: list[Frame] = []
        self._wrong, self._deaf_after = wrong, deaf_after
        self._reader, self._reply = FrameReader(), b""

    def write(self, data: bytes, deadline: float) -> None:
        """Take a frame and prepare the reply."""
        self.clock.sleep(len(data) * 10 / BAUD)
        (frame,) = self._reader.feed(data)
        assert isinstance(frame, Frame)
        self.frames.append(frame)
        _, offset, size, cells = read_vector(frame.payload)
        if len(self.frames) > self._deaf_after:
            return
        if frame.command == Command.SET_VECTOR:
            self.cells[offset : offset + size] = cells
            for cell in self._wrong:
                if offset <= 4 * cell < offset + size:
                    self.cells[4 * cell + 3] ^= 1
            self._reply = encode(acknowledge(frame.command))
        else:
            self._reply = encode(Frame(frame.command, bytes(self.cells[offset : offset + size])))

    def read(self, at_most: int, deadline: float) -> bytes:
        """Give the reply, or wait in vain."""
        reply, self._reply = self._reply, b""
        self.clock.sleep(len(reply) * 10 / BAUD if reply else deadline - self.clock.now())
        return reply

    def drain(self) -> bytes:
        """Nothing is ever left."""
        return b""

    def close(self) -> None:
        """Nothing to let go of."""


def link(memory: Memory) -> ProLink:
    """Pro mode over the memory."""
    return ProLink(Wire(memory, memory.clock, Patience()))


def path(count: int) -> bytes:
    """Cells of positions on a spiral."""
    turn = np.linspace(0, 40, count)
    return as_cells(wire_positions(np.stack([np.cos(turn), np.sin(turn)], axis=-1) * (turn / 40)[:, None]))


@given(st.integers(1, 120), st.sampled_from(["none", "sampled", "all"]))
@settings(max_examples=30, deadline=None)
def test_what_was_sent_is_what_is_held(count: int, read_back: ReadBack):
    """Any path arrives whole, ten cells to a frame, and progress goes up to all of it."""
    memory, said = Memory(), []
    cells = path(count)
    upload(link(memory), cells, read_back, lambda done, total: said.append((done, total)))
    assert memory.cells[: len(cells)] == cells
    assert not any(memory.cells[len(cells) :])
    written = [frame for frame in memory.frames if frame.command == Command.SET_VECTOR]
    assert len(written) == -(-2 * count // 10)
    assert [done for done, _ in said] == sorted({done for done, _ in said})
    assert said[-1][0] == said[-1][1] == sum(total for _, _, total, _ in map(_cells, memory.frames)) // 4


def _cells(frame: Frame) -> tuple[int, int, int, bytes]:
    return read_vector(frame.payload)


@pytest.mark.parametrize("cell", [0, 9, 10, 57, 99, 100, 149, 199])
def test_a_wrong_cell_is_named(cell: int):
    """Reading all back finds any cell, and says which position and axis it is of."""
    axis, position = ("X", cell) if cell < 100 else ("Y", cell - 100)
    with pytest.raises(RigError, match=rf"cell {cell} of .* on memory \({axis} of position {position}\) holds"):
        upload(link(Memory(wrong=(cell,))), path(100), "all")


@pytest.mark.parametrize("cell", [0, 98, 101, 199])
def test_a_sample_finds_the_ends_of_both_channels(cell: int):
    """Where ranges are most often wrong, a sample looks, too."""
    with pytest.raises(RigError, match=f"cell {cell} of"):
        upload(link(Memory(wrong=(cell,))), path(100), "sampled")


def test_without_reading_back_nothing_is_found():
    """The choice is a choice: nothing is asked."""
    memory = Memory(wrong=(5,))
    upload(link(memory), path(100), "none")
    assert {frame.command for frame in memory.frames} == {Command.SET_VECTOR}


@given(st.integers(1, 400))
def test_samples_are_few_and_within(frames: int):
    """First and last frame are always read, and not many more than a tenth."""
    checked = frames_to_check(frames, "sampled")
    assert {0, frames - 1} <= set(checked) <= set(range(frames))
    assert len(checked) <= frames / 10 + 5
    assert frames_to_check(frames, "none") == []
    assert frames_to_check(frames, "all") == list(range(frames))


def test_a_lost_frame_ends_the_upload():
    """A write is not sent again; the message names the cells."""
    memory = Memory(deaf_after=3)
    with pytest.raises(DeadlinePassed, match="no answer to writing cells 30 to 40 from memory"):
        upload(link(memory), path(100), "all")
    assert len(memory.frames) == 4


@pytest.mark.parametrize(("read_back", "share"), [("none", 0.0), ("sampled", 0.11), ("all", 1.0)])
def test_an_upload_takes_the_wire_time(read_back: ReadBack, share: float):
    """1500 positions are 300 frames of 52 bytes and acknowledgements of 7, and reading back costs as much again.

    Bytes that need an escape come on top, below 1 %; nothing else does: the clock passed by what the wire took.
    """
    memory = Memory()
    subject = link(memory)
    upload(subject, path(1500), read_back)
    plain_s = 300 * (52 + 7) * 10 / BAUD
    wire_s = (subject.wire.bytes_sent + subject.wire.bytes_received) * BITS_PER_BYTE / BAUD
    assert wire_s == pytest.approx(plain_s * (1 + share), rel=0.02)
    assert memory.clock.now() == pytest.approx(wire_s)
