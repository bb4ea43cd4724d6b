"""Interrupted captures: no acknowledged line is lost or captured twice, and existing captures are used."""

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
    """Assert the simulated source's numbers, all valid."""
    assert_simulated(found, FINE, first)
    assert all(line.valid for line in found)


class KilledError(BaseException):
    """The process is killed here."""


@dataclass
class KeptUntil(KeptInMemory):
    """Files that call a function once at the first bytes with a mark, or at the first file of such a name."""

    acts: dict[bytes, Callable[[], None]] = field(default_factory=dict)

    def append(self, name: str, data: bytes) -> None:
        """Call the function of each mark, then keep the data."""
        for mark in [mark for mark in self.acts if mark in data or name.encode().endswith(mark)]:
            self.acts.pop(mark)()
        super().append(name, data)


def test_cubes_that_are_always_truncated_end_the_sweep():
    """Two captures in a row without a new line end it; the message says how many lines are kept."""
    with small_rig(faults={CameraFault.CUT_CUBE: 99}, vector_pairs=2) as rig:
        source = rig.source()
        with pytest.raises(RigError, match=r"2 captures in a row gave no line 0; .*The 0 lines before it are kept"):
            list(source.lines(FINE))
        assert len(rig.captures) == 2


@pytest.mark.parametrize(
    ("cut", "pairs", "begun"), [(1, 1500, ["0", "15"]), (3, 6, ["0", "3", "6", "9", "14"])], ids=["once", "often"]
)
def test_truncated_cubes_are_captured_again_from_the_first_missing_line(cut: int, pairs: int, begun: list[str]):
    """Whole lines of a truncated cube count. The others are captured again with the same numbers."""
    with small_rig(faults={CameraFault.CUT_CUBE: cut}, vector_pairs=pairs) as rig:
        assert_same(list(rig.source().lines(FINE)))
        assert [said.split("_")[-1].split('"')[0] for said in rig.captures] == begun


def test_an_interrupted_transfer_resumes_in_the_next_process():
    """The camera disconnects within a file: the received bytes are kept, and nothing is captured again."""
    with small_rig() as rig:
        faults = rig.emulated.camera.faults
        acts = {
            b"raw_0.hdr": lambda: setattr(faults, "left", {CameraFault.BREAKS_OFF: 1}),
            b"raw_0": lambda: faults.left.update({CameraFault.REFUSES_FILES: 9}),
        }
        kept = KeptUntil(acts=acts)
        with pytest.raises(DeviceGone, match=r"bytes of \S+/raw_0 are kept, and a later fetch continues there"):
            list(rig.source(kept).lines(FINE))
        half = next(len(data) for name, data in kept.files.items() if name.endswith("/raw_0"))
        assert 0 < half < FINE.lines * 48 * 3 * 2
        faults.left.clear()
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


kill = Mock(side_effect=KilledError)


@pytest.mark.parametrize("mark", [b'"what": "end"', b"frameIndex_0.txt", b"origin"])
def test_a_capture_is_used_after_the_process_is_killed(mark: bytes):
    """The process is killed before the capture's end is recorded, a file has arrived, or a line is returned."""
    with small_rig() as rig:
        kept = KeptUntil(acts={mark: kill})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_a_lost_edge_is_detected_and_its_lines_captured_again():
    """The mirror's index shows one step too few, so none of these lines is used."""
    with small_rig() as rig:
        whole = rig.emulated.mirror.pulses
        left = [1]

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
def test_lines_from_a_later_start_are_not_captured_again(lost: bool):
    """A process that resumes at line 5 captures nothing, unless the folder was removed in between."""
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
    """Makes the camera render frames only after the clock passes ``after_s``."""

    rig: SmallRig
    after_s: float

    def __post_init__(self) -> None:
        camera = self.rig.emulated.camera
        camera.aside = True
        command = camera.command

        def later(line: str) -> object:
            while self.rig.line.clock.now() > self.after_s and camera.keep_looking():
                pass
            return command(line)

        camera.command = later  # type: ignore[method-assign, assignment]


def test_a_camera_that_writes_slowly_is_waited_for():
    """Late frames are not captured again. Two minutes after its stop a capture that still runs is an error."""
    with small_rig() as rig:
        SlowEye(rig, rig.line.clock.now() + 60)
        assert_same(list(rig.source().lines(FINE)))
        assert len(rig.captures) == 1
    with small_rig() as rig:
        kept = KeptInMemory()
        eye = SlowEye(rig, np.inf)
        with pytest.raises(RigError, match=r"still captures /captured/fine-3\S+, 120 s after it was stopped"):
            list(rig.source(kept).lines(FINE))
        eye.after_s = 0.0
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_a_wrong_password_costs_no_capture():
    """The refused files stay on the camera, and with the right password the capture is used."""
    with small_rig() as rig:
        kept = KeptInMemory()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rig.line, "files", replace(rig.line.files, password="x"))
            with pytest.raises(DeviceRefused, match="look at user and password"):
                list(rig.source(kept).lines(FINE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 1


def test_a_full_camera_ends_the_sweep_at_once():
    """A refused capture is not retried, and the mirror does not keep waiting for edges."""
    with small_rig(faults={CameraFault.FULL: 1}) as rig:
        with pytest.raises(DeviceRefused, match="disk full"):
            list(rig.source().lines(FINE))
        assert len(rig.captures) == 1
        assert not any(playback.running for playback in rig.emulated.mirror.state.playbacks)


def test_a_rig_of_unknown_state_gets_no_command():
    """A capture without a reply blocks the rig for every source of this process."""
    with small_rig(faults={CameraFault.SILENT: 1}) as rig:
        rig.emulated.camera.faults.passes = 1  # configure precedes the capture
        source = rig.source()
        kept = KeptInMemory()
        with pytest.raises(StateUnknown, match="not sent again"):
            list(source.keeping(kept).lines(FINE))
        said = len(rig.emulated.camera.commands)
        with pytest.raises(StateUnknown, match="the rig gets no further command"):
            list(source.keeping(kept).lines(FINE))
        assert len(rig.emulated.camera.commands) == said


def killed_amid(rig: SmallRig, kept: KeptInMemory, patch: pytest.MonkeyPatch | None = None) -> None:
    """Start to capture the sweep and get killed while waiting; with ``patch`` before the camera is stopped."""
    if patch is not None:
        patch.setattr(HeadwallCamera, "stop", lambda _: kill())
    with pytest.raises(KilledError):
        list(rig.source(kept).saying(lambda words: kill() if words.startswith("capturing") else None).lines(FINE))


def test_a_capture_that_still_runs_is_waited_for():
    """If a process is killed during a capture, the next one waits for its end and gets all lines by trigger."""
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


def test_an_error_during_a_capture_stops_both_devices():
    """After an interruption the camera captures nothing, and the mirror does not wait for edges."""
    with small_rig() as rig:
        killed_amid(rig, KeptInMemory())
        assert not rig.emulated.camera.is_capturing()
        assert rig.emulated.camera.captures[0].due(1e9) < FINE.lines
        assert not any(playback.running for playback in rig.emulated.mirror.state.playbacks)


def test_a_capture_without_a_log_is_located_by_command_times():
    """A process on a free-running path is killed before it reads the log; the index does not serve as a count."""
    with small_rig(pulses="none", log_samples=16000) as rig:
        kept = KeptUntil(acts={b'"what": "end"': kill})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        source = rig.source(kept)
        assert len(list(source.lines(FINE))) == FINE.lines
        assert [one["method"] for one in source.record["captures"]] == ["command"]


@pytest.mark.parametrize("held", ["of a later folder", "as it is", "of another file"])
def test_a_camera_that_was_emptied_captures_again(held: str):
    """The disk was cleared or the camera replaced: references and lines that are missing are captured again."""
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
    assert abs(found.white - small_source().references(FINE).white).max() <= 1 / 64
    assert source.record["captures"][0]["spent"]


@pytest.mark.parametrize("scan_pass", ["lines", "references"])
def test_an_unstable_mirror_is_not_used_for_captures(scan_pass: str):
    """Neither a path nor references begin before the mirror is at rest."""
    with small_rig(mirror_faults=[make_fault("never-stable", at=0)]) as rig:
        source = rig.source()
        with pytest.raises(RigError, match="is not at rest after"):
            list(source.lines(FINE)) if scan_pass == "lines" else source.references(FINE)
        assert not any(said.startswith("capture(") for said in rig.emulated.camera.commands)


def test_a_lost_end_record_is_not_taken_from_another_path():
    """The mirror has played another path since, so its index does not end the first one: lines are captured again."""
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
