"""Cleared stores: their files are removed and their manifests stay; the next request makes the files again."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive import manifests, run_folders
from storage.archive.archive import Archive
from storage.archive.keys import StageRef
from storage.archive.records import read_store
from tests.storage.small_archive import problems, small_survey


def cleared(archive: Archive) -> list[str]:
    """Clear the mosaics whose files are there, and return their addresses."""
    there = [ref for ref in archive.refs("rectify") if archive.is_there(ref.uri)]
    return [ref.uri for ref in there if archive.clear(ref, wait=False)]


def content(ref: StageRef) -> str:
    """Return the hash of the one file of a small store."""
    return hashlib.sha256((ref.path / "data.bin").read_bytes()).hexdigest()


def test_clear_removes_files_and_keeps_the_manifest(archive: Archive) -> None:
    """Key, parameters, inputs, date and size are still known, and verify finds no problem."""
    small = small_survey(archive)
    before = archive.manifest(small.mosaic)
    size = archive.stored_bytes(small.mosaic)
    assert cleared(archive) == [small.mosaic.uri]
    assert [path.name for path in small.mosaic.path.iterdir()] == ["manifest.json"]
    after = archive.manifest(small.mosaic)
    for name in ("key", "params", "inputs", "created"):
        assert after[name] == before[name]
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


@pytest.mark.parametrize("exchanges", [True, False])
def test_interrupted_clear_keeps_the_store(archive: Archive, monkeypatch: pytest.MonkeyPatch, exchanges: bool) -> None:
    """If a sync fails, with or without folder exchange, the files are still there and can be cleared later."""
    small = small_survey(archive)
    before = content(small.mosaic)
    if not exchanges:
        monkeypatch.setattr(run_folders, "try_exchange", lambda one, other: False)
    with monkeypatch.context() as patch:
        patch.setattr(run_folders, "sync_path", Mock(side_effect=OSError(28, "full")))
        with pytest.raises(ArchiveError, match="the disk is full"):
            cleared(archive)
    assert content(small.mosaic) == before
    assert problems(archive) == []
    assert cleared(archive) == [small.mosaic.uri]
    assert content(small_survey(archive, named=False).mosaic) == before
