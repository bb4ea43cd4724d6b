"""Stores whose files are cleared away: their manifests stay, and whoever asks for them has them made again."""

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
    """Addresses of the mosaics of which the files go."""
    there = [ref for ref in archive.refs("rectify") if archive.is_there(ref.uri)]
    return [ref.uri for ref in there if archive.clear(ref, wait=False)]


def content(ref: StageRef) -> str:
    """Hash of the one file of a small store."""
    return hashlib.sha256((ref.path / "data.bin").read_bytes()).hexdigest()


def test_the_files_go_and_the_manifest_stays(archive: Archive) -> None:
    """What it was made of, what it took and how large it was is told yet; the archive is whole."""
    small = small_survey(archive)
    before, size = archive.manifest(small.mosaic), archive.stored_bytes(small.mosaic)
    assert cleared(archive) == [small.mosaic.uri]
    assert [path.name for path in small.mosaic.path.iterdir()] == ["manifest.json"]
    after = archive.manifest(small.mosaic)
    for name in ("key", "params", "inputs", "created"):
        assert after[name] == before[name]
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
    with pytest.raises(IncompleteStoreError, match=r"cleared away\. Run its survey again, for raw lines with --keep"):
        archive.locate(f"{small.mosaic.uri}/mosaic.zarr")


def test_a_store_that_is_cleared_while_checked_is_whole(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a survey beside it: neither its reader nor verify takes it for damaged."""
    small, problem = small_survey(archive), manifests.file_problem

    def clear_first(path: Path, *given: Any, **options: Any) -> str | None:
        archive.clear(small.mosaic)
        return problem(path, *given, **options)

    monkeypatch.setattr(manifests, "file_problem", clear_first)
    manifests.check_files(small.mosaic.path, hashes=False)
    small_survey(archive, named=False)
    assert problems(archive) == []


@pytest.mark.parametrize("exchanges", [True, False])
def test_broken_off_it_leaves_a_store_whole(archive: Archive, monkeypatch: pytest.MonkeyPatch, exchanges: bool) -> None:
    """Whichever rename fails, the files are there yet, or can be had again."""
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
