"""Registers and status bits against the published numbers."""

from __future__ import annotations

import pytest

from pipeline.rig.mirror.registers import FEEDBACK_X, FEEDBACK_Y, VECTOR_MEMORY, Status, VectorRegister, X, Y, log_slot


def test_registers_have_the_published_ids():
    """Ids are system times 256 plus number."""
    assert (X.static_xy, Y.static_xy) == (0x5002, 0x5102)
    assert [X.vector(register) for register in VectorRegister] == list(range(0x6800, 0x680B))
    assert Y.vector(VectorRegister.INDEX) == 0x690A
    assert (X.input, X.control, Y.input, Y.control) == (0x4000, 0x4002, 0x4005, 0x4007)
    assert (X.xy_system, Y.xy_system, X.vector_system, Y.static_system) == (0xC0, 0xC1, 0x68, 0x51)
    assert (VECTOR_MEMORY, FEEDBACK_X, FEEDBACK_Y, log_slot(5)) == (0x2600, 0x2302, 0x2303, 0x2405)


@pytest.mark.parametrize(
    ("bit", "words"),
    [
        (0, "not connected"),
        (1, "electronics are too warm"),
        (2, "mirror is too warm"),
        (3, "calibration"),
        (4, "not at rest"),
        (5, "drive is at its limit"),
        (6, "average is at"),
        (7, "trimmed"),
        (8, "was not connected"),
        (9, "electronics were"),
        (10, "mirror was too warm"),
        (11, "drive was at"),
        (12, "average was at"),
        (13, "target was trimmed"),
        (14, "bit 14, whose meaning"),
        (31, "bit 31"),
    ],
)
def test_every_bit_has_words(bit: int, words: str):
    """An operator reads what is the case, not a number."""
    status = Status(1 << bit)
    assert len(status.words) == 1
    assert words in status.words[0]
    assert f"status {1 << bit:08X}: " in status.sentence


def test_all_is_well_is_said_too():
    """No bit, no trouble."""
    assert Status(0).words == []
    assert "nothing is amiss" in Status(0).sentence
    assert not Status(0).stops_motion


@pytest.mark.parametrize("bit", range(32))
def test_only_what_holds_now_stops_motion(bit: int):
    """A head that is away, too warm or without calibration stops motion; unrest, limits and the past do not."""
    assert Status(1 << bit).stops_motion == (bit in (0, 1, 2, 3))
