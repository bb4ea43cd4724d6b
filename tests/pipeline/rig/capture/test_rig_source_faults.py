"""Captures that break, by fault or kill: nothing acknowledged is lost or taken twice, and what is left is used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture_runner import JOURNAL
from pipeline.rig.transports import DeviceGone, DeviceRefused, StateUnknown
from pipeline.source import Line
from tests.pipeline.rig.camera_faults import CameraFault
from tests.pipeline.rig.mirror_faults import make_fault
from tests.pipeline.rig.small_rig import COARSE, FINE, SmallRig, assert_simulated, small_rig, small_source


def assert_same(found: list[Line], first: int = 0) -> None:
    """The simulated source's numbers, all valid."""
    assert_simulated(found, FINE, first)
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


def test_cubes_that_are_always_cut_end_the_sweep():
    """Two captures in a row without a new line are enough; the message says what is kept."""
    with small_rig(faults={CameraFault.CUT_CUBE: 99}, vector_pairs=2) as rig:
        source = rig.source()
        with pytest.raises(RigError, match=r"2 captures in a row gave no line 0; .*The 0 lines before it are kept"):
            list(source.lines(FINE))
        assert len(rig.captures) == 2


@pytest.mark.parametrize(
    ("cut", "pairs", "begun"), [(1, 1500, ["0", "15"]), (3, 6, ["0", "3", "6", "9", "14"])], ids=["once", "often"]
)
def test_cut_cubes_are_taken_again_from_their_first_missing_line(cut: int, pairs: int, begun: list[str]):
    """Whole lines of a cube that was cut off count, so none is in vain; the others come with the same numbers."""
    with small_rig(faults={CameraFault.CUT_CUBE: cut}, vector_pairs=pairs) as rig:
        assert_same(list(rig.source().lines(FINE)))
        assert [said.split("_")[-1].split('"')[0] for said in rig.captures] == begun


def test_broken_transfer_goes_on_in_the_next_process():
    """The camera goes away in the midst of a file: what has come is kept, and nothing is captured again."""
    with small_rig() as rig:
        faults = rig.emulated.camera.faults
        kept = KeptUntil(
            acts={
                b"raw_0.hdr": lambda: setattr(faults, "left", {CameraFault.BREAKS_OFF: 1}),
                b"raw_0": lambda: faults.left.update({CameraFault.REFUSES_FILES: 9}),
            }
        )
        with pytest.raises(DeviceGone, match=r"bytes of \S+/raw_0 are kept, and a later fetch continues there"):
            list(rig.source(kept).lines(FINE))
        half = next(len(data) for name, data in kept.files.items() if name.endswith("/raw_0"))
        assert 0 < half < FINE.lines * 48 * 3 * 2
        faults.left.clear()
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


kill = Mock(side_effect=KilledError)


@pytest.mark.parametrize("mark", [b'"what": "end"', b"frameIndex_0.txt", b"origin"])
def test_killed_process_is_gone_on_with(mark: bytes):
    """Killed before a capture's end is taken down, a file has come, or a line is given: the capture is used."""
    with small_rig() as rig:
        kept = KeptUntil(acts={mark: kill})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_lost_edge_is_seen_and_the_lines_taken_again():
    """The mirror's index tells that it stepped once less: none of these lines is believed."""
    with small_rig() as rig:
        whole, left = rig.emulated.mirror.pulses, [1]

        def fewer(from_s: float, to_s: float) -> NDArray[np.float64]:
            found = whole(from_s, to_s)
            if len(found) > 3 and left:
                left.pop()
                return np.delete(found, 3)
            return found

        rig.emulated.mirror.pulses = fewer
        assert_same(list(rig.source().lines(FINE)))
        assert len(rig.captures) == 2


@pytest.mark.parametrize("lost", [False, True], ids=["there", "taken away"])
def test_lines_given_are_not_given_again(lost: bool):
    """A process that goes on from line 5 captures nothing, unless the folder was taken away in between."""
    with small_rig() as rig:
        kept = KeptInMemory()
        lines = rig.source(kept).lines(FINE)
        assert [next(lines).number for _ in range(5)] == list(range(5))
        lines.close()  # type: ignore[attr-defined]
        if lost:
            rig.emulated.camera.captures[-1].folder = "/captured/elsewhere"
        assert_same(list(rig.source(kept).lines(FINE, first=5)), 5)
        assert len(rig.captures) == 1 + lost


@dataclass
class SlowEye:
    """Has the camera look at frames only once a clock stands later than that."""

    rig: SmallRig
    after_s: float

    def __post_init__(self) -> None:
        camera = self.rig.emulated.camera
        camera.aside, command = True, camera.command

        def later(line: str) -> object:
            while self.rig.line.clock.now() > self.after_s and camera.keep_looking():
                pass
            return command(line)

        camera.command = later  # type: ignore[method-assign, assignment]


def test_camera_that_writes_for_long_is_waited_for():
    """Frames that come late are not taken again; two minutes after it was told to stop it is told."""
    with small_rig() as rig:
        SlowEye(rig, rig.line.clock.now() + 60)
        assert_same(list(rig.source().lines(FINE)))
        assert len(rig.captures) == 1
    with small_rig() as rig:
        kept, eye = KeptInMemory(), SlowEye(rig, np.inf)
        with pytest.raises(RigError, match=r"still captures /captured/fine-3\S+, 120 s after it was stopped"):
            list(rig.source(kept).lines(FINE))
        eye.after_s = 0.0
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_wrong_password_costs_no_capture():
    """Files that are not given to this user stay where they are: with another password the capture is used."""
    with small_rig() as rig:
        kept = KeptInMemory()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rig.line, "files", replace(rig.line.files, password="x"))
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
        assert not any(playback.running for playback in rig.emulated.mirror.state.playbacks)


def test_nothing_is_sent_to_a_rig_of_unknown_state():
    """A capture whose reply is lost freezes the rig for this process, whoever holds the source; another may go on."""
    with small_rig(faults={CameraFault.SILENT: 1}) as rig:
        rig.emulated.camera.faults.passes = 1  # configure comes before the capture
        source, kept = rig.source(), KeptInMemory()
        with pytest.raises(StateUnknown, match="not sent again"):
            list(source.keeping(kept).lines(FINE))
        said = len(rig.emulated.camera.commands)
        with pytest.raises(StateUnknown, match="the rig gets no further command"):
            list(source.keeping(kept).lines(FINE))
        assert len(rig.emulated.camera.commands) == said


def killed_amid(rig: SmallRig, kept: KeptInMemory, patch: pytest.MonkeyPatch | None = None) -> None:
    """Begin to capture the sweep, and die while it is waited for; with ``patch`` before the camera can be stopped."""
    if patch is not None:
        patch.setattr(HeadwallCamera, "stop", lambda _: kill())
    with pytest.raises(KilledError):
        list(rig.source(kept).saying(lambda words: kill() if words.startswith("capturing") else None).lines(FINE))


def test_capture_that_still_runs_is_waited_for():
    """Killed while the camera captures: the next process waits for its end and has all of it, counted and tied."""
    with small_rig() as rig:
        kept = KeptInMemory()
        SlowEye(rig, rig.line.clock.now() + 60)
        with pytest.MonkeyPatch.context() as patch:
            killed_amid(rig, kept, patch)
        assert rig.emulated.camera.is_capturing()
        source = rig.source(kept)
        assert_same(list(source.lines(FINE)))
        assert len(rig.captures) == 1
        (told,) = source.record["captures"]
        assert (told["method"], told["residual_px"]) == ("trigger", 0.0)


def test_error_while_it_captures_stops_both():
    """Whoever is interrupted leaves neither a camera that captures nor a mirror that waits for edges."""
    with small_rig() as rig:
        killed_amid(rig, KeptInMemory())
        assert not rig.emulated.camera.is_capturing()
        assert rig.emulated.camera.captures[0].due(1e9) < FINE.lines
        assert not any(playback.running for playback in rig.emulated.mirror.state.playbacks)


def test_capture_by_its_own_clock_is_not_counted():
    """Killed before its log is read: lines are tied by the commands' times, and no index is taken for a count."""
    with small_rig(pulses="none", log_samples=16000) as rig:
        kept = KeptUntil(acts={b'"what": "end"': kill})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        source = rig.source(kept)
        assert len(list(source.lines(FINE))) == FINE.lines
        assert [one["method"] for one in source.record["captures"]] == ["command"]


@pytest.mark.parametrize("held", ["of a later folder", "as it is", "of another file"])
def test_camera_that_was_emptied_in_between_is_gone_on_with(held: str):
    """Its disk was cleared, or it is another: frames and lines that it has no more are taken again."""
    earlier = 0 if held == "of a later folder" else 3
    kept = KeptInMemory()
    with small_rig() as rig:
        source = rig.source(kept)
        source.references(FINE)
        for _ in range(earlier):
            list(rig.source().lines(COARSE))
        killed_amid(rig, kept)
    if held == "of another file":
        kept.files["/captured/references_000000/whiteReference"][-1] ^= 1
    with small_rig() as rig:
        for _ in range(3 - earlier):
            list(rig.source().lines(COARSE))
        source = rig.source(kept)
        found = source.references(FINE)
        assert_same(list(source.lines(FINE)))
    wanted = small_source().references(FINE)
    assert abs(found.white - wanted.white).max() <= 1 / 64
    assert source.record["captures"][0]["spent"]


@pytest.mark.parametrize("scan_pass", ["lines", "references"])
def test_mirror_that_never_rests_is_not_captured_with(scan_pass: str):
    """Neither a path nor a look at rest is begun while the mirror is not there yet."""
    with small_rig(mirror_faults=[make_fault("never-stable", at=0)]) as rig:
        source = rig.source()
        with pytest.raises(RigError, match="is not at rest after"):
            list(source.lines(FINE)) if scan_pass == "lines" else source.references(FINE)
        assert not any(said.startswith("capture(") for said in rig.emulated.camera.commands)


def test_end_that_the_journal_has_lost_is_not_read_from_another_path():
    """The mirror has played another path since: what it stands at now is not taken for the end of the first."""
    with small_rig() as rig:
        kept = KeptInMemory()
        list(rig.source(kept).lines(FINE))
        list(rig.source().lines(COARSE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 2
        at = bytes(kept.files[JOURNAL]).index(b'"what": "end"')
        kept.files[JOURNAL][at + 3] ^= 1
        source = rig.source(kept)
        assert_same(list(source.lines(FINE)))
        assert len(rig.captures) == 3
        assert "its end may be in a damaged line" in source.record["captures"][0]["spent"]
        assert "is ignored: it has changed" in source.record["journal"][0]
