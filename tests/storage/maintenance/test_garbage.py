"""Garbage collection removes only unneeded files, and leaves a whole archive when it is interrupted."""

from __future__ import annotations

from pathlib import Path

import pytest

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.storage.runs import IN_USE, Clearance, Removal, clear_up, verify_everything
from spectralzoom.storage.store import Archive
from tests.storage.small_archive import flip, grow_old, make_store, problems, small_survey


def test_gc_removes_only_stores_that_no_run_needs(archive: Archive) -> None:
    """Inputs of a named store stay, though no receipt names them; a dry run lists the same removals."""
    kept, gone = small_survey(archive), small_survey(archive, seed=1, named=False)
    planned = clear_up(archive, keep_days=0, dry_run=True)
    assert [removal.uri for removal in planned.removals] == [gone.map.uri, gone.mosaic.uri, gone.raw.uri]
    assert len(archive.refs()) == 6
    done = clear_up(archive, keep_days=0)
    assert done == planned
    assert done.size > 3 * 40 * 40
    assert {ref.uri for ref in archive.refs()} == {kept.raw.uri, kept.mosaic.uri, kept.map.uri}
    assert problems(archive) == []
    assert clear_up(archive, keep_days=0).removals == ()


def test_gc_keeps_a_shared_input(archive: Archive) -> None:
    """An unnamed map with another kernel has the same raw lines as a named map."""
    kept, gone = small_survey(archive), small_survey(archive, kernel="nearest", named=False)
    assert gone.raw == kept.raw
    assert [one.uri for one in clear_up(archive, keep_days=0).removals] == [gone.map.uri, gone.mosaic.uri]


def test_gc_keeps_young_stores_and_their_inputs(archive: Archive) -> None:
    """A survey in progress has made a map from old raw lines: both stay."""
    small, other = small_survey(archive, named=False), small_survey(archive, seed=5, named=False)
    for ref in (small.raw, small.mosaic, other.raw, other.mosaic, other.map):
        grow_old(ref, days=3)
    plan = plan_clearance(archive, keep_days=2)
    assert {one.uri for one in plan.removals} == {other.raw.uri, other.mosaic.uri, other.map.uri}
    assert plan.kept == {
        small.raw.uri: "an input of a store that stays",
        small.mosaic.uri: "an input of a store that stays",
        small.map.uri: "no run names it, and it is younger than 2 days",
    }
    assert len(plan_clearance(archive, keep_days=4).removals) == 0


def test_gc_removes_raw_lines_of_a_rig_only_on_request(archive: Archive) -> None:
    """A survey that broke off after its capture has lines that no run names and that cannot be captured again."""
    small = small_survey(archive, named=False, simulated=False)
    assert small.raw.uri in clear_up(archive, keep_days=0).kept
    assert [ref.uri for ref in archive.refs()] == [small.raw.uri]
    clear_up(archive, keep_days=0, raw_too=True)
    assert archive.refs() == []


def test_gc_removes_spools_of_published_captures_and_dead_drafts(tmp_path: Path, archive: Archive) -> None:
    """The spool of an unpublished capture stays, because the capture continues from it."""
    small = small_survey(archive)
    for key in (small.raw.key, "underway"):
        (archive.spool_folder(key) / "lines.lines").write_bytes(b"x" * 100)
    (tmp_path / "stages" / "rectify" / "dead.part").mkdir()
    (tmp_path / "stages" / "rectify" / "dead.part" / "half").write_bytes(b"y" * 10)
    with archive.publish("rectify", "living") as staged:
        planned = clear_up(archive, keep_days=0, dry_run=True)
        found = clear_up(archive, keep_days=0)
        assert planned == found
        assert staged.path.is_dir()
    assert {(one.uri, one.what, one.size) for one in found.removals} == {
        (f"spool/{small.raw.key}", "leftover", 100),
        ("stages/rectify/dead.part", "leftover", 10),
    }
    assert [path.name for path in (tmp_path / "spool").iterdir()] == ["underway"]
    assert not (tmp_path / "stages" / "rectify" / "dead.part").exists()
    assert [path.name for path in (tmp_path / ".locks").iterdir()] == ["use.lock"]


def test_a_stray_file_among_the_runs_does_not_stop_gc(tmp_path: Path, archive: Archive) -> None:
    """A file names no store; only a folder there could."""
    small_survey(archive, named=False)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "notes.txt").write_text("mine")
    assert len(clear_up(archive, keep_days=0).removals) == 3
    assert (tmp_path / "runs" / "notes.txt").exists()


def test_gc_keeps_a_spool_that_its_capture_may_need(archive: Archive) -> None:
    """The capture is being published, or its published manifest is damaged."""
    small = small_survey(archive)
    (archive.spool_folder(small.raw.key) / "lines.lines").write_bytes(b"x")
    with archive.publish("capture", small.raw.key):
        assert clear_up(archive).removals == ()
    manifest = (small.raw.path / "manifest.json").read_bytes()
    flip(small.raw.path / "manifest.json", at=30)
    assert clear_up(archive).removals == ()
    (small.raw.path / "manifest.json").write_bytes(manifest)
    assert [removal.what for removal in clear_up(archive).removals] == ["leftover"]


def test_gc_does_not_report_a_failed_removal(tmp_path: Path, archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk refuses the removal; the next gc tries again."""
    (tmp_path / "stages/segment/aaaa.part").mkdir(parents=True)
    with monkeypatch.context() as broken:
        broken.setattr("spectralzoom.storage.archive.archive.remove_tree", lambda path: None)
        assert clear_up(archive).removals == ()
    assert [removal.uri for removal in clear_up(archive).removals] == ["stages/segment/aaaa.part"]


def test_gc_removes_nothing_while_the_archive_is_in_use(tmp_path: Path, archive: Archive) -> None:
    """Two surveys may use an archive at a time; gc reports that it is in use."""
    small = small_survey(archive, named=False)
    with archive.in_use(), Archive.open(tmp_path).in_use():
        done = clear_up(archive, keep_days=0)
        assert (done.removals, done.obstacle) == ((), IN_USE)
    with archive.publish("segment", "another"):
        pass
    assert len(clear_up(archive, keep_days=0).removals) == 4
    assert archive.find("capture", small.raw.key) is None


def test_gc_keeps_a_locked_store(archive: Archive) -> None:
    """The process that holds a key's lock works on its store."""
    small = small_survey(archive, named=False)
    with archive.publish(small.map.stage, small.map.key) as staged:
        assert staged.done
        assert small.map.uri not in {one.uri for one in clear_up(archive, keep_days=0).removals}
    assert archive.find(small.map.stage, small.map.key) == small.map


@pytest.mark.parametrize("victim", ["receipt.json", "manifest.json"])
def test_gc_keeps_all_stores_if_a_run_cannot_be_read(archive: Archive, victim: str) -> None:
    """The run's manifest replaces a damaged receipt; if the manifest is damaged or missing, all stores stay."""
    small, other = small_survey(archive), small_survey(archive, seed=1, named=False)
    flip(small.run / victim)
    found = clear_up(archive, keep_days=0)
    if victim == "receipt.json":
        assert (found.obstacle, len(found.removals)) == (None, 3)
        return
    assert found.obstacle.startswith(f"no store is removed: the stores of runs/{small.run.name} are not known")
    assert "; restore this folder from a copy, or delete it" in found.obstacle
    (small.run / victim).unlink()
    found = clear_up(archive, keep_days=0)
    assert "has lost its manifest.json" in found.obstacle
    assert archive.find("segment", other.map.key) == other.map


def test_gc_keeps_all_stores_if_inputs_are_unknown(archive: Archive) -> None:
    """The map is young and its manifest is damaged: the old mosaic might be its input."""
    small = small_survey(archive, named=False)
    for ref in (small.raw, small.mosaic):
        grow_old(ref, days=3)
    (small.map.path / "manifest.json").write_text("{")
    assert f"the inputs of {small.map.uri} are not known" in clear_up(archive, keep_days=2).obstacle
    assert len(archive.refs()) == 3


@pytest.mark.parametrize("at", range(4))
def test_an_interrupted_gc_leaves_a_whole_archive(archive: Archive, at: int) -> None:
    """Stores are removed before their inputs; the next gc removes the rest."""
    small_survey(archive)
    small_survey(archive, seed=1, named=False)
    (archive.spool_folder(archive.refs("capture")[0].key) / "lines.lines").write_bytes(b"x")
    steps: list[Removal] = []

    def stop(removal: Removal, done: float) -> None:
        steps.append(removal)
        if len(steps) > at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        clear_up(archive, keep_days=0, progress=stop)
    assert problems(archive) == []
    clear_up(archive, keep_days=0)
    assert len(archive.refs()) == 3


def test_a_negative_age_is_refused(tmp_path: Path) -> None:
    """NaN is refused as well."""
    for days in (-1.0, float("nan")):
        with pytest.raises(SettingsError, match="expected a number of days"):
            clear_up(Archive.open(tmp_path), keep_days=days)


# --- damaged stores ---------------------------------------------------------------------------------------------------


def remove_damaged(archive: Archive, *, raw_too: bool = False, dry_run: bool = False) -> Clearance:
    """Verify an archive, and remove what is damaged."""
    return clear_up(archive, raw_too=raw_too, damaged=verify_everything(archive), dry_run=dry_run)


def test_a_damaged_store_goes_with_what_was_made_of_it(archive: Archive) -> None:
    """A dry run lists the same removals; the next survey makes them again, and the run is whole."""
    small, other = small_survey(archive), small_survey(archive, seed=1)
    flip(small.mosaic.path / "data.bin")
    planned = remove_damaged(archive, dry_run=True)
    assert [(one.uri, one.why) for one in planned.removals] == [
        (small.map.uri, "it was made of a damaged store"),
        (small.mosaic.uri, "it is damaged"),
    ]
    assert remove_damaged(archive) == planned
    assert {ref.uri for ref in archive.refs()} == {small.raw.uri, other.raw.uri, other.mosaic.uri, other.map.uri}
    assert len(archive.runs()) == 2
    assert len(problems(archive)) == 2  # which the run names
    small_survey(archive, named=False)
    assert problems(archive) == []
    assert remove_damaged(archive).removals == ()


@pytest.mark.parametrize("damage", ["a flipped bit", "a damaged manifest", "no manifest"])
def test_damaged_lines_of_a_rig_go_on_request(archive: Archive, damage: str) -> None:
    """They cannot be captured again, so they stay with what was made of them, with a reason."""
    small = small_survey(archive, simulated=False)
    if damage == "no manifest":
        (small.raw.path / "manifest.json").unlink()
    else:
        flip(small.raw.path / ("data.bin" if damage == "a flipped bit" else "manifest.json"), at=40)
    if damage != "no manifest":  # nothing is known of such a folder
        kept = remove_damaged(archive)
        assert (kept.removals, list(kept.kept)) == ((), [small.raw.uri])
        assert "restore it from a copy" in kept.kept[small.raw.uri]
    assert small.raw.uri in {one.uri for one in remove_damaged(archive, raw_too=True).removals}
    small_survey(archive, named=False, simulated=False)
    assert problems(archive) == []


def test_lines_of_a_rig_outlive_the_damaged_store_that_planned_them(archive: Archive) -> None:
    """The lines of a second pass were captured by the scores of a mosaic, and cannot be captured again."""
    small = small_survey(archive, simulated=False)
    fine = make_store(archive, "capture", {"source": "rig", "pass": 2}, [small.mosaic])
    drawn = make_store(archive, "segment", {"pass": 2}, [fine])
    flip(small.mosaic.path / "data.bin")
    assert {one.uri for one in remove_damaged(archive).removals} == {small.map.uri, small.mosaic.uri, drawn.uri}
    assert problems(archive)[-1].endswith("was made of it") or archive.find("capture", fine.key) is not None


def test_a_damaged_run_goes_and_its_stores_stay(archive: Archive) -> None:
    """Without it nothing stands in the way of gc, which spares its stores for a day."""
    small = small_survey(archive)
    (small.run / "manifest.json").unlink()
    assert clear_up(archive, keep_days=9).obstacle is not None
    assert [(one.uri, one.what) for one in remove_damaged(archive).removals] == [(f"runs/{small.run.name}", "run")]
    assert problems(archive) == []
    assert len(archive.refs()) == 3
    assert clear_up(archive, keep_days=9).obstacle is None


def test_nothing_damaged_is_removed_from_an_archive_in_use(archive: Archive) -> None:
    """A survey may be reading it."""
    small = small_survey(archive)
    flip(small.mosaic.path / "data.bin")
    with archive.in_use():
        assert remove_damaged(archive).obstacle == IN_USE
    assert len(archive.refs()) == 3
