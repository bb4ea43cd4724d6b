"""Raw lines are cleared by the `keep` setting of their runs, after comparison with the condensed signal."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spectralzoom
from flows.archive.commands import gc
from flows.publish.retention import clear_raw_lines
from flows.terminal.processes import DONE, PARTLY
from storage.archive.archive import Archive
from storage.arrays import signal_cubes
from storage.maintenance.garbage import IN_USE
from tests.conftest import Survey
from tests.flows.conftest import problems
from tests.prior_work import without_effects
from tests.storage.small_archive import flip


@pytest.fixture(scope="module")
def surveyed(survey_png: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of one survey that keeps its raw lines for a week; do not change it."""
    root = tmp_path_factory.mktemp("retention") / "archive"
    with without_effects():
        survey_png(root, keep="raw 7d", accuracy=False)
    return root


@pytest.fixture
def archive(surveyed: Path, tmp_path: Path) -> Archive:
    """Return a copy of it."""
    return Archive.open(shutil.copytree(surveyed, tmp_path / "archive"))


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the clock of the archive eight days ahead."""
    monkeypatch.setattr(Archive, "now", lambda self: datetime.now(UTC) + timedelta(days=8))


def raw_uris(archive: Archive) -> set[str]:
    """Return the addresses of raw lines in the archive."""
    return {ref.uri for ref in archive.refs() if ref.stage.startswith("capture") and archive.is_there(ref.uri)}


def of_gc(capsys: pytest.CaptureFixture[str], root: Path, **flags: Any) -> tuple[int, dict[str, Any]]:
    """Return exit code and content of `gc --json`."""
    code = gc(root, as_json=True, **flags)
    return code, json.loads(capsys.readouterr().out)


def test_raw_lines_stay_for_their_time(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    """Within the week gc and its dry run remove nothing."""
    there = raw_uris(archive)
    assert len(there) == 2
    for dry_run in (True, False):
        assert of_gc(capsys, archive.root, dry_run=dry_run)[1]["removals"] == []
    assert raw_uris(archive) == there


@pytest.mark.usefixtures("later")
def test_expired_raw_lines_are_cleared(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    """A dry run lists them with the reason; gc clears them, and the archive is valid with the same condensed lines."""
    run = spectralzoom.open(archive.root).latest
    before = {n: one.values for n, one in run.lines.items()}
    there = raw_uris(archive)
    code, planned = of_gc(capsys, archive.root, dry_run=True)
    assert (code, raw_uris(archive)) == (DONE, there)
    assert {row["uri"] for row in planned["removals"]} == there
    assert {row["why"] for row in planned["removals"]} == {"keep = raw 7d, and they were condensed"}
    code, done = of_gc(capsys, archive.root)
    assert (code, done["removals"], raw_uris(archive)) == (DONE, planned["removals"], set())
    assert done["bytes"] > 0
    assert problems(archive.root) == []
    again = spectralzoom.open(archive.root).latest
    for name, values in before.items():
        np.testing.assert_array_equal(again.lines[name].values, values)
    with pytest.raises(spectralzoom.Error, match="`lines` has their signal"):
        _ = again.sweeps
    assert of_gc(capsys, archive.root)[1]["removals"] == []


@pytest.mark.usefixtures("no_effects", "later")
@pytest.mark.parametrize(("first", "then"), [("raw", "signal"), ("signal", "raw")])
def test_raw_lines_stay_while_any_run_keeps_them(archive: Archive, survey_png: Survey, first: str, then: str) -> None:
    """The longest setting counts, for gc and for a survey; lines that no run keeps are cleared and captured again."""
    there = raw_uris(archive)
    survey_png(archive.root, keep=first, accuracy=False)
    assert raw_uris(archive) == (there if first == "raw" else set())
    assert clear_raw_lines(archive).removals == []
    survey_png(archive.root, keep=then, accuracy=False)
    assert raw_uris(archive) == there


@pytest.mark.usefixtures("no_effects")
def test_raw_of_a_killed_survey_is_cleared(survey_png: Survey, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `keep = signal` they are cleared at once, at any age."""
    with monkeypatch.context() as patch:
        patch.setattr("flows.survey.clear_raw", lambda plan, run: run)
        survey_png(tmp_path / "archive", budget=None, scan_step="2", accuracy=False)
    archive = Archive.open(tmp_path / "archive")
    there = raw_uris(archive)
    assert there
    monkeypatch.setattr(Archive, "now", lambda self: datetime.now(UTC) - timedelta(minutes=2))  # the clock of a bucket
    assert {one.uri for one in clear_raw_lines(archive).removals} == there
    assert raw_uris(archive) == set()


@pytest.mark.usefixtures("later")
def test_raw_lines_of_an_older_signal_version_are_kept(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """They cannot be compared with a signal of another version; the reason advises to run reprocess."""
    there = raw_uris(archive)
    monkeypatch.setattr("flows.publish.retention.PRESENT", {"condense": "99", "condense_fine": "99"})
    for dry_run in (True, False):
        done = clear_raw_lines(archive, dry_run=dry_run)
        assert done.removals == []
        assert done.kept.keys() == there
        assert all("now 99: run reprocess" in why for why in done.kept.values())
    assert raw_uris(archive) == there


@pytest.mark.usefixtures("later")
def test_raw_lines_without_a_signal_are_kept(archive: Archive) -> None:
    """Such lines are left by an interrupted survey of a rig, or by another version."""
    for ref in (*archive.refs("condense"), *archive.refs("condense_fine")):
        shutil.rmtree(ref.path)
    there = raw_uris(archive)
    assert clear_raw_lines(archive).removals == []
    assert raw_uris(archive) == there


@pytest.mark.usefixtures("later")
def test_a_flipped_bit_keeps_raw_lines(archive: Archive, capsys: pytest.CaptureFixture[str]) -> None:
    """The signal is read to its last byte before: lines of the damaged store are kept, others are cleared."""
    files = archive.root.glob("stages/condense/*/coarse-0.zarr/scores/c/**/*")
    flip(max(files, key=lambda path: path.stat().st_size), at=5)
    code, done = of_gc(capsys, archive.root)
    assert code == PARTLY
    (why,) = done["raw_kept"].values()
    assert "has changed since it was published" in why
    assert len(raw_uris(archive)) == 1


@pytest.mark.usefixtures("later")
def test_raw_lines_that_differ_from_the_signal_are_kept(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """One changed score suffices; the reason names the sweep and its line."""
    read = signal_cubes.SignalCube.read

    def off(self: signal_cubes.SignalCube, start: int = 0, stop: int | None = None) -> Any:
        found = read(self, start, stop).copy()
        if start == 0 and self.sweep.name == "coarse-0":
            found[3, 7, 0] += 2
        return found

    monkeypatch.setattr(signal_cubes.SignalCube, "read", off)
    done = clear_raw_lines(archive)
    assert set(done.kept.values()) == {"sweep coarse-0: line 3 of the signal are not those of the raw lines"}
    assert set(done.kept) == raw_uris(archive)


@pytest.mark.usefixtures("later")
def test_gc_clears_nothing_during_a_survey(archive: Archive) -> None:
    """The survey may be reading these lines."""
    there = raw_uris(archive)
    with archive.in_use():
        assert clear_raw_lines(archive).obstacle == IN_USE
    assert raw_uris(archive) == there
