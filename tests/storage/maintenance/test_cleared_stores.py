"""Cleared stores: their files are removed and their manifests stay; the next request makes the files again."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError
from spectralzoom.storage.archive import manifests
from spectralzoom.storage.runs import clear_up
from spectralzoom.storage.store import Archive, Ref
from tests.storage.small_archive import problems, small_survey


def cleared(archive: Archive) -> list[str]:
    """Clear the mosaics whose files are there, and return their addresses."""
    there = [ref for ref in archive.refs("rectify") if archive.is_there(ref.uri)]
    return [ref.uri for ref in there if archive.clear(ref, wait=False)]


def content(ref: Ref) -> str:
    """Return the hash of the one file of a small store."""
    return hashlib.sha256((ref.path / "data.bin").read_bytes()).hexdigest()


def test_clear_removes_files_and_keeps_the_manifest(archive: Archive) -> None:
    """The manifest is unchanged, and so is its hash in those that name it; verify finds no problem."""
    small = small_survey(archive)
    before = archive.manifest(small.mosaic)
    size = archive.stored_bytes(small.mosaic)
    assert cleared(archive) == [small.mosaic.uri]
    assert sorted(path.name for path in small.mosaic.path.iterdir()) == ["cleared", "manifest.json"]
    assert archive.manifest(small.mosaic) == before
    assert archive.stored_bytes(small.mosaic) == size > read_store(small.mosaic).size == 0
    assert problems(archive) == []
    assert cleared(archive) == []
    assert archive.clear(small.mosaic)  # a second time
    assert archive.stored_bytes(small.mosaic) == size
    assert archive.find("capture", small.raw.key) is not None


def test_a_cleared_store_is_made_again_on_request(archive: Archive) -> None:
    """The store has the same bytes at the same address; verify finds no problem, and it can be cleared again."""
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


def test_locating_a_cleared_store_explains_what_to_do(archive: Archive) -> None:
    """The error says to run the survey again."""
    small = small_survey(archive)
    cleared(archive)
    with pytest.raises(IncompleteStoreError, match=r"cleared away\. Run its survey again, for raw lines with --keep"):
        archive.locate(f"{small.mosaic.uri}/mosaic.zarr")


def test_a_store_cleared_during_a_check_is_not_damaged(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another survey may clear it while a reader or verify checks its files."""
    small = small_survey(archive)
    problem = manifests.file_problem

    def clear_first(path: Path, *given: Any, **options: Any) -> str | None:
        archive.clear(small.mosaic)
        return problem(path, *given, **options)

    monkeypatch.setattr(manifests, "file_problem", clear_first)
    manifests.check_files(small.mosaic.path, hashes=False)
    small_survey(archive, named=False)
    assert problems(archive) == []


def test_an_interrupted_clear_counts_as_cleared(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mark comes first: a kill before or between the deletions leaves a cleared store, which gc empties."""
    small = small_survey(archive)
    before = content(small.mosaic)
    with monkeypatch.context() as patch:
        patch.setattr(manifests, "cleared_leftovers", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            cleared(archive)
    assert content(small.mosaic) == before
    assert not archive.is_there(small.mosaic.uri)
    assert problems(archive) == []
    assert [one.uri for one in clear_up(archive, keep_days=9).removals] == [small.mosaic.uri]
    assert clear_up(archive, keep_days=9).removals == ()
    assert sorted(path.name for path in small.mosaic.path.iterdir()) == ["cleared", "manifest.json"]
    assert content(small_survey(archive, named=False).mosaic) == before


def test_a_full_disk_at_the_mark_is_one_error(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store is there or cleared, and can be made again."""
    small = small_survey(archive)
    before = content(small.mosaic)
    with monkeypatch.context() as patch:
        patch.setattr(manifests, "sync_path", Mock(side_effect=OSError(28, "full")))
        with pytest.raises(ArchiveError, match="the disk is full"):
            cleared(archive)
    assert problems(archive) == []
    assert content(small_survey(archive, named=False).mosaic) == before


def test_an_interrupted_refill_counts_as_cleared(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before its last step the store has files and its mark; the next request makes it again."""
    small = small_survey(archive)
    before = content(small.mosaic)
    cleared(archive)
    for step in range(1, 4):
        with monkeypatch.context() as patch:
            patch.setattr(manifests, "sync_path", _interrupt_at(step, manifests.sync_path))
            with pytest.raises(KeyboardInterrupt):
                small_survey(archive, named=False)
        assert problems(archive) == []
    assert content(small_survey(archive, named=False).mosaic) == before
    assert problems(archive) == []


def _interrupt_at(step: int, sync: Any) -> Any:
    """Return a function that syncs, and is interrupted at the call of this number for a store's folder."""
    calls = iter(range(1, 100))

    def interrupted(path: Path) -> None:
        sync(path)
        if path.is_dir() and not path.name.endswith(".part") and next(calls) == step:
            raise KeyboardInterrupt

    return interrupted
