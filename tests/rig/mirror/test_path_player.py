"""What plays, as registers."""

from __future__ import annotations

import pytest

from pipeline.errors import SettingsError
from pipeline.rig.mirror.path_player import Play, hold_values, run_values
from pipeline.rig.mirror.pro_payloads import set_values


def test_motions_fit_one_frame():
    """Both channels begin in one frame, which the device carries out as one."""
    assert len(set_values(hold_values(1.0, -1.0)).payload) == 50
    assert len(set_values(run_values()).payload) == 38


@pytest.mark.parametrize("play", [Play(0, 1, 1e-3), Play(0, 1500, 1e4, -1), Play(1499, 1500, 10, 2**31 - 1)])
def test_ranges_within_what_is_loaded_play(play: Play):
    """From the first position to the last, half open."""
    play.check(1500)


@pytest.mark.parametrize("play", [Play(0, 1501, 10), Play(-1, 3, 10), Play(3, 3, 10), Play(0, 3, 10, 2**31)])
def test_other_ranges_do_not(play: Play):
    """Nothing outside, nothing empty, no number that its cell does not hold."""
    with pytest.raises(SettingsError, match=r"no range of the 1500 positions|cycles of 1 or more"):
        play.check(1500)
