"""A published run stays whole while it is extended: after any failure it has the addition or lacks it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from pipeline.errors import ArchiveError
from storage.archive import run_folders
from storage.archive.archive import Archive
from storage.archive.lineage import Catalogue
from storage.archive.manifests import read_manifest
from storage.archive.records import read_run
from storage.archive.run_folders import try_exchange
from storage.archive.staging import PART_SUFFIX
from storage.maintenance.garbage import clear_up
from tests.storage.small_archive import problems, small_survey
from tests.storage.small_bucket import FIRST, SECOND, Machine

ROOT = Path(__file__).parents[3]
KILL_EVERYWHERE = """
import os, shutil, sys
from pathlib import Path
from storage.archive.archive import Archive
from tests.faults.injection import end_at, logged_calls
from tests.storage.archive.test_run_extensions import extend, run_id

base, folder = Path(sys.argv[1]), Path(sys.argv[2])

def end(at):
    shutil.copytree(base, folder / f"{at}")
    child = os.fork()
    if child == 0:
        end_at(str(folder / f"{at}"), at, 9, log=str(folder / f"{at}.calls"))
        archive = Archive.open(folder / f"{at}")
        extend(archive, run_id(archive))
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

assert end(0) == 0
calls = len(logged_calls(folder / "0.calls"))
assert [end(at) for at in range(1, calls + 1)] == [-9] * calls
print(calls)
"""


def run_id(archive: Archive) -> str:
    """Return the name of the archive's only run."""
    (folder,) = archive.runs()
    return folder.name


def extend(archive: Archive, name: str, figure: float = 0.75) -> Path:
    """Evaluate the small survey's map, and publish the run again with the accuracy."""

    def build(path: Path) -> None:
        (path / "accuracy.json").write_text(json.dumps({"miou": figure}))

    (map_,) = archive.refs("segment")
    ref, _ = archive.produce("evaluate", build, version=1, params={"figure": figure}, inputs=[map_.key])
    with archive.extend_run(name) as draft:
        before = json.loads((draft.published / "receipt.json").read_text())
        products = {**before["products"], "accuracy": f"{ref.uri}/accuracy.json"}
        draft.write_file("receipt.json", json.dumps({**before, "products": products, "accuracy": {"miou": figure}}))
        return draft.publish(survey="farm", rests_on=archive.manifest_hashes([map_, ref]))


def figure_of(archive: Archive) -> float | None:
    """Return the accuracy in the receipt of the only run, None where there is none yet."""
    found = read_run(archive.root / "runs" / run_id(archive))
    assert found.problem is None
    return found.receipt.get("accuracy", {}).get("miou")


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an archive with one run."""
    opened = Archive.open(tmp_path / "archive")
    small_survey(opened)
    return opened


def test_an_extended_run_keeps_its_name_and_date(archive: Archive) -> None:
    """There is still one run folder; the run depends on the added store as well, and verification passes."""
    name = run_id(archive)
    created = read_manifest(archive.root / "runs" / name)["created"]
    folder = extend(archive, name)
    assert [path.name for path in (archive.root / "runs").iterdir()] == [name] == [folder.name]
    (run,) = Catalogue.read(archive.root).runs
    assert (run.created, figure_of(archive)) == (created, 0.75)
    assert any(uri.startswith("stages/evaluate/") for uri in run.names)
    assert problems(archive) == []


def test_an_unpublished_extension_changes_nothing(archive: Archive) -> None:
    """A block that raises, or ends without publishing, leaves the run as it was and no other folder."""
    name = run_id(archive)
    before = (archive.runs()[0] / "manifest.json").read_bytes()
    for error in (None, KeyboardInterrupt(), ArchiveError("the disk is full")):
        with suppress(KeyboardInterrupt, ArchiveError), archive.extend_run(name) as draft:
            draft.write_file("receipt.json", "{}")
            if error is not None:
                raise error
        assert (archive.runs()[0] / "manifest.json").read_bytes() == before
        assert [path.name for path in (archive.root / "runs").iterdir()] == [name]
        assert problems(archive) == []


def test_a_run_is_extended_by_one_process_at_a_time(archive: Archive) -> None:
    """Without waiting a second process gets None, and gc leaves the draft alone; a missing run's error names it."""
    name = run_id(archive)
    with archive.extend_run(name):
        assert archive.extend_run(name, wait=False) is None
        assert archive.reclaim() == []
        assert clear_up(archive, keep_days=0).removals == ()
        assert problems(archive) == []
    with pytest.raises(ArchiveError, match=r"there is no run 20261120T101701-gone in .*; see ls"):
        archive.extend_run("20261120T101701-gone")


def test_leaving_a_published_draft_keeps_the_next_draft(archive: Archive) -> None:
    """Another process may begin its draft between a publication and the end of that process's block."""
    for draft in (archive.extend_run(run_id(archive)), archive.new_run("new")):
        with draft:
            draft.write_file("receipt.json", "{}")
            draft.publish()
            draft.folder.mkdir()
        assert list(draft.folder.iterdir()) == []


def test_a_run_stays_whole_when_killed_at_any_system_call(archive: Archive, tmp_path: Path) -> None:
    """The run verifies, with the addition or without it; the next extension succeeds and leaves no draft."""
    command = [sys.executable, "-c", KILL_EVERYWHERE, str(archive.root), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    calls = int(subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True).stdout)
    assert calls > 30
    seen = set()
    for at in range(1, calls + 1):
        out = tmp_path / f"{at}"
        opened = Archive.open(out)
        assert problems(opened) == []
        seen.add(figure_of(opened))
        extend(opened, run_id(opened))
        assert (figure_of(opened), problems(opened)) == (0.75, [])
        opened.reclaim()
        assert not [*out.rglob(f"*{PART_SUFFIX}")]
    assert seen == {None, 0.75}


def test_interrupted_replacement_of_files_is_reported(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without folder exchange, a run killed before its manifest is replaced is damaged: verify names it, gc works."""
    monkeypatch.setattr(run_folders, "try_exchange", lambda one, other: False)
    name = run_id(archive)
    replace = Path.replace

    def refuse(self: Path, to: Path) -> Path:
        if to.name == "manifest.json":
            raise KeyboardInterrupt
        return replace(self, to)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refuse)
        with pytest.raises(KeyboardInterrupt):
            extend(archive, name)
    (found,) = problems(archive)
    assert found.startswith(f"runs/{name} receipt.json has")
    assert clear_up(archive, keep_days=9, dry_run=True).obstacle is None


# --- in a bucket ------------------------------------------------------------------------------------------------------


def test_an_extension_reaches_other_machines(machine: Machine) -> None:
    """A machine that already has the run fetches the addition; no old file is left, and all verifies."""
    archive = machine(FIRST)
    small_survey(archive)
    other = machine(SECOND, create=False)
    assert figure_of(other) is None
    extend(archive, run_id(archive))
    assert problems(archive) == []
    other = machine(SECOND, create=False)
    assert (figure_of(other), problems(other)) == (0.75, [])
    assert clear_up(other, keep_days=0).removals == ()


def test_gc_removes_old_files_of_an_interrupted_extension(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine was killed before it removed them; other machines read the extended run."""
    archive = machine(FIRST)
    small_survey(archive)
    machine(SECOND, create=False)
    with monkeypatch.context() as patch:
        patch.setattr(archive.objects, "remove", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            extend(archive, run_id(archive))
    other = machine(SECOND, create=False)
    assert (figure_of(other), problems(other)) == (0.75, [])
    (gone,) = clear_up(other, keep_days=0).removals
    assert gone.what == "leftover"
    assert (figure_of(machine(SECOND, create=False)), problems(machine(FIRST))) == (0.75, [])


def test_a_damaged_manifest_in_the_bucket_is_not_fetched(machine: Machine) -> None:
    """The manifest of an extended run is fetched again; a damaged one is reported and does not replace the copy."""
    archive = machine(FIRST)
    small_survey(archive)
    extend(archive, run_id(archive))
    name = f"runs/{run_id(archive)}/manifest.json"
    archive.objects.write(f"runs/{run_id(archive)}/{'0' * 16}/receipt.json", b"of before, and not cleared away yet")
    archive.objects.write(name, (archive.objects.read(name) or b"").replace(b'"survey": "farm"', b'"survey": "fern"'))
    again = machine(FIRST, create=False)
    assert figure_of(again) == 0.75
    assert any("its seal does not fit" in one for one in problems(again))


def test_try_exchange_swaps_two_folders(tmp_path: Path) -> None:
    """Each folder gets the other's content; a missing folder raises FileNotFoundError."""
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "who").write_text(name)
    assert try_exchange(tmp_path / "a", tmp_path / "b")
    assert [(tmp_path / name / "who").read_text() for name in "ab"] == ["b", "a"]
    with pytest.raises(FileNotFoundError):
        try_exchange(tmp_path / "a", tmp_path / "c")
