"""What is left of a capture that was broken off, by error or kill: stopped, counted, used where it is there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.headwall_control import HeadwallControl
from pipeline.rig.capture.capture_journal import JOURNAL
from pipeline.rig.emulator.fault_names import make_fault
from tests.rig.capture.test_rig_source_faults import KeptUntil, KilledError, SlowEye, assert_same
from tests.rig.small_rig import COARSE, FINE, SmallRig, small_rig, small_source


def killed_amid(rig: SmallRig, kept: KeptInMemory, patch: pytest.MonkeyPatch | None = None) -> None:
    """Begin to capture the sweep, and die while it is waited for; with ``patch`` before the camera can be stopped."""

    def die(*_: object) -> None:
        raise KilledError

    if patch is not None:
        patch.setattr(HeadwallControl, "stop", die)
    with pytest.raises(KilledError):
        list(rig.source(kept).saying(lambda words: die() if words.startswith("capturing") else None).lines(FINE))


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
        assert (told["method"], told["residual_us"]) == ("trigger", 0.0)


def test_error_while_it_captures_stops_both():
    """Whoever is interrupted leaves neither a camera that captures nor a mirror that waits for edges."""
    with small_rig() as rig:
        killed_amid(rig, KeptInMemory())
        assert not rig.emulated.camera.is_capturing()
        assert rig.emulated.camera.captures[0].due(1e9) < FINE.lines
        assert not any(player.running for player in rig.emulated.mirror.state.players)


def test_capture_that_was_ended_is_not_asked_for_its_end_again():
    """The mirror has played another path since; what it stood at after this one is in the journal."""
    with small_rig() as rig:
        kept = KeptInMemory()
        assert_same(list(rig.source(kept).lines(FINE)))
        list(rig.source().lines(COARSE))
        assert_same(list(rig.source(kept).lines(FINE)))
        assert len(rig.captures) == 2


def test_capture_by_its_own_clock_is_not_counted():
    """Killed before its log is read: lines are tied by the commands' times, and no index is taken for a count."""
    with small_rig(pulses="none", log_samples=16000) as rig:
        kept = KeptUntil(acts={b"mirror_log": killed})
        with pytest.raises(KilledError):
            list(rig.source(kept).lines(FINE))
        source = rig.source(kept)
        assert len(list(source.lines(FINE))) == FINE.lines
        assert [one["method"] for one in source.record["captures"]] == ["command"]
        assert b'"what": "end"' not in kept.files[JOURNAL]


def killed() -> None:
    """The process ends here."""
    raise KilledError


@pytest.mark.parametrize("earlier", [0, 3], ids=["fewer folders than before", "folders of the same names"])
def test_camera_that_was_emptied_in_between_is_gone_on_with(earlier: int):
    """Its disk was cleared, or it is another: frames and lines that it has no more are taken again."""
    kept = KeptInMemory()
    with small_rig() as rig:
        source = rig.source(kept)
        source.references(FINE)
        for _ in range(earlier):
            list(rig.source().lines(COARSE))
        killed_amid(rig, kept)
    with small_rig() as rig:
        for _ in range(3 - earlier):
            list(rig.source().lines(COARSE))
        source = rig.source(kept)
        found = source.references(FINE)
        assert_same(list(source.lines(FINE)))
    wanted = small_source().references(FINE)
    assert abs(found.white - wanted.white).max() <= 1 / 64
    assert source.record["captures"][0]["spent"]


@pytest.mark.parametrize("look", ["lines", "references"])
def test_mirror_that_never_rests_is_not_captured_with(look: str):
    """Neither a path nor a look at rest is begun while the mirror is not there yet."""
    with small_rig(mirror_faults=[make_fault("never-stable", at=0)]) as rig:
        source = rig.source()
        with pytest.raises(RigError, match="is not at rest after"):
            list(source.lines(FINE)) if look == "lines" else source.references(FINE)
        assert not any(said.startswith("capture(") for said in rig.emulated.camera.commands)


def test_lines_that_were_lost_come_from_the_kept_files():
    """Single lines of an earlier session are given again as they were, over several captures; nothing is captured."""
    with small_rig(vector_pairs=12) as rig:
        kept = KeptInMemory()
        given = list(rig.source(kept).lines(FINE))
        taken = len(rig.captures)
        assert taken > 1
        numbers = [0, 3, 8, 9, 16]
        again = list(rig.source(kept).lines_again(FINE, numbers))
        assert len(rig.captures) == taken
    for line, number in zip(again, numbers, strict=True):
        assert replace(line, data=given[number].data) == given[number]
        np.testing.assert_array_equal(line.data, given[number].data)


@pytest.mark.parametrize("gone", ["the journal", "the camera's files"])
def test_lines_that_no_capture_gives_any_more_are_lost(gone: str):
    """They come as lines that the camera dropped: in their places, dark and not valid; nothing is captured for them."""
    kept = KeptInMemory()
    with small_rig() as rig:
        given = list(rig.source(kept).lines(FINE))
    if gone == "the journal":
        kept.files.clear()
    with small_rig() as rig:
        lost = list(rig.source(kept).lines_again(FINE, [2, 5]))
        assert not rig.captures
    assert [(line.number, line.valid, line.data.any()) for line in lost] == [(2, False, False), (5, False, False)]
    assert [line.data.shape for line in lost] == [given[2].data.shape] * 2
    for line in lost:
        assert (line.mirror_x, line.mirror_y) == (given[line.number].mirror_x, given[line.number].mirror_y)


def test_log_that_has_changed_ties_no_line():
    """A bit of the kept log flips: its capture is taken again, and no position of it is believed."""
    with small_rig(pulses="none", log_samples=16000) as rig:
        kept = KeptInMemory()
        list(rig.source(kept).lines(FINE))
        name = next(name for name in kept.files if name.endswith("mirror_log"))
        kept.files[name][len(kept.files[name]) // 2] ^= 4
        source = rig.source(kept)
        assert len(list(source.lines(FINE))) == FINE.lines
        assert len(rig.captures) == 2
        assert "mirror's log" in source.record["captures"][0]["spent"]


def test_end_that_the_journal_has_lost_is_not_read_from_another_path():
    """The mirror has played another path since: what it stands at now is not taken for the end of the first."""
    with small_rig() as rig:
        kept = KeptInMemory()
        list(rig.source(kept).lines(FINE))
        list(rig.source().lines(COARSE))
        at = bytes(kept.files[JOURNAL]).index(b'"what": "end"')
        kept.files[JOURNAL][at + 3] ^= 1
        source = rig.source(kept)
        assert_same(list(source.lines(FINE)))
        assert len(rig.captures) == 3
        assert "what the journal has lost" in source.record["captures"][0]["spent"]
        assert "counts for nothing: it has changed" in source.record["journal"][0]
