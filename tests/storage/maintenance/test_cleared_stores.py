"""Stores whose files are cleared away: their manifests stay, and whoever asks for them has them made again."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive import run_folders
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.records import read_store
from storage.maintenance.garbage import IN_USE, clear_up, plan_clearance
from tests.storage.small_archive import flip, problems, small_survey

MOSAICS = {"rectify": 1}  # of which the files may go


def cleared(archive: Archive, **more: object) -> list[str]:
    """Addresses of which the files go."""
    done = clear_up(archive, keep_days=0, made_again=MOSAICS, **more)  # type: ignore[arg-type]
    return [one.uri for one in done.removals if one.what == "files"]


def content(ref: StageRef) -> str:
    """Hash of the one file of a small store."""
    return hashlib.sha256((ref.path / "data.bin").read_bytes()).hexdigest()


def test_the_files_go_and_the_manifest_stays(archive: Archive) -> None:
    """What it was made of, what it took and how large it was is told yet; the archive is whole."""
    small = small_survey(archive)
    before, size = archive.manifest(small.mosaic), archive.stored_bytes(small.mosaic)
    assert cleared(archive, dry_run=True) == cleared(archive) == [small.mosaic.uri]
    assert [path.name for path in small.mosaic.path.iterdir()] == ["manifest.json"]
    after = archive.manifest(small.mosaic)
    assert {name: after[name] for name in ("key", "params", "inputs", "created")} == {
        name: before[name] for name in ("key", "params", "inputs", "created")
    }
    assert archive.stored_bytes(small.mosaic) == size > read_store(small.mosaic).size == 0
    assert problems(archive) == []
    assert cleared(archive) == []
    assert archive.clear(small.mosaic)  # once more
    assert archive.stored_bytes(small.mosaic) == size
    assert archive.find("capture", small.raw.key) is not None


def test_what_is_asked_for_is_made_again(archive: Archive) -> None:
    """The same bytes under the same address; the run that names it finds nothing wrong, and it can go again."""
    small = small_survey(archive)
    before = content(small.mosaic)
    cleared(archive)
    assert archive.find("rectify", small.mosaic.key) is None
    again = small_survey(archive, named=False)
    assert again.mosaic == small.mosaic
    assert content(again.mosaic) == before
    assert archive.find("rectify", small.mosaic.key) is not None
    assert problems(archive) == []
    assert cleared(archive) == [small.mosaic.uri]
    assert problems(archive) == []


def test_a_reader_of_what_was_cleared_is_told_what_to_do(archive: Archive) -> None:
    """No file is looked for that is not there."""
    small = small_survey(archive)
    cleared(archive)
    with pytest.raises(IncompleteStoreError, match="cleared away by gc; run its survey again"):
        archive.locate(f"{small.mosaic.uri}/mosaic.zarr")


def test_what_cannot_be_made_again_stays(archive: Archive) -> None:
    """Stores of another version of their stage, and those of which the raw lines are damaged or gone."""
    small = small_survey(archive)
    assert clear_up(archive, keep_days=0, made_again={"rectify": 2, "capture": 7}).removals == ()
    flip(small.raw.path / "manifest.json", at=20)
    assert cleared(archive) == []
    assert content(small.mosaic)


def test_unnamed_and_young_stores_are_not_cleared(archive: Archive) -> None:
    """What no run names goes as a whole; what a survey may just be reading stays."""
    gone = small_survey(archive, named=False)
    removals = plan_clearance(archive, keep_days=0, made_again=MOSAICS).removals
    assert {(one.uri, one.what) for one in removals} == {
        (ref.uri, "store") for ref in (gone.raw, gone.mosaic, gone.map)
    }
    small_survey(archive)
    assert plan_clearance(archive, keep_days=1, made_again=MOSAICS).removals == ()


def test_nothing_is_cleared_while_somebody_works(archive: Archive) -> None:
    """Neither in an archive that is in use, nor a store that is being made."""
    small = small_survey(archive)
    with archive.in_use():
        done = clear_up(archive, keep_days=0, made_again=MOSAICS)
    assert (done.removals, done.obstacle) == ((), IN_USE)
    with archive._locked(f"rectify-{small.mosaic.key}"):
        assert cleared(archive) == []
    assert content(small.mosaic)


@pytest.mark.parametrize("exchanges", [True, False])
def test_broken_off_it_leaves_the_store_whole(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, exchanges: bool
) -> None:
    """Whichever rename fails, the files are there yet, or can be had again."""
    small = small_survey(archive)
    before = content(small.mosaic)
    if not exchanges:
        monkeypatch.setattr(run_folders, "try_exchange", lambda one, other: False)

    def refuse(path: Path) -> None:
        raise OSError(28, "full")

    with monkeypatch.context() as patch:
        patch.setattr(run_folders, "sync_path", refuse)
        with pytest.raises(ArchiveError, match="the disk is full"):
            cleared(archive)
    assert content(small.mosaic) == before
    assert problems(archive) == []
    assert cleared(archive) == [small.mosaic.uri]
    assert content(small_survey(archive, named=False).mosaic) == before


def test_a_manifest_that_says_so_falsely_is_found(archive: Archive) -> None:
    """A store is cleared by its checksummed manifest, which names the one that runs know."""
    small = small_survey(archive)
    other = small_survey(archive, kernel="nearest")
    cleared(archive)
    (small.mosaic.path / "manifest.json").write_bytes((other.mosaic.path / "manifest.json").read_bytes())
    assert any("is that of" in problem for problem in problems(archive))
