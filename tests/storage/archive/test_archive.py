"""Stores appear whole or not at all, never change, and verification finds every change."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.storage.archive import manifests, staging
from spectralzoom.storage.runs import verify_everything
from spectralzoom.storage.store import Archive, check_store, read_table, stage_key, text_of
from spectralzoom.storage.whole_files import take_lock


def _publish(archive: Archive, key: str = "abc", text: str = "content") -> Path:
    with archive.publish("mosaic", key, version=3, params={"tol": 0.1}, inputs=["k0"]) as staged:
        (staged.path / "inner").mkdir()
        (staged.path / "inner" / "a.txt").write_text(text)
        (staged.path / "b.bin").write_bytes(bytes(range(256)) * 100)
    return staged.ref.path


def test_a_store_is_found_with_its_manifest(tmp_path: Path) -> None:
    """Before publication `find` returns None; afterwards the manifest has files, hashes and parameters."""
    archive = Archive.open(tmp_path / "archive")
    assert archive.find("mosaic", "abc") is None
    path = _publish(archive)
    ref = archive.find("mosaic", "abc")
    assert (ref.uri, ref.path) == ("stages/mosaic/abc", path)
    manifest = archive.manifest(ref)
    assert (manifest["version"], manifest["params"], manifest["inputs"]) == (3, {"tol": 0.1}, ["k0"])
    assert set(manifest["files"]) == {"inner/a.txt", "b.bin"}
    assert archive.stored_bytes(ref) == 25600 + 7
    check_store(ref.path, hashes=True)
    assert archive.refs() == [ref]


def test_a_failed_stage_leaves_nothing(tmp_path: Path, archive: Archive) -> None:
    """The exception propagates, the staged folder is removed, and the key stays free."""

    def fail(path: Path) -> None:
        (path / "a").write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        archive.produce("mosaic", fail, version=1, params={})
    assert archive.refs() == []
    assert list((tmp_path / "stages" / "mosaic").iterdir()) == []


def test_leftovers_of_dead_processes_are_reclaimed(tmp_path: Path, archive: Archive) -> None:
    """A .part folder of a dead process is ignored; the next publication of its key or `reclaim` removes it."""
    for key in ("abc", "def"):
        (tmp_path / "stages" / "mosaic" / f"{key}.part").mkdir(parents=True)
        (tmp_path / "stages" / "mosaic" / f"{key}.part" / "old").write_text("x")
    assert archive.refs() == []
    assert not (_publish(archive) / "old").exists()
    assert archive.reclaim() == ["stages/mosaic/def.part"]
    assert [ref.key for ref in archive.refs()] == ["abc"]


def test_spooled_lines_of_a_cleared_capture_are_kept(archive: Archive) -> None:
    """Reclaim removes the spooled lines of a published capture only."""
    _publish(archive)
    (archive.spool_folder("abc") / "lines").write_text("x")
    archive.clear(archive.refs()[0])
    assert archive.reclaim() == []
    _publish(archive)
    assert archive.reclaim() == ["spool/abc"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text + " ", "its seal does not fit"),
        (lambda text: text.replace(": ", ":  ", 1), "its seal does not fit"),
        (lambda text: text[:40], r"no valid manifest\.json"),
    ],
)
def test_any_changed_byte_of_a_manifest_is_detected(archive: Archive, change: Callable[[str], str], words: str) -> None:
    """White space counts as well; a truncated manifest is reported as not valid."""
    path = _publish(archive) / "manifest.json"
    path.write_text(change(path.read_text()))
    with pytest.raises(IncompleteStoreError, match=words):
        archive.find("mosaic", "abc")


def test_a_store_is_synced_before_and_after_its_rename(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files, manifest and folders are synced first, then the store is renamed, then its parent folder is synced."""
    told: list[str] = []
    rename = Path.rename

    def renamed(self: Path, to: Path) -> Path:
        told.append(f"rename {self.name}")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", renamed)
    for module in (staging, manifests):
        monkeypatch.setattr(module, "sync_path", lambda path: told.append(path.name))
    _publish(archive)
    assert told[:3] == ["b.bin", "a.txt", "manifest.json"]
    assert told[3:] == ["inner", "abc.part", "stages", "rename abc.part", "mosaic"]  # the stage's name is synced too


def test_concurrent_requests_build_a_store_once(tmp_path: Path, archive: Archive) -> None:
    """Eight threads ask for one key; one builds, seven find it."""
    build = Mock(side_effect=lambda path: (path / "a").write_text("x" * 1000))

    def work(_: int) -> bool:
        return Archive.open(tmp_path).produce("mosaic", build, version=1, params={"a": 1}, inputs=[])[1]

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(work, range(8)))
    assert build.call_count == 1
    assert sorted(answers) == [False] * 7 + [True]
    assert archive.find("mosaic", stage_key("mosaic", 1, {"a": 1}, [])) is not None


def test_publishing_a_key_again_keeps_the_first_store(archive: Archive) -> None:
    """The second store of one key is discarded."""
    path = _publish(archive, text="first")
    _publish(archive, text="second")
    assert (path / "inner" / "a.txt").read_text() == "first"
    check_store(archive.refs()[0].path, hashes=True)


def test_open_refuses_paths_that_are_no_archive(tmp_path: Path) -> None:
    """A file, a path below a file, a missing folder and a folder of other files have different messages."""
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for name, create, words in (
        ("file", True, "is a file, expected a folder"),
        ("file/archive", True, "Not a directory; choose another folder"),
        ("none", False, "is not there"),
        ("folder", False, "no archive"),
    ):
        with pytest.raises(ArchiveError, match=words):
            Archive.open(tmp_path / name, create=create)


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.EACCES, "permission is denied"), (errno.EROFS, "read-only"), (errno.ENOSPC, "the disk is full: free some")],
)
def test_unwritable_disk_is_refused(tmp_path: Path, number: int, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening writes a probe file, so that no survey begins on a disk that cannot store it."""

    def refuse(path: Path, content: bytes) -> int:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(ArchiveError, match=words):
        Archive.open(tmp_path)
    if number == errno.ENOSPC:  # gc opens it, and makes room
        Archive.open(tmp_path, create=False)


@pytest.mark.parametrize("where", ["fsync", "rename", "body"])
def test_full_disks_harm_nothing(tmp_path: Path, archive: Archive, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fails while writing, syncing or renaming: one error, no new store, the old one whole."""
    _publish(archive, key="old")
    refuse = Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))

    def build(path: Path) -> None:
        (path / "a").write_text("x")
        if where == "body":
            refuse()

    with monkeypatch.context() as patch:
        if where != "body":
            patch.setattr(*{"fsync": (os, "fsync"), "rename": (Path, "rename")}[where], refuse)
        with pytest.raises(ArchiveError, match=f"{tmp_path}.*the disk is full"):
            archive.produce("mosaic", build, version=1, params={})
    assert [ref.key for ref in archive.refs()] == ["old"]
    assert not list(tmp_path.glob("stages/*/*.part"))
    check_store(archive.refs()[0].path, hashes=True)


def test_errors_outside_of_the_archive_keep_their_type(tmp_path: Path) -> None:
    """A missing or unreadable scene file inside a stage does not become an ArchiveError."""
    archive = Archive.open(tmp_path / "archive")
    with pytest.raises(FileNotFoundError), archive.publish("mosaic", "abc"):
        (tmp_path / "scene.png").read_bytes()
    with pytest.raises(PermissionError), archive.publish("mosaic", "abc"):
        raise PermissionError(errno.EACCES, "denied", str(tmp_path / "scene.png"))


@pytest.mark.parametrize("name", ["", "../up", "a/b", "a.part", ".hidden", "a b"])
def test_invalid_key_names_are_refused(tmp_path: Path, name: str) -> None:
    """Stages and keys are single, plain folder names."""
    with pytest.raises(ArchiveError, match="cannot be a name"):
        Archive.open(tmp_path).find("mosaic", name)


def test_a_run_appears_with_all_its_files(archive: Archive) -> None:
    """No run is listed before publication; afterwards every file is there and verified."""
    with archive.new_run("field 7 / north") as run:
        run.write_file("receipt.json", json.dumps({"survey": "north"}))
        run.write_file("quicklook.png", b"\x89PNG")
        assert archive.runs() == []
    (folder,) = archive.runs()
    assert folder.name == run.id
    assert "field-7-north" in run.id
    assert json.loads((folder / "receipt.json").read_text()) == {"survey": "north"}
    assert [(finding.uri, finding.problem) for finding in verify_everything(archive)] == [(f"runs/{run.id}", None)]


def test_a_failed_run_leaves_nothing_and_a_live_one_is_kept(tmp_path: Path, archive: Archive) -> None:
    """`reclaim` keeps the folder that a living process writes."""

    def break_off() -> None:
        with archive.new_run("a") as run:
            run.write_file("receipt.json", "{}")
            assert archive.reclaim() == []
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        break_off()
    assert list((tmp_path / "runs").iterdir()) == []


def test_releasing_a_lock_twice_keeps_the_next_holders_lock(tmp_path: Path) -> None:
    """The second release closes no file of the next holder."""
    path = tmp_path / "a.lock"
    first = take_lock(path)
    assert first is not None
    assert take_lock(path, wait=False) is None
    first()
    second = take_lock(path, wait=False)
    assert second is not None
    first()
    assert take_lock(path, wait=False) is None
    second()


def test_a_run_begins_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files that a killed run of the same second and name left are not published with the next run."""
    monkeypatch.setattr(
        "spectralzoom.storage.archive.archive.datetime", Mock(now=lambda zone: datetime(2026, 5, 1, tzinfo=UTC))
    )
    left = tmp_path / "runs" / "20260501T000000-a.part"
    left.mkdir(parents=True)
    (left / "torn.bin").write_bytes(b"x")
    archive = Archive.open(tmp_path)
    for _ in range(2):
        with archive.new_run("a") as run:
            run.write_file("receipt.json", "{}")
    assert [folder.name for folder in archive.runs()] == ["20260501T000000-a", "20260501T000000-a-2"]
    assert not (archive.runs()[0] / "torn.bin").exists()


def test_runs_of_one_second_are_listed_in_publication_order(tmp_path: Path, archive: Archive) -> None:
    """Alphabetical order would put a later run before an earlier one."""
    names = []
    for name in ("zebra", "apple", "mango"):
        with archive.new_run(name) as draft:
            names.append(draft.id)
    for number, name in enumerate(names):
        same = f"20260101T000000-{name.rpartition('-')[2]}"
        (tmp_path / "runs" / name).rename(tmp_path / "runs" / same)
        os.utime(tmp_path / "runs" / same / "manifest.json", ns=(number, number))
    assert [path.name.rpartition("-")[2] for path in archive.runs()] == ["zebra", "apple", "mango"]


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Return the path of a JSON table in a store."""

    def build(path: Path) -> None:
        (path / "plan.json").write_text('{"patch_index": [1, 2], "fraction": 0.25}')

    return Archive.open(tmp_path).produce("score", build, version=1, params={})[0].path / "plan.json"


@pytest.mark.parametrize(
    "content", ['{"patch_index": [1, 3], "fraction": 0.25}', '{"patch_index": [1, 2], "fraction": 0.25', ""]
)
def test_read_table_refuses_a_changed_table(table: Path, content: str) -> None:
    """An unchanged table is read; one changed digit is refused as invalid JSON is."""
    assert read_table(table) == {"patch_index": [1, 2], "fraction": 0.25}
    table.write_text(content)
    with pytest.raises(IncompleteStoreError, match=r"plan\.json has .*gc --damaged"):
        read_table(table)


def test_read_table_refuses_missing_and_unlisted_files(table: Path) -> None:
    """A deleted file is refused, and so is a file that the manifest does not list."""
    (table.parent / "other.json").write_text("{}")
    with pytest.raises(IncompleteStoreError, match=r"other\.json is in no manifest"):
        read_table(table.parent / "other.json")
    table.unlink()
    with pytest.raises(IncompleteStoreError, match=r"plan\.json cannot be read: it is missing"):
        read_table(table)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(max_size=4), PLAIN, max_size=5))
@settings(max_examples=25, deadline=None)
def test_stage_key_ignores_the_order_of_parameters(params: dict[str, object]) -> None:
    """The same parameters in reverse order have the same key."""
    assert stage_key("mosaic", 1, params, ["a"]) == stage_key("mosaic", 1, dict(reversed(params.items())), ["a"])


@given(st.floats(1e-6, 1e6))
@settings(max_examples=25, deadline=None)
def test_stage_key_ignores_rounding_noise(value: float) -> None:
    """Floats equal to 12 digits are one parameter; a change in the ninth digit is another."""
    key = stage_key("plan", 1, {"a": value}, [])
    assert key == stage_key("plan", 1, {"a": float(f"{value:.12g}")}, [])
    assert key != stage_key("plan", 1, {"a": value * (1 + 1e-8)}, [])


def test_every_part_counts() -> None:
    """Stage, version, parameters, inputs and their order each change the key."""
    keys = {
        stage_key("a", 1, {"p": 1}, ["x", "y"]),
        stage_key("b", 1, {"p": 1}, ["x", "y"]),
        stage_key("a", 2, {"p": 1}, ["x", "y"]),
        stage_key("a", 1, {"p": 2}, ["x", "y"]),
        stage_key("a", 1, {"p": 1}, ["y", "x"]),
        stage_key("a", 1, {"p": "1"}, ["x", "y"]),
    }
    assert len(keys) == 6
    assert all(len(key) == 20 and set(key) <= set("0123456789abcdef") for key in keys)


def test_canonical_json_agrees_for_equivalent_types() -> None:
    """2 and 2.0, lists and tuples, numpy and Python numbers, paths and dataclasses have the same text."""
    sweep = Sweep("a", "fine", "x", 0.0, -3.5, 10)
    assert text_of({"a": (1, 2.0, -0.0)}) == text_of({"a": [np.int64(1), np.float64(2), 0]})
    assert text_of(sweep) == text_of(dataclasses.asdict(sweep))
    assert text_of([Path("a/b"), {3, 1}]) == '["a/b",[1,3]]'
    assert text_of(float("nan")) == '"nan"'
    assert text_of(np.ones(3)) != text_of(np.ones(3, np.float32))


def test_stage_key_refuses_values_without_a_stable_text() -> None:
    """A function or a bare object cannot be part of a key."""
    for value in (test_every_part_counts, object(), np.array([None])):
        with pytest.raises(ArchiveError, match="cannot be part of a key"):
            stage_key("a", 1, {"p": value}, [])
