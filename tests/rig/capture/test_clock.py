"""Clocks: one that runs by itself, one that is turned."""

from __future__ import annotations

import pytest

from pipeline.errors import SettingsError
from pipeline.rig.devices import SYSTEM_CLOCK, ManualClock


def test_sleeping_turns_a_manual_clock():
    """Time passes by sleeping and by advancing, and never backwards."""
    clock = ManualClock(5.0)
    clock.sleep(1.5)
    clock.sleep(-3.0)
    clock.advance(0.5)
    assert clock.now() == 7.0
    with pytest.raises(SettingsError, match="only goes forward, got -1"):
        clock.advance(-1)


def test_the_system_clock_never_goes_back():
    """The system's clock goes on, also where a wait of nothing or less is asked for."""
    before = SYSTEM_CLOCK.now()
    SYSTEM_CLOCK.sleep(-1)
    SYSTEM_CLOCK.sleep(1e-4)
    assert SYSTEM_CLOCK.now() > before
