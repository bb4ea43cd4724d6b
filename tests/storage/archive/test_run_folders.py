"""A run is published whole or not at all, once, and wherever its process is killed."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from spectralzoom.pipeline.errors import ArchiveError
from spectralzoom.storage.runs import clear_up
from spectralzoom.storage.store import Archive
from spectralzoom.storage.whole_files import PART
from tests.storage.small_archive import problems, small_survey

ROOT = Path(__file__).parents[3]
KILL_EVERYWHERE = """
import os, shutil, sys
from pathlib import Path
from tests.faults.injection import end_at, logged_calls
from tests.storage.small_archive import small_survey

base, folder = Path(sys.argv[1]), Path(sys.argv[2])

def end(at):
    shutil.copytree(base, folder / f"{at}")
    child = os.fork()
    if child == 0:
        end_at(str(folder / f"{at}"), at, 9, log=str(folder / f"{at}.calls"))
        archive = Archive.open(folder / f"{at}")
        archive.clear(archive.refs("rectify")[0])
        small_survey(archive)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

assert end(0) == 0
calls = len(logged_calls(folder / "0.calls"))
assert [end(at) for at in range(1, calls + 1)] == [-9] * calls
print(calls)
"""


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an archive with the stores of one survey, which no run names."""
    opened = Archive.open(tmp_path / "archive")
    small_survey(opened, named=False)
    return opened


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ArchiveError("the disk is full")], ids=repr)
def test_an_unpublished_draft_leaves_nothing(archive: Archive, error: BaseException) -> None:
    """A block that raises removes its folder."""
    with suppress(KeyboardInterrupt, ArchiveError), archive.new_run("farm") as draft:
        draft.write_file("receipt.json", "{}")
        raise error
    assert list((archive.root / "runs").iterdir()) == []
    assert problems(archive) == []


def test_gc_leaves_a_draft_alone(archive: Archive) -> None:
    """It is no leftover while its process lives."""
    with archive.new_run("farm") as draft:
        assert archive.reclaim() == []
        clear_up(archive, keep_days=0)
        assert draft.folder.is_dir()
        draft.write_file("receipt.json", "{}")


def test_leaving_a_published_draft_keeps_the_next_draft(archive: Archive) -> None:
    """Another process may begin its draft between a publication and the end of that process's block."""
    with archive.new_run("new") as draft:
        draft.write_file("receipt.json", "{}")
        draft.publish()
        draft.folder.mkdir()
    assert list(draft.folder.iterdir()) == []


def test_an_archive_verifies_after_a_kill_at_any_system_call(archive: Archive, tmp_path: Path) -> None:
    """A store is cleared and made again, and a run is published: it is whole or absent, and the next survey ends."""
    command = [sys.executable, "-c", KILL_EVERYWHERE, str(archive.root), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    calls = int(subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True).stdout)
    assert calls > 30
    seen = set()
    for at in range(1, calls + 1):
        out = tmp_path / f"{at}"
        opened = Archive.open(out)
        assert problems(opened) == []
        seen.add(len(opened.runs()))
        opened.reclaim()
        again = small_survey(opened)
        assert problems(opened) == []
        assert opened.is_there(again.mosaic.uri)
        assert not [*out.rglob(f"*{PART}")]
    assert seen == {0, 1}
