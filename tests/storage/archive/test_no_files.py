"""Links, pipes and copies in an archive: verify tells each by its address, and no reader follows or waits for one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.errors import ArchiveError, IncompleteStoreError
from storage.archive.archive import Archive
from storage.archive.records import read_run
from storage.maintenance.garbage import clear_up
from storage.remote.opening import verify_archive
from tests.storage.small_archive import Small, small_survey

ELSEWHERE = "elsewhere"  # beside the archive


def away(path: Path) -> Path:
    """Move something out of the archive."""
    root = next(parent for parent in path.parents if parent.name == "archive")
    return path.rename(root.with_name(ELSEWHERE))


def link_store(small: Small) -> str:
    """A store replaced by a link to itself, outside."""
    small.mosaic.path.symlink_to(away(small.mosaic.path))
    return small.mosaic.uri


def link_nowhere(small: Small) -> str:
    """A store replaced by a link that leads nowhere."""
    away(small.mosaic.path)
    small.mosaic.path.symlink_to("nowhere")
    return small.mosaic.uri


def link_manifest(small: Small) -> str:
    """A manifest replaced by a link to itself, outside."""
    path = small.mosaic.path / "manifest.json"
    path.symlink_to(away(path))
    return small.mosaic.uri


def link_file(small: Small) -> str:
    """A file of a store replaced by a link to itself, outside."""
    path = small.mosaic.path / "data.bin"
    path.symlink_to(away(path))
    return small.mosaic.uri


def pipe_file(small: Small) -> str:
    """A pipe without a writer in place of a store's file."""
    (small.mosaic.path / "data.bin").unlink()
    os.mkfifo(small.mosaic.path / "data.bin")
    return small.mosaic.uri


def pipe_more(small: Small) -> str:
    """A pipe beside the files of a store."""
    (small.mosaic.path / "inner").mkdir()
    os.mkfifo(small.mosaic.path / "inner" / "more")
    return small.mosaic.uri


def pipe_manifest(small: Small) -> str:
    """A pipe in place of a manifest."""
    (small.mosaic.path / "manifest.json").unlink()
    os.mkfifo(small.mosaic.path / "manifest.json")
    return small.mosaic.uri


def pipe_store(small: Small) -> str:
    """A pipe in place of a store."""
    away(small.mosaic.path)
    os.mkfifo(small.mosaic.path)
    return small.mosaic.uri


def pipe_receipt(small: Small) -> str:
    """A pipe in place of a run's receipt."""
    (small.run / "receipt.json").unlink()
    os.mkfifo(small.run / "receipt.json")
    return f"runs/{small.run.name}"


def link_run(small: Small) -> str:
    """A run replaced by a link to itself, outside."""
    small.run.symlink_to(away(small.run))
    return f"runs/{small.run.name}"


def link_run_manifest(small: Small) -> str:
    """A run's manifest replaced by a link that leads nowhere."""
    (small.run / "manifest.json").unlink()
    (small.run / "manifest.json").symlink_to("nowhere")
    return f"runs/{small.run.name}"


def pipe_spool(small: Small) -> str:
    """A pipe in place of a spool's index."""
    folder = small.mosaic.path.parents[2] / "spool" / "key"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "lines.index")
    return "spool/key/lines.index"


CASES = [
    link_store,
    link_nowhere,
    link_manifest,
    link_file,
    pipe_file,
    pipe_more,
    pipe_manifest,
    pipe_store,
    pipe_receipt,
    link_run,
    link_run_manifest,
    pipe_spool,
]
Case = Callable[[Small], str]


@pytest.mark.parametrize("case", CASES)
def test_verify_tells_it_by_name(case: Case, tmp_path: Path) -> None:
    """With what it is, and nothing of what is whole is doubted for it."""
    archive = Archive.open(tmp_path / "archive")
    small = small_survey(archive)
    uri = case(small)
    told = [(one.uri, str(one.problem)) for one in verify_archive(archive) if one.problem is not None]
    kind = case.__name__.partition("_")[0]
    assert any(f"is a {kind}" in problem for _, problem in told), told
    assert {place for place, _ in told} == {uri}


@pytest.mark.parametrize("case", CASES)
def test_readers_end(case: Case, tmp_path: Path) -> None:
    """A survey that looks for the store, gc, what reads runs: an answer or one error, and nothing outside changes."""
    archive = Archive.open(tmp_path / "archive")
    small = small_survey(archive)
    uri = case(small)
    outside = tmp_path / ELSEWHERE
    before = sorted(path.name for path in outside.rglob("*")) if outside.is_dir() else outside.exists()
    if uri == small.mosaic.uri and case is not pipe_more:
        with pytest.raises(IncompleteStoreError):
            archive.find("rectify", small.mosaic.key)
        with pytest.raises(IncompleteStoreError):
            archive.locate(f"{small.mosaic.uri}/data.bin")
    for folder in archive.runs():
        read_run(folder, {})
    small_survey(archive, seed=1)  # dates its stores by all runs
    clear_up(archive, keep_days=0, raw_too=True)
    assert (sorted(path.name for path in outside.rglob("*")) if outside.is_dir() else outside.exists()) == before


def test_a_copied_run_is_told(archive: Archive) -> None:
    """By the name of the copy, and which run it is of; a run under another name as well."""
    small = small_survey(archive)
    copy = shutil.copytree(small.run, small.run.with_name(f"{small.run.name}-copy"))
    (found,) = (one for one in verify_archive(archive) if one.problem is not None)
    assert (found.uri, found.kind) == (f"runs/{copy.name}", "stray")
    assert (
        found.problem == f"its manifest.json is that of runs/{small.run.name}; it is a copy: take it out of the archive"
    )
    shutil.rmtree(small.run)
    (found,) = (one for one in verify_archive(archive) if one.problem is not None)
    assert str(found.problem).endswith(f"is that of runs/{small.run.name}; give it its name back")


@pytest.mark.parametrize("name", ["stages", "stages/rectify", "runs", "spool", "schedule", ".locks"])
def test_a_linked_part_is_refused_at_the_door(tmp_path: Path, name: str) -> None:
    """One message with what to do; that the archive is itself reached by a link is no matter."""
    small_survey(Archive.open(tmp_path / "archive"))
    (tmp_path / "link").symlink_to("archive")
    assert len(Archive.open(tmp_path / "link").refs()) == 3
    part = tmp_path / "archive" / name
    part.mkdir(exist_ok=True)
    part.rename(tmp_path / ELSEWHERE)
    part.symlink_to(tmp_path / ELSEWHERE)
    with pytest.raises(ArchiveError, match=f"archive/{name} is a link, which is not followed; put the folder"):
        Archive.open(tmp_path / "archive", create=False, write=False)


def test_a_linked_lock_is_refused(tmp_path: Path) -> None:
    """No file is made or opened where it leads."""
    archive = Archive.open(tmp_path / "archive")
    (archive.root / ".locks").mkdir()
    (archive.root / ".locks" / "use.lock").symlink_to(tmp_path / ELSEWHERE)
    with pytest.raises(ArchiveError, match=r"use\.lock is a link, expected a lock file of its own"), archive.in_use():
        pass
    assert not (tmp_path / ELSEWHERE).exists()
