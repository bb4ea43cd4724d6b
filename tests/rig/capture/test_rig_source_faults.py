"""Captures that break: nothing acknowledged is lost or taken twice, and nothing is sent to a rig of unknown state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.capture.capture_journal import JOURNAL
from pipeline.rig.devices import DeviceGone, DeviceRefused, StateUnknown
from pipeline.rig.emulator.fault_names import CameraFault, CameraFaults
from pipeline.source import Line
from tests.rig.small_rig import COARSE, FINE, SmallRig, small_rig, small_source


def assert_same(found: list[Line], first: int = 0) -> None:
    """The numbers of the simulated source's lines, in order."""
    expected = list(small_source().lines(FINE, first))
    assert [line.number for line in found] == [line.number for line in expected]
    np.testing.assert_array_equal([line.data for line in found], [line.data for line in expected])
    assert all(line.valid for line in found)


class KilledError(BaseException):
    """The process ends here."""


@dataclass
class KeptUntil(KeptInMemory):
    """Files that do something as soon as bytes with a mark come, or of a file called so; once for each mark."""

    acts: dict[bytes, Callable[[], None]] = field(default_factory=dict)

    def append(self, name: str, data: bytes) -> None:
        """Act, then keep."""
        for mark in [mark for mark in self.acts if mark in data or name.encode().endswith(mark)]:
            self.acts.pop(mark)()
        super().append(name, data)


def test_cut_cube_is_taken_again_from_its_first_missing_line():
    """Whole lines of a cube that was cut off count; the others are captured again, with the same numbers."""
    with small_rig(faults={CameraFault.CUT_CUBE: 1}) as rig:
        assert_same(list(rig.source().lines(FINE)))
        assert [said.split("_")[-1].split('"')[0] for said in rig.captures] == ["0", "15"]


def test_cubes_that_are_always_cut_end_the_sweep():
    """Two captures in a row without a new line are enough; the message says what is kept."""
    with small_rig(faults={CameraFault.CUT_CUBE: 99}, vector_pairs=2) as rig:
        source = rig.source()
        with pytest.raises(RigError, match=r"2 captures in a row gave no line 0; .*The 0 lines before it are kept"):
            list(source.lines(FINE))
        assert len(rig.captures) == 2


def test_captures_that_are_cut_one_after_the_other_go_on():
    """Each gave lines, so none of them is in vain, however many are cut."""
    with small_rig(faults={CameraFault.CUT_CUBE: 3}, vector_pairs=6) as rig:
        assert_same(list(rig.source().lines(FINE)))
        assert [said.split("_")[-1].split('"')[0] for said in rig.captures] == ["0", "3", "6", "9", "14"]


def breaks_off(faults: CameraFaults) -> None:
    """Have the next transfer but one break off: the header, which just came, is read once more."""
    faults.left, faults.passes = {CameraFault.BREAKS_OFF: 1}, 1


def test_broken_transfer_goes_on_in_the_next_process():
    """The camera goes away in the midst of a file: what has come is kept, and nothing is captured again."""
    with small_rig() as rig:
        faults = rig.emulated.camera.faults
        kept = KeptUntil(
            acts={
                b"raw_0.hdr": lambda: breaks_off(faults),
                b"raw_0": lambda: faults.left.update({CameraFault.REFUSES_FILES: 9}),
            }
        )
        with pytest.raises(DeviceGone, match=r"bytes of \S+/raw_0 are kept, and fetching again goes on there"):
            list(rig.source(kept).lines(FINE))
        half = next(len(data) for name, data in kept.files.items() if name.endswith("/raw_0"))
        assert 0 < half < FINE.lines * 48 * 3 * 2
        faults.left.clear()
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_lines_given_are_not_given_again():
    """A process that goes on from line 5 of a capture fetches nothing that it has, and captures nothing."""
    with small_rig() as rig:
        kept = KeptInMemory()
        lines = rig.source(kept).lines(FINE)
        assert [next(lines).number for _ in range(5)] == list(range(5))
        lines.close()  # type: ignore[attr-defined]
        assert_same(list(rig.source(kept).lines(FINE, first=5)), 5)
        assert len(rig.captures) == 1


@pytest.mark.parametrize("mark", [b'"what": "end"', b"frameIndex_0.txt", b"origin"])
def test_killed_process_is_gone_on_with(mark: bytes):
    """Killed before a capture's end is taken down, a file has come, or a line is given: the capture is used."""

    def kill() -> None:
        raise KilledError

    with small_rig() as rig:
        kept = KeptUntil(acts={mark: kill})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_torn_journal_is_read_up_to_the_tear():
    """A record that was half written when the power failed counts as not written; the next one is whole again."""
    with small_rig() as rig:
        kept = KeptInMemory()
        list(rig.source(kept).lines(FINE))
        kept.append(JOURNAL, b'{"what": "spent", "fol')
        assert_same(list(rig.source(kept).lines(FINE)))
        list(rig.source(kept).lines(COARSE))
        assert list(rig.source(kept).lines(COARSE))
        assert len(rig.captures) == 2


def lose_an_edge(rig: SmallRig) -> None:
    """Take one pulse from the mirror's trigger input, once."""
    whole, left = rig.emulated.mirror.pulses, [1]

    def fewer(from_s: float, to_s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        found = whole(from_s, to_s)
        if len(found) > 3 and left:
            left.pop()
            return np.delete(found, 3, axis=0)
        return found

    rig.emulated.mirror.pulses = fewer


def test_lost_edge_is_seen_and_the_lines_taken_again():
    """The mirror's index tells that it stepped once less: none of these lines is believed."""
    with small_rig() as rig:
        lose_an_edge(rig)
        assert_same(list(rig.source().lines(FINE)))
        assert len(rig.captures) == 2


def test_capture_that_the_camera_lost_is_taken_again():
    """A folder that was taken away between two processes is no reason to stop."""
    with small_rig() as rig:
        kept = KeptInMemory()
        lines = rig.source(kept).lines(FINE)
        next(lines)
        lines.close()  # type: ignore[attr-defined]
        rig.emulated.camera.captures[-1].folder = "/captured/elsewhere"
        assert_same(list(rig.source(kept).lines(FINE, first=1)), 1)
        assert len(rig.captures) == 2


@dataclass
class SlowEye:
    """Has the camera look at frames only once a clock stands later than that."""

    rig: SmallRig
    after_s: float

    def __post_init__(self) -> None:
        camera = self.rig.emulated.camera
        camera.aside, command = True, camera.command

        def later(line: str) -> object:
            while self.rig.line.clock.now() > self.after_s and camera.look_on():
                pass
            return command(line)

        camera.command = later  # type: ignore[method-assign, assignment]


def test_camera_that_writes_for_long_is_waited_for():
    """Frames that are still being written after the capture's time are not given up and taken again."""
    with small_rig() as rig:
        SlowEye(rig, rig.line.clock.now() + 60)
        assert_same(list(rig.source().lines(FINE)))
        assert len(rig.captures) == 1


def test_camera_that_never_ends_is_told_and_gone_on_with():
    """Two minutes after it was told to stop that is an error; what it has by the next time is fetched then."""
    with small_rig() as rig:
        kept, eye = KeptInMemory(), SlowEye(rig, np.inf)
        with pytest.raises(RigError, match=r"still captures /captured/fine-3\S+, 120 s after it was told to stop"):
            list(rig.source(kept).lines(FINE))
        eye.after_s = 0.0
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_wrong_password_costs_no_capture():
    """Files that are not given to this user stay where they are: with another password the capture is used."""
    with small_rig() as rig:
        kept, right = KeptInMemory(), type(rig.line).files
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(rig.line), "files", property(lambda line: replace(right.fget(line), password="x")))
            with pytest.raises(DeviceRefused, match="look at user and password"):
                list(rig.source(kept).lines(FINE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_full_camera_ends_the_sweep_at_once():
    """A capture that is refused is not asked for again; the mirror does not go on waiting for edges."""
    with small_rig(faults={CameraFault.FULL: 1}) as rig:
        with pytest.raises(DeviceRefused, match="disk full"):
            list(rig.source().lines(FINE))
        assert len(rig.captures) == 1
        assert not any(player.running for player in rig.emulated.mirror.state.players)


def test_nothing_is_sent_to_a_rig_of_unknown_state():
    """A capture whose reply is lost freezes the rig for this process, whoever holds the source; another may go on."""
    with small_rig(faults={CameraFault.SILENT: 1}) as rig:
        rig.emulated.camera.faults.passes = 2  # configure and listFiles come before the capture
        source, kept = rig.source(), KeptInMemory()
        with pytest.raises(StateUnknown, match="not sent again"):
            list(source.keeping(kept).lines(FINE))
        said = len(rig.emulated.camera.commands)
        with pytest.raises(StateUnknown, match="nothing more is sent to the rig"):
            list(source.keeping(kept).lines(FINE))
        assert len(rig.emulated.camera.commands) == said
