"""Interrupted captures: no acknowledged line is lost or captured twice, and existing captures are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from unittest.mock import Mock

import pytest

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.rig.camera.camera_files import NOT_LOGGED_IN, KeptInMemory
from spectralzoom.pipeline.rig.capture_runner import JOURNAL
from spectralzoom.pipeline.rig.transports import DeadlinePassed, DeviceGone, DeviceRefused, StateUnknown
from spectralzoom.pipeline.source import Line
from tests.pipeline.rig.small_rig import FINE, SmallRig, assert_simulated


def assert_same(found: list[Line], first: int = 0) -> None:
    """Assert the simulated source's numbers, all valid."""
    assert_simulated(found, FINE, first)
    assert all(line.valid for line in found)


class KilledError(BaseException):
    """The process is killed here."""


@dataclass
class KeptUntil(KeptInMemory):
    """Files that call a function once at the first bytes with a mark."""

    acts: dict[bytes, Callable[[], None]] = field(default_factory=dict)

    def append(self, name: str, data: bytes) -> None:
        """Call the function of each mark, then keep the data."""
        for mark in [mark for mark in self.acts if mark in data]:
            self.acts.pop(mark)()
        super().append(name, data)


kill = Mock(side_effect=KilledError)


def failing(error: BaseException) -> Callable[[], object]:
    """Return an act that raises an error."""
    return Mock(side_effect=error)


def test_cubes_that_are_always_truncated_end_the_sweep():
    """Two captures in a row without a new line end it; the message says how many lines are kept."""
    rig = SmallRig(vector_pairs=2)
    rig.camera.cuts = [0] * 9
    with pytest.raises(RigError, match=r"2 captures in a row gave no line 0; .*The 0 lines before it are kept"):
        list(rig.source().lines(FINE))
    assert len(rig.captures) == 2


@pytest.mark.parametrize(
    ("cuts", "pairs", "begun"), [([15], 1500, [0, 15]), ([3, 3, 3], 5, [0, 3, 6, 9, 14])], ids=["once", "often"]
)
def test_truncated_cubes_are_captured_again_from_the_first_missing_line(cuts: list[int], pairs: int, begun: list[int]):
    """Whole lines of a truncated cube count. The others are captured again with the same numbers."""
    rig = SmallRig(vector_pairs=pairs)
    rig.camera.cuts = list(cuts)
    source = rig.source()
    assert_same(list(source.lines(FINE)))
    assert [one["first"] for one in source.record["captures"]] == begun


@pytest.mark.parametrize("mark", [b'"residual_px": 0', b"origin"])
def test_a_capture_is_used_after_the_process_is_killed(mark: bytes):
    """The process is killed before the positions are recorded, or a line is returned."""
    rig = SmallRig()
    kept = KeptUntil(acts={mark: kill})
    with pytest.raises(KilledError):
        list(rig.source(kept).lines(FINE))
    assert_same(list(rig.source(kept).lines(FINE)))
    assert len(rig.captures) == 1


@pytest.mark.parametrize("lost", [False, True], ids=["there", "taken away"])
def test_lines_from_a_later_start_are_not_captured_again(lost: bool):
    """A process that resumes at line 5 captures nothing, unless the folder was removed in between."""
    rig = SmallRig()
    kept = KeptInMemory()
    lines = rig.source(kept).lines(FINE)
    assert [next(lines).number for _ in range(5)] == list(range(5))
    lines.close()  # type: ignore[attr-defined]
    if lost:
        rig.camera.acts["fetch"] = [failing(DeviceRefused("no such folder", 550))]
    assert_same(list(rig.source(kept).lines(FINE, first=5)), 5)
    assert len(rig.captures) == 1 + lost


def test_a_camera_that_writes_slowly_is_waited_for():
    """Late frames are not captured again. Two minutes after its stop a capture that still runs is an error."""
    rig = SmallRig()
    rig.camera.late = rig.clock.now() + 60
    assert_same(list(rig.source().lines(FINE)))
    assert (len(rig.captures), rig.camera.stopped) == (1, 1)
    rig, kept = SmallRig(), KeptInMemory()
    rig.camera.late = 1e9
    with pytest.raises(RigError, match=r"still captures /fake/fine-3\S+, 120 s after it was stopped"):
        list(rig.source(kept).lines(FINE))
    rig.camera.late = 0.0
    assert_same(list(rig.source(kept).lines(FINE)))
    assert len(rig.captures) == 1


@pytest.mark.parametrize(
    "error", [DeviceRefused("look at user and password", NOT_LOGGED_IN), DeviceGone("files are not there")]
)
def test_files_that_cannot_be_fetched_cost_no_capture(error: RigError):
    """They stay on the camera, and are used once it can be reached."""
    rig = SmallRig()
    rig.camera.acts["fetch"] = [failing(error)]
    kept = KeptInMemory()
    with pytest.raises(type(error)):
        list(rig.source(kept).lines(FINE))
    assert_same(list(rig.source(kept).lines(FINE)))
    assert len(rig.captures) == 1


@pytest.mark.parametrize("error", [DeadlinePassed("no answer to halting the path"), DeviceGone("the port went away")])
def test_lines_of_a_mirror_that_restarted_do_not_count(error: RigError):
    """It may have stopped anywhere on the path: the next process captures these lines again, and no others."""
    rig = SmallRig(vector_pairs=9)
    kept = KeptInMemory()
    halt = Mock(side_effect=[None, error, None, None])
    rig.mirror.halt = halt  # type: ignore[method-assign]
    with pytest.raises(type(error)):
        list(rig.source(kept).lines(FINE))
    source = rig.source(kept)
    assert_same(list(source.lines(FINE)))
    assert [(one["first"], "spent" in one) for one in source.record["captures"]] == [(0, False), (9, True), (9, False)]


def test_a_full_camera_ends_the_sweep_at_once():
    """A refused capture is not retried, and no path is played."""
    rig = SmallRig()
    rig.camera.acts["capture"] = [failing(DeviceRefused("disk full"))]
    with pytest.raises(DeviceRefused, match="disk full"):
        list(rig.source().lines(FINE))
    assert (rig.captures, rig.mirror.runs) == ([], [])


def test_a_rig_of_unknown_state_gets_no_command():
    """A capture without a reply blocks the rig for every source of this process."""
    rig = SmallRig()
    rig.camera.acts["capture"] = [failing(StateUnknown("a capture is not sent again"))]
    source = rig.source()
    kept = KeptInMemory()
    with pytest.raises(StateUnknown, match="not sent again"):
        list(source.keeping(kept).lines(FINE))
    opened = rig.opened
    with pytest.raises(StateUnknown, match="the rig gets no further command"):
        list(source.keeping(kept).lines(FINE))
    assert rig.opened == opened


def test_a_rig_of_unknown_state_gets_no_command_in_an_open_session():
    """A mirror whose motion was not acknowledged is not sent anywhere again, though the devices are connected."""
    rig = SmallRig()
    rig.mirror.goto = Mock(side_effect=StateUnknown("going is not sent again"))  # type: ignore[method-assign]
    source = rig.source()
    with source.session():
        for words in ("not sent again", "no further command"):
            with pytest.raises(StateUnknown, match=words):
                list(source.lines(FINE))
    assert rig.mirror.goto.call_count == 1


def killed_amid(rig: SmallRig, kept: KeptInMemory) -> None:
    """Start to capture the sweep and get killed while waiting."""
    with pytest.raises(KilledError):
        list(rig.source(kept, say=lambda words: kill() if words.startswith("capturing") else None).lines(FINE))


def test_a_capture_that_still_runs_is_waited_for():
    """If a process is killed during a capture, the next one waits for its end and gets all lines."""
    rig = SmallRig()
    kept = KeptInMemory()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.camera, "stop", kill)
        killed_amid(rig, kept)
    assert rig.camera.is_capturing()
    assert_same(list(rig.source(kept).lines(FINE)))
    assert len(rig.captures) == 1


def test_an_error_during_a_capture_stops_both_devices():
    """After an interruption the camera captures nothing, and the mirror is halted."""
    rig = SmallRig()
    halted = Mock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.mirror, "halt", halted)
        killed_amid(rig, KeptInMemory())
    assert not rig.camera.is_capturing()
    assert halted.call_count == 1


def test_a_mirror_that_does_not_come_to_rest_is_not_used():
    """Neither a path nor references begin before the mirror is at rest."""
    rig = SmallRig()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig.mirror, "settle", failing(RigError("is not at rest after 2 s")))
        for scan_pass in (lambda: list(rig.source().lines(FINE)), lambda: rig.source().references(FINE)):
            with pytest.raises(RigError, match="is not at rest after"):
                scan_pass()
    assert rig.camera.captures == []


def test_a_late_run_command_moves_the_lines():
    """The mirror's clock runs on between the commands: lines lie where the path was, and the error is stated."""
    rig = SmallRig()
    source = rig.source()
    play = rig.mirror.run

    def late(rate_hz: float) -> None:
        rig.clock.sleep(0.01)  # of the frame's 0.1 s
        play(rate_hz)

    rig.mirror.run = late  # type: ignore[method-assign]
    found = list(source.lines(FINE))
    (told,) = source.record["captures"]
    assert told["residual_px"] == pytest.approx(0.05)
    assert all(line.valid for line in found)
    planned = list(SmallRig().source().lines(FINE))
    steps = [(one.mirror_y - other.mirror_y) for one, other in zip(found[1:], planned[1:], strict=True)]
    step = planned[2].mirror_y - planned[1].mirror_y
    assert steps == pytest.approx([-0.05 * step] * 16, rel=0.02)


def test_a_damaged_journal_costs_one_capture():
    """A capture of which every record changed is captured again, and the damage is in the record of the rig."""
    rig = SmallRig()
    kept = KeptInMemory()
    list(rig.source(kept).lines(FINE))
    content = bytes(kept.files[JOURNAL])
    records = [at for at in range(len(content)) if content.startswith(b'"what": "capture"', at)]
    for count, at in enumerate(records, 1):  # of the capture, and of the positions of its lines
        kept.files[JOURNAL][at + 3] ^= 1
        source = rig.source(kept)
        assert_same(list(source.lines(FINE)))
        assert len(rig.captures) == 1 + (count == len(records))
    assert "is ignored: it is torn or has changed" in source.record["journal"][0]


def test_references_that_are_gone_are_taken_again():
    """An emptied camera refuses the folder of an earlier session."""
    rig = SmallRig()
    kept = KeptInMemory()
    rig.source(kept).references(FINE)
    with pytest.MonkeyPatch.context() as patch:
        wanted = rig.camera.references
        patch.setattr(rig.camera, "references", Mock(side_effect=[DeviceRefused("no such folder", 550), None]))
        with pytest.raises(TypeError):
            rig.source(kept).references(FINE)
        patch.setattr(rig.camera, "references", wanted)
        rig.source(kept).references(FINE)
    assert len(rig.camera.captures) == 2
