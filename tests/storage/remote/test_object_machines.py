"""Several machines share an archive in a bucket: none harms a store that another clears, removes or uploads."""

from __future__ import annotations

import errno
import json
import os
import time
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip("obstore", reason="obstore is not installed (extra s3)")

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.maintenance.garbage import clear_up
from storage.readers.recordings import find_recorded_run, open_recording
from storage.remote import object_archive
from storage.remote.object_stores import Objects
from tests.pipeline.capture.recordings import CAMERA, FULL, simulated
from tests.storage.readers.test_recordings import write_raw
from tests.storage.small_archive import problems, small_survey
from tests.storage.small_bucket import FIRST, SECOND, Machine, make


def test_gc_restores_a_store_that_a_new_run_names(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another machine publishes a run between gc's listing of the runs and its removal of a store."""
    archive = machine(FIRST)
    small_survey(archive, named=False)
    opened = machine(SECOND, create=False)
    remove = Objects.remove
    done: list[bool] = []

    def publish_first(self: Objects, names: Any) -> None:
        remove(self, names)
        if not done:
            done.append(True)
            small_survey(archive)

    monkeypatch.setattr(Objects, "remove", publish_first)
    assert [one.uri for one in clear_up(opened, keep_days=0).removals] == []
    assert problems(archive) == []


def test_files_cleared_by_another_machine_are_missing(machine: Machine) -> None:
    """The working copy has an older manifest of them."""
    archive = machine(FIRST)
    small = small_survey(archive)
    machine(SECOND, create=False)
    archive.clear(small.raw)
    other = machine(SECOND, create=False)
    assert (other.is_there(small.raw.uri), other.is_there(small.map.uri)) == (False, True)


def test_discard_keeps_a_store_that_a_new_run_names(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that names the store is published after gc's last listing of the runs."""
    archive = machine(FIRST)
    ref = small_survey(archive, named=False).map
    opened = machine(SECOND, create=False)
    discard = Archive.discard
    done: list[bool] = []

    def publish_first(self: Archive, *given: Any, **options: Any) -> bool:
        if not done:
            done.append(True)
            small_survey(archive)
        return discard(self, *given, **options)

    monkeypatch.setattr(Archive, "discard", publish_first)
    assert not opened.discard(ref, unnamed=True)
    assert problems(archive) == []


def test_gc_sees_runs_published_after_the_archive_was_opened(machine: Machine) -> None:
    """Between opening and gc another machine names old stores: they stay."""
    archive = machine(FIRST)
    small_survey(archive, named=False)
    opened = machine(SECOND, create=False)
    small_survey(archive)
    assert clear_up(opened, keep_days=0).removals == ()
    assert problems(archive) == []


def test_a_survey_sees_runs_of_other_machines(machine: Machine) -> None:
    """Runs from before the opening are listed at once, later ones after a refresh."""
    archive = machine(FIRST)
    runs = [small_survey(archive).run.name]
    opened = machine(SECOND)
    assert [folder.name for folder in opened.runs()] == runs
    runs.append(small_survey(archive, seed=1).run.name)
    opened.refresh()
    assert {run.uri for run in Catalogue.read(opened.root).runs} == {f"runs/{name}" for name in runs}


def test_a_run_removed_by_another_machine_is_removed_here(machine: Machine) -> None:
    """The run is not uploaded again, and does not stop the next command."""
    archive = machine(FIRST)
    small_survey(archive)
    with archive.new_run("farm") as draft:
        for name in ("receipt.json", "report.html"):
            draft.write_file(name, "{}")
    assert len(machine(SECOND, create=False).runs()) == 2
    archive.drop_run(f"runs/{draft.id}")
    for name in (FIRST, SECOND):
        assert draft.id not in {folder.name for folder in machine(name).runs()}
    assert problems(archive) == []


def test_a_store_removed_by_another_machine_is_not_listed(machine: Machine) -> None:
    """This machine had only the store's manifest."""
    archive = machine(FIRST)
    ref = small_survey(archive, named=False).map
    assert ref.uri in {one.uri for one in machine(SECOND, create=False).refs()}
    archive.discard(ref)
    assert ref.uri not in {one.uri for one in machine(SECOND, create=False).refs()}


def test_a_store_removed_by_another_machine_is_made_again(machine: Machine) -> None:
    """A cached manifest without fetched files does not stand for a removed store."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    assert machine(SECOND).find("rectify", ref.key) is not None
    archive.discard(ref)
    found, built = make(machine(SECOND), b"again")
    assert built
    assert (found.path / "deep" / "a.bin").read_bytes() == b"again"
    assert problems(archive) == []


def test_a_store_remade_by_another_machine_is_fetched_anew(machine: Machine) -> None:
    """The store has other bytes now: a run in progress stops with the advice to run again, which fetches them."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    other = machine(SECOND)
    found = other.find("rectify", ref.key)
    archive.discard(ref)
    make(archive, b"later")
    assert found is not None
    with pytest.raises(IncompleteStoreError, match="is missing; run again"):
        _ = found.path
    other = machine(SECOND)
    found = other.find("rectify", ref.key)
    assert (found.path / "deep" / "a.bin").read_bytes() == b"later"
    assert other.manifest_hashes([found]) == archive.manifest_hashes([ref])


def test_gc_counts_ages_by_the_clock_of_the_bucket(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine whose clock is days ahead removes no fresh store."""
    small_survey(machine(FIRST), named=False)
    opened = machine(SECOND, create=False)
    monkeypatch.setattr(Archive, "now", lambda self: datetime.now(UTC) + timedelta(days=9))
    assert clear_up(opened, keep_days=1).removals == ()


def test_a_store_removed_during_verify_is_not_damage(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """gc on another machine removes the store after its manifest was read and before its files are."""
    archive = machine(FIRST)
    ref, _ = make(archive)
    save = Objects.save

    def clear_first(self: Objects, name: str, path: Path) -> str:
        archive.discard(ref)
        return save(self, name, path)

    monkeypatch.setattr(Objects, "save", clear_first)
    assert problems(archive) == []


def test_a_full_disk_under_the_working_copy_is_one_error(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fetching a file and writing a manifest can fail; stored files stay, and the next attempt continues."""
    ref, _ = make(machine(FIRST))
    other = machine(SECOND)
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    with monkeypatch.context() as patch:
        patch.setattr(object_archive, "sync_path", full)
        with pytest.raises(ArchiveError, match="the disk is full: free some space"):
            other.find("rectify", ref.key)
    found = other.find("rectify", ref.key)
    assert found is not None
    with monkeypatch.context() as patch:
        patch.setattr(Objects, "save", full)
        with pytest.raises(ArchiveError, match="the disk is full: free some space"):
            _ = found.path
    assert (found.path / "deep" / "a.bin").read_bytes() == b"light"


def test_leftovers_of_killed_fetches_are_removed_after_a_day(machine: Machine) -> None:
    """A younger folder stays, because its fetch may be in progress."""
    other = machine(SECOND)
    dead, living = (other.root / f".fetch-{name}" for name in ("dead", "living"))
    for folder in (dead, living):
        folder.mkdir(parents=True)
        (folder / "half").write_bytes(b"half")
    os.utime(dead, (time.time() - 90_000,) * 2)
    machine(SECOND)
    assert (dead.exists(), living.exists()) == (False, True)


def test_a_store_fetched_while_it_is_made_here_is_kept(machine: Machine) -> None:
    """Another process of this machine fetched the store that another machine published; its files stay in place."""
    mine = machine(FIRST)
    read: list[int] = []

    def build(path: Path) -> None:
        (path / "a.bin").write_bytes(b"mine")
        theirs = lambda path: (path / "a.bin").write_bytes(b"theirs")  # noqa: E731
        ref, _ = machine(SECOND).produce("rectify", theirs, version=1, params={})
        read.append((machine(FIRST).find("rectify", ref.key).path / "a.bin").stat().st_ino)

    ref, _ = mine.produce("rectify", build, version=1, params={})
    assert (ref.path / "a.bin").read_bytes() == b"theirs"
    assert read == [(ref.path / "a.bin").stat().st_ino]


def test_a_store_cleared_by_one_machine_is_remade_by_another(machine: Machine) -> None:
    """Clearing removes the files from the bucket and keeps the manifest; the files are made with the same bytes."""
    first = machine(FIRST)
    small = small_survey(first)
    before = (small.mosaic.path / "data.bin").read_bytes()
    assert first.clear(small.mosaic)
    names = sorted(name.rpartition("/")[2] for name in first.objects.listing(small.mosaic.uri))
    assert names == ["cleared", "manifest.json"]
    assert problems(first) == []
    assert first.find("rectify", small.mosaic.key) is None
    third = machine("third")
    assert third.find("rectify", small.mosaic.key) is None
    again = small_survey(third)
    assert any(name.endswith("/data.bin") for name in third.objects.listing(again.mosaic.uri))
    assert (third.root / again.mosaic.uri / "data.bin").read_bytes() == before
    assert problems(third) == []


def test_a_run_of_a_bucket_is_a_recording(bucket: str, machine: Machine) -> None:
    """The newest run, a named run and a store give the cubes that the first machine wrote; others are refused."""
    archive = machine(FIRST)
    source = simulated()
    ref, _ = archive.produce("capture", partial(write_raw, source=source, sweep=FULL), version=1, params={})
    with archive.new_run("field") as draft:
        draft.write_file("receipt.json", json.dumps({"products": {"raw_coarse": ref.uri}}))
    machine(SECOND)
    for address in (bucket, f"{bucket}/runs/{draft.id}", f"{bucket}/{ref.uri}", f"{bucket}/{ref.uri}/scan-0.zarr"):
        (sweep,) = open_recording(address, CAMERA).sweeps
        np.testing.assert_array_equal(sweep.read(0, 80), np.stack([line.data for line in source.lines(FULL)]))
    with pytest.raises(ArchiveError, match="has no run 'other'"):
        open_recording(f"{bucket}/runs/other", CAMERA)
    assert find_recorded_run(f"{bucket}/{ref.uri}") is None
    with pytest.raises(IncompleteStoreError, match="stages/capture/0123"):
        open_recording(f"{bucket}/stages/capture/0123", CAMERA)
