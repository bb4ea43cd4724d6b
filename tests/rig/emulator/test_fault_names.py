"""Faults by name, for both devices."""

from __future__ import annotations

import pytest

from pipeline.errors import SettingsError
from pipeline.rig.emulator.fault_names import KINDS, CameraFault, fault_table, read_faults


def test_every_fault_of_the_table_can_be_asked_for() -> None:
    """Names are apart, and each builds the fault that it names."""
    names = [name for name, _, _ in fault_table()]
    assert len(set(names)) == len(names) == len(KINDS) + len(CameraFault)
    mirror, camera = read_faults([f"{name}:3" for name in names])
    assert len(mirror) == len(KINDS)
    assert camera.left == dict.fromkeys(CameraFault, 1)


def test_camera_fault_given_twice_strikes_twice() -> None:
    """Each with a seed of its own."""
    assert read_faults(["camera-full:1", "camera-full:2"])[1].left == {CameraFault.FULL: 2}


@pytest.mark.parametrize("word", ["lost", "camera-full:x", "camera-full:-1", "mute:one", "camera"])
def test_words_that_name_no_fault_are_refused(word: str) -> None:
    """With the word that was wrong."""
    with pytest.raises(SettingsError, match=word.partition(":")[0]):
        read_faults([word])


def test_a_name_that_is_nearly_right_is_told() -> None:
    """As keys of the settings are."""
    with pytest.raises(SettingsError, match=r"no fault 'camera-ful'; did you mean camera-full\?"):
        read_faults(["camera-ful"])
