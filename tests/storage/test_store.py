"""Stores appear whole or not at all, never change, and every opening finds damage; a killed process harms nothing."""

from __future__ import annotations

import dataclasses
import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import IO, Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import ArchiveError, IncompleteStoreError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.storage import store
from spectralzoom.storage.arrays.layout import create_group, open_group, write_image, write_small
from spectralzoom.storage.store import (
    Archive,
    Ref,
    ancestors,
    is_cleared,
    listed_bytes,
    plain,
    read_manifest,
    read_table,
    stage_key,
    text_of,
    uri_of,
)
from spectralzoom.storage.whole_files import PART, locked
from tests.source_paths import PYTHON_PATH
from tests.storage.small_archive import flip, make_store, problems, rewrite, small_survey

ROOT = Path(__file__).parents[2]


def produce(archive: Archive, build: Callable[[Path], object], **params: Any) -> Ref:
    """Make (or find) a mosaic."""
    return archive.produce("mosaic", build, version=1, params=params)[0]


def two_files(folder: Path) -> None:
    """Write a table and a file in a folder of its own."""
    (folder / "inner").mkdir()
    (folder / "inner" / "a.txt").write_text("content")
    (folder / "plan.json").write_text('{"patches": [1, 2], "fraction": 0.25}')


# --- keys -------------------------------------------------------------------------------------------------------------

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(max_size=4), PLAIN, max_size=5))
@settings(max_examples=50, deadline=None)
def test_plain_values_stay_as_they_are(params: dict[str, object]) -> None:
    """So a manifest keeps its seal when it is read, whatever the order of its names."""
    once = plain(params)
    assert plain(once) == once
    assert text_of(json.loads(json.dumps(once))) == text_of(dict(reversed(params.items())))
    manifest = store.parse_manifest(store.manifest_text({"facts": params}).encode())
    assert manifest["facts"] == once


@given(st.floats(1e-6, 1e6))
@settings(max_examples=25, deadline=None)
def test_a_key_ignores_rounding_noise(value: float) -> None:
    """Floats equal to 12 digits are one parameter; a change in the ninth digit is another."""
    key = stage_key("plan", 1, {"a": value})
    assert key == stage_key("plan", 1, {"a": float(f"{value:.12g}")})
    assert key != stage_key("plan", 1, {"a": value * (1 + 1e-8)})


def test_every_part_counts_in_a_key(archive: Archive) -> None:
    """Stage, version, parameters, inputs and their order each change it."""
    x, y = (archive.ref("capture", key) for key in "xy")
    keys = {
        stage_key("a", 1, {"p": 1}, [x, y]),
        stage_key("b", 1, {"p": 1}, [x, y]),
        stage_key("a", 2, {"p": 1}, [x, y]),
        stage_key("a", 1, {"p": 2}, [x, y]),
        stage_key("a", 1, {"p": 1}, [y, x]),
        stage_key("a", 1, {"p": "1"}, [x, y]),
    }
    assert len(keys) == 6
    assert all(len(key) == 20 and set(key) <= set("0123456789abcdef") for key in keys)


def test_equivalent_types_have_one_text() -> None:
    """2 and 2.0, lists and tuples, numpy and Python numbers, dataclasses and tables; an object may have a key."""
    sweep = Sweep("a", "fine", "x", 0.0, -3.5, 10)
    assert text_of({"a": (1, 2.0, -0.0)}) == text_of({"a": [np.int64(1), np.float64(2), 0]})
    assert text_of(sweep) == text_of(dataclasses.asdict(sweep))
    assert text_of([Mock(key={"b": 1.0}), float("nan"), -np.inf]) == '[{"b":1},"nan","-inf"]'
    assert text_of(np.ones(3)) != text_of(np.ones(3, np.float32)) != text_of(np.ones((1, 3), np.float32))


def test_values_without_a_lasting_text_are_refused() -> None:
    """A function, a bare object, bytes or an array of objects cannot be part of a key."""
    for value in (test_equivalent_types_have_one_text, object(), b"a", {1}, np.array([None])):
        with pytest.raises(ArchiveError, match="cannot be part of a key"):
            stage_key("a", 1, {"p": value})


@pytest.mark.parametrize(
    "address", ["", "x", "stages/a", "stages/../b", "stages/a/b/../..", "runs/.", "/runs/a", "runs/a\0"]
)
def test_only_addresses_within_an_archive_are_located(archive: Archive, address: str) -> None:
    """Names with two dots, absolute paths and other text are refused before any file is touched."""
    assert uri_of(address) is None
    assert uri_of("stages/a/b/c.zarr") == "stages/a/b"
    with pytest.raises(ArchiveError, match="no address in an archive"):
        archive.locate(address)


@pytest.mark.parametrize("name", ["", "../up", "a/b", "a.part", ".hidden", "a b"])
def test_invalid_names_are_refused(archive: Archive, name: str) -> None:
    """Stages and keys are single, plain folder names."""
    with pytest.raises(ArchiveError, match="cannot be a name"):
        archive.find("mosaic", name)


# --- publication ------------------------------------------------------------------------------------------------------


def test_a_store_is_found_with_its_manifest(archive: Archive) -> None:
    """Its manifest has parameters, the addresses of inputs, and sizes and hashes of files."""
    raw = make_store(archive, "capture", {"light": {"source": "sim"}}, [])
    assert archive.find("mosaic", stage_key("mosaic", 1, {"tol": 0.1}, [raw])) is None
    ref, built = archive.produce("mosaic", two_files, version=1, params={"tol": 0.1}, inputs=[raw])
    assert (built, archive.find("mosaic", ref.key), archive.refs("mosaic")) == (True, ref, [ref])
    manifest = read_manifest(ref.path)
    assert (manifest["version"], manifest["params"], manifest["inputs"]) == (1, {"tol": 0.1}, [raw.uri])
    assert {name: size for name, (size, _) in manifest["files"].items()} == {"inner/a.txt": 7, "plan.json": 37}
    assert listed_bytes(manifest) == 44
    assert ancestors(archive.manifests(), [ref.uri]) == [raw.uri]
    assert archive.produce("mosaic", Mock(), version=1, params={"tol": 0.1}, inputs=[raw]) == (ref, False)


def test_a_failed_stage_leaves_nothing(archive: Archive) -> None:
    """The exception propagates, the staged folder is removed, and the key stays free."""

    def fail(path: Path) -> None:
        (path / "a").write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        produce(archive, fail)
    assert list((archive.root / "stages" / "mosaic").iterdir()) == []


def test_leftovers_of_dead_processes_are_reclaimed(archive: Archive) -> None:
    """Folders, a file, a link and a pipe with such names are ignored and removed; what a link leads to stays."""
    ref = produce(archive, two_files)
    for name in (f"{ref.key}.0123abcd.part", "dead.part"):
        (ref.path.with_name(name) / "inner").mkdir(parents=True)
    ref.path.with_name("file.part").write_text("x")
    ref.path.with_name("link.part").symlink_to(ref.path)
    os.mkfifo(ref.path.with_name("pipe.part"))
    (archive.root / "spool" / ref.key).mkdir(parents=True)
    (archive.root / "spool" / "underway").mkdir()
    assert archive.refs() == [ref]
    assert len(archive.reclaim()) == 6
    assert [path.name for path in archive.root.glob("*/*/*")] == [ref.key]
    assert [path.name for path in archive.root.glob("spool/*")] == ["underway"]
    assert problems(archive) == []


def test_concurrent_requests_build_a_store_once(archive: Archive) -> None:
    """Eight threads ask for one key; one builds, seven find it."""
    build = Mock(side_effect=two_files)

    def work(_: int) -> bool:
        return Archive.open(archive.root).produce("mosaic", build, version=1, params={})[1]

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(work, range(8)))
    assert (build.call_count, sorted(answers)) == (1, [False] * 7 + [True])


def test_a_store_is_synced_before_and_after_its_rename(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files, manifest and folders are synced first, then the store is renamed, then its parent folder is synced."""
    told: list[str] = []
    rename = Path.rename

    def renamed(self: Path, to: Path) -> Path:
        told.append("rename")
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", renamed)
    monkeypatch.setattr(store, "sync", lambda path: told.append(path.name.split(".")[0]))
    key = produce(archive, two_files).key
    at = told.index("rename")
    assert sorted(told[: at - 1]) == sorted(["a", "plan", "manifest", key, "inner"])
    assert told[at - 1 : at + 2] == ["stages", "rename", "mosaic"]


@pytest.mark.parametrize("where", ["fsync", "rename", "build"])
def test_full_disks_harm_nothing(archive: Archive, where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fails while writing, syncing or renaming: one error, no new store, the old one whole."""
    old = produce(archive, two_files)
    refuse = Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with monkeypatch.context() as patch:
        if where != "build":
            patch.setattr(*{"fsync": (os, "fsync"), "rename": (Path, "rename")}[where], refuse)
        with pytest.raises(ArchiveError, match=rf"{archive.root}.*the disk is full"):
            produce(archive, refuse if where == "build" else two_files, other=1)
    assert archive.refs() == [old]
    archive.reclaim()
    assert not list(archive.root.rglob(f"*{PART}"))
    assert problems(archive) == []


def test_errors_outside_of_the_archive_keep_their_type(tmp_path: Path) -> None:
    """A missing or unreadable scene file inside a stage does not become an ArchiveError."""
    archive = Archive.open(tmp_path / "archive")
    with pytest.raises(FileNotFoundError):
        produce(archive, lambda folder: (tmp_path / "scene.png").read_bytes())
    with pytest.raises(PermissionError):
        produce(archive, Mock(side_effect=PermissionError(errno.EACCES, "denied", str(tmp_path / "scene.png"))))


@pytest.mark.parametrize("change", ["cleared", "made anew"])
def test_an_input_that_changes_meanwhile_ends_a_stage(archive: Archive, change: str) -> None:
    """A cleared array reads as nodata: what was made of it is not published."""
    small = small_survey(archive, named=False)

    def build(folder: Path) -> None:
        archive.clear(small.raw)
        if change == "made anew":
            small_survey(archive, named=False)

    with pytest.raises(ArchiveError, match="another survey has cleared an input of ground meanwhile"):
        archive.produce("ground", build, version=1, params={}, inputs=[small.raw])
    assert archive.refs("ground") == []


def test_an_input_that_the_stage_restores_is_no_change(archive: Archive) -> None:
    """It was cleared before the stage began."""
    small = small_survey(archive, named=False)
    archive.clear(small.raw)
    built = archive.produce(
        "ground", lambda folder: small_survey(archive, named=False), version=1, params={}, inputs=[small.raw]
    )
    assert archive.find("ground", built[0].key) is not None


@pytest.mark.parametrize("what", ["stages", "runs", ".locks", "spool", "stages/mosaic", "stages/mosaic/KEY"])
def test_a_file_in_place_of_a_folder_is_one_error(tmp_path: Path, what: str) -> None:
    """Wherever it stands, it is named, and stays as it is."""
    place = tmp_path / what.replace("KEY", stage_key("mosaic", 1, {}))
    (tmp_path / "stages").mkdir()
    shutil.rmtree(place, ignore_errors=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("mine")
    with pytest.raises(ArchiveError, match=str(place)):
        produce(Archive.open(tmp_path), two_files)
    assert place.read_text() == "mine"


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.EACCES, "permission is denied"), (errno.EROFS, "read-only"), (errno.ENOSPC, "the disk is full: free some")],
)
def test_an_unwritable_disk_is_refused(
    tmp_path: Path, number: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening writes a probe file, so that no survey begins on a disk that cannot store it; gc makes room."""
    monkeypatch.setattr("tempfile.TemporaryFile", Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(ArchiveError, match=words):
        Archive.open(tmp_path)
    if number == errno.ENOSPC:
        Archive.open(tmp_path, create=False)


def test_paths_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    """A file, a path below one, a missing folder, a folder of other files, and a bucket have messages of their own."""
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for name, create, words in (
        (tmp_path / "file", True, "is a file, expected a folder"),
        (tmp_path / "file" / "archive", True, "Not a directory"),
        (tmp_path / "none", False, "is not there"),
        (tmp_path / "folder", False, "no archive"),
        ("s3://bucket/prefix", True, r"s3://bucket/prefix is not a folder.*pull"),
    ):
        with pytest.raises(ArchiveError, match=words):
            Archive.open(name, create=create)


# --- locks ------------------------------------------------------------------------------------------------------------


def test_a_lock_removed_before_it_is_held_is_taken_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process cleans up between the opening and the locking of the file."""
    path, flock, removals = tmp_path / "a.lock", fcntl.flock, iter([True])

    def late(file: IO[str], kind: int) -> None:
        if next(removals, False):
            path.unlink()
        flock(file, kind)

    monkeypatch.setattr(fcntl, "flock", late)
    with locked(path) as first, locked(path, wait=False) as second:
        assert (first, second) == (True, False)


def test_a_lock_is_held_by_one_or_shared(tmp_path: Path) -> None:
    """Also when gc has removed its file; a link in its place is refused."""
    path = tmp_path / "a.lock"
    with locked(path) as first, locked(path, wait=False) as second:
        assert (first, second) == (True, False)
        path.unlink()
        with locked(path, wait=False) as third, locked(path, wait=False) as fourth:
            assert (third, fourth) == (True, False)
    with locked(path, shared=True) as first, locked(path, shared=True) as second, locked(path, wait=False) as third:
        assert (first, second, third) == (True, True, False)
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ArchiveError, match=r"a\.lock is a link"), locked(path):
        pass


def test_an_unknown_refusal_of_locks_is_one_error(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever number the file system answers with."""
    monkeypatch.setattr("fcntl.flock", Mock(side_effect=OSError(errno.EINVAL, "Invalid argument")))
    with pytest.raises(ArchiveError, match=r"cannot lock .*Invalid argument"):
        produce(archive, two_files)


def test_two_machines_without_locks_end_well_or_say_so(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both build one key, one after the other clears it, another run removes unfinished folders: nothing is damaged."""
    monkeypatch.setattr("fcntl.flock", lambda descriptor, kind: None)
    told: set[str] = set()

    def work(number: int) -> None:
        mine = Archive.open(archive.root)
        for _ in range(12):
            try:
                small = small_survey(mine, named=number == 0)
                if number == 1:
                    mine.clear(small.mosaic)
                if number == 2:
                    mine.reclaim()
            except ArchiveError as error:
                told.add(str(error))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert problems(archive) == []
    assert all("another" in text or "see what stands there" in text for text in told), told
    archive.reclaim()
    small_survey(archive)
    assert problems(archive) == []


# --- damage -----------------------------------------------------------------------------------------------------------


def with_cube(folder: Path) -> None:
    """Write an array of two shards, and its wavelengths."""
    group = create_group(folder / "mosaic.zarr", "a cube", {"scale_factor": 0.5})
    write_image(group, "values", ("y", "x", "band"), np.ones((130, 70, 3), np.uint16), {})
    write_small(group, "wavelength", ("band",), np.arange(3.0), {})


def test_every_opening_finds_a_flipped_bit_of_metadata(archive: Archive) -> None:
    """The error names store, file, what was made of it, and the command; chunks have checksums of their own."""
    ref = produce(archive, with_cube)
    made = make_store(archive, "segment", {}, [ref])
    for name in read_manifest(ref.path)["files"]:
        path = ref.path / name
        before = path.read_bytes()
        flip(path, at=len(before) // 2)
        if "/c/" in name:
            assert archive.find("mosaic", ref.key) == ref
        else:
            for opening in (lambda: archive.find("mosaic", ref.key), lambda: archive.locate(f"{ref.uri}/mosaic.zarr")):
                with pytest.raises(IncompleteStoreError) as error:
                    opening()
                for text in (ref.uri, name, made.uri, f"gc --damaged {archive.root}"):
                    assert text in str(error.value)
        assert any(name in problem for problem in problems(archive))
        path.write_bytes(before)
    assert problems(archive) == []


def test_every_array_has_a_checksum_in_its_codecs(archive: Archive) -> None:
    """Chunks are not hashed when a store is opened: shards check their index and each chunk."""
    ref = produce(archive, with_cube)
    for name, array in open_group(ref.path / "mosaic.zarr").arrays():
        described = json.loads((ref.path / "mosaic.zarr" / name / "zarr.json").read_text())["codecs"]
        shard = described[0]["configuration"] if described[0]["name"] == "sharding_indexed" else None
        for codecs in [described] if shard is None else [shard["codecs"], shard["index_codecs"]]:
            assert codecs[-1]["name"] == "crc32c", (array, codecs)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace('"version": 1', '"version": 2'), "its seal does not fit"),
        (lambda text: text[:40], r"manifest\.json is damaged"),
        (lambda text: "[" * 100_000, "nested too deeply"),
        (lambda text: "[]", "it is no table"),
        (None, r"manifest\.json is missing"),
    ],
)
def test_a_changed_manifest_is_damage(archive: Archive, change: Callable[[str], str] | None, words: str) -> None:
    """No content of a manifest causes another error."""
    ref = produce(archive, two_files)
    path = ref.path / "manifest.json"
    text = path.read_text()
    path.unlink()
    if change is not None:
        path.write_text(change(text))
    with pytest.raises(IncompleteStoreError, match=words):
        archive.find("mosaic", ref.key)


@pytest.mark.parametrize(
    "facts",
    [
        {"inputs": 7},
        {"inputs": ["stages/../../x"]},
        {"inputs": [3]},
        {"params": 3},
        {"created": None},
        {"rests_on": {"nowhere": ""}},
        {"files": {"../../x": [1, ""]}},
        {"files": {"/etc/passwd": [1, ""]}},
        {"files": {"a": 1}},
    ],
)
def test_a_sealed_manifest_of_odd_types_is_damage(archive: Archive, facts: dict[str, Any]) -> None:
    """It names nothing outside of the archive, and no reader meets another type than it expects."""
    ref = produce(archive, two_files)
    rewrite(ref.path / "manifest.json", **facts)
    assert [one.split(":")[0] for one in problems(archive)] == [f"{ref.uri} manifest.json is damaged"]


@pytest.mark.parametrize("what", ["the store", "a folder in it", "a file in it", "the stage"])
def test_links_out_of_an_archive_are_refused(tmp_path: Path, what: str) -> None:
    """Nothing is read through them, and gc never removes what they lead to."""
    archive = Archive.open(tmp_path / "archive")
    ref = produce(archive, two_files)
    place = {"the store": ref.path, "a folder in it": ref.path / "inner", "the stage": ref.path.parent}
    moved = place.get(what, ref.path / "plan.json")
    moved.rename(tmp_path / "elsewhere")
    moved.symlink_to(tmp_path / "elsewhere")
    with pytest.raises((ArchiveError, IncompleteStoreError), match=r"link|is missing"):
        archive.find("mosaic", ref.key)
    assert problems(archive)
    with suppress(ArchiveError):
        archive.discard(ref.uri)
    assert (tmp_path / "elsewhere").exists()


def test_a_pipe_is_named_and_never_waited_for(archive: Archive) -> None:
    """As a manifest, and as another file."""
    for name in ("plan.json", "manifest.json"):
        ref = produce(archive, two_files, name=name)
        (ref.path / name).unlink()
        os.mkfifo(ref.path / name)
        with pytest.raises(IncompleteStoreError, match=rf"{name} is .*no file of its own"):
            archive.find("mosaic", ref.key)


def test_a_table_is_read_by_its_hash(archive: Archive) -> None:
    """One changed digit, invalid JSON, a missing and an unlisted file are refused."""
    path = produce(archive, two_files).path / "plan.json"
    before = path.read_text()
    assert read_table(path) == {"patches": [1, 2], "fraction": 0.25}
    for text in (before.replace("2]", "3]"), before[:-1], ""):
        path.write_text(text)
        with pytest.raises(IncompleteStoreError, match=r"plan\.json has .*gc --damaged"):
            read_table(path)
    path.unlink()
    with pytest.raises(IncompleteStoreError, match=r"plan\.json is missing"):
        read_table(path)
    (path.parent / "other.json").write_text("{}")
    with pytest.raises(IncompleteStoreError, match=r"other\.json is in no manifest"):
        read_table(path.parent / "other.json")


# --- cleared stores ---------------------------------------------------------------------------------------------------


def test_a_cleared_store_keeps_its_manifest_and_is_made_again(archive: Archive) -> None:
    """Its files go; verify finds no problem; a later request has the same bytes at the same address."""
    small = small_survey(archive)
    before, content = read_manifest(small.mosaic.path), (small.mosaic.path / "data.bin").read_bytes()
    for _ in range(2):
        assert archive.clear(small.mosaic, wait=False)
        assert [path.name for path in small.mosaic.path.parent.iterdir()] == [f"{small.mosaic.key}.cleared"]
        assert read_manifest(small.mosaic.path) == before
    assert archive.find("rectify", small.mosaic.key) is None
    assert is_cleared(small.mosaic.path)
    assert problems(archive) == []
    with pytest.raises(IncompleteStoreError, match=r"cleared away\. Run its survey again, for raw lines with --keep"):
        archive.locate(f"{small.mosaic.uri}/mosaic.zarr")
    assert small_survey(archive, named=False).mosaic == small.mosaic
    assert (small.mosaic.path / "data.bin").read_bytes() == content
    assert archive.is_there(small.mosaic.uri)
    assert problems(archive) == []


def test_a_store_made_anew_during_each_look_is_not_damaged(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process clears it and makes it again, twice, while its files are compared."""
    ref = produce(archive, two_files, scene="a")
    problem, renewals = store.file_problem, iter([True, True])
    first = Path(next(iter(read_manifest(ref.path)["files"]))).name

    def renewed(*given: Any) -> str | None:
        if given[0].name != first or not next(renewals, False):
            return problem(*given)
        with monkeypatch.context() as patch:
            patch.setattr(store, "file_problem", problem)
            archive.clear(ref)
            produce(archive, two_files, scene="a")
        return "is missing"

    monkeypatch.setattr(store, "file_problem", renewed)
    assert archive.find(ref.stage, ref.key) == ref
    assert next(renewals, None) is None


def test_a_store_cleared_during_a_check_is_not_damaged(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another survey may clear it while a reader or verify checks its files."""
    small = small_survey(archive)
    problem = store.file_problem

    def clear_first(*given: Any) -> str | None:
        archive.clear(small.mosaic)
        return problem(*given)

    monkeypatch.setattr(store, "file_problem", clear_first)
    assert archive.find("rectify", small.mosaic.key) is None
    small_survey(archive, named=False)
    assert problems(archive) == []


KILL_EVERYWHERE = """
import os, shutil, sys
from pathlib import Path
from spectralzoom.storage.store import Archive
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


def test_an_archive_verifies_after_a_kill_at_any_system_call(archive: Archive, tmp_path: Path) -> None:
    """A store is cleared and made again, and a run is published: it is whole or absent, and the next survey ends."""
    small_survey(Archive.open(tmp_path / "archive"), named=False)
    command = [sys.executable, "-c", KILL_EVERYWHERE, str(tmp_path / "archive"), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    calls = int(subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True).stdout)
    assert calls > 30
    seen = set()
    for at in range(1, calls + 1):
        opened = Archive.open(tmp_path / f"{at}")
        assert problems(opened) == []
        seen.add(len(opened.runs()))
        opened.reclaim()
        again = small_survey(opened)
        assert problems(opened) == []
        assert opened.is_there(again.mosaic.uri)
        assert not [*opened.root.rglob(f"*{PART}")]
    assert seen == {0, 1}
