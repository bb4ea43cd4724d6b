"""Links, pipes and copies in an archive: verify tells each by its address, and no reader follows or waits for one."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path

import pytest

from pipeline.errors import ArchiveError, IncompleteStoreError, SceneError
from storage.archive.archive import Archive
from storage.archive.records import read_run
from storage.archive.staging import MOST_BYTES, NotPlainError, kind_of, open_plain, plain_size, read_plain, read_toml
from storage.maintenance.garbage import clear_up
from storage.readers.scene_toml import load_scene_settings
from storage.remote.opening import verify_archive
from tests.storage.small_archive import Small, small_survey

ELSEWHERE = "elsewhere"  # beside the archive


def away(path: Path) -> Path:
    """Move something out of the archive."""
    root = next(parent for parent in path.parents if parent.name == "archive")
    return path.rename(root.with_name(ELSEWHERE))


Case = tuple[str, str]  # what lies in the place, and the place
STORE = ("store", "store manifest", "store file")
CASES = [
    *(("link", place) for place in (*STORE, "run")),
    *(("pipe", place) for place in (*STORE, "store beside", "run receipt")),
    *(("link nowhere", place) for place in ("store", "run manifest")),
]


def put(small: Small, case: Case) -> str:
    """Put a link, or a pipe without a writer, in a place of an archive or beside it; gives the address."""
    what, place = case
    kind, _, part = place.partition(" ")
    folder = {"store": small.mosaic.path, "run": small.run}[kind]
    names = {
        "": ".",
        "manifest": "manifest.json",
        "file": "data.bin",
        "receipt": "receipt.json",
        "beside": "inner/more",
    }
    path = folder / names[part]
    if path.exists():
        target = away(path)
    else:
        path.parent.mkdir(parents=True)
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("nowhere" if what == "link nowhere" else target)
    return {"store": small.mosaic.uri, "run": f"runs/{small.run.name}"}[kind]


@pytest.mark.parametrize("case", CASES)
def test_verify_tells_it_by_name(case: Case, tmp_path: Path) -> None:
    """With what it is, and nothing of what is whole is doubted for it."""
    archive = Archive.open(tmp_path / "archive")
    small = small_survey(archive)
    uri = put(small, case)
    told = [(one.uri, str(one.problem)) for one in verify_archive(archive) if one.problem is not None]
    kind = case[0].split()[0]
    assert any(f"is a {kind}" in problem for _, problem in told), told
    assert {place for place, _ in told} == {uri}


@pytest.mark.parametrize("case", CASES)
def test_readers_end(case: Case, tmp_path: Path) -> None:
    """A survey that looks for the store, gc, what reads runs: an answer or one error, and nothing outside changes."""
    archive = Archive.open(tmp_path / "archive")
    small = small_survey(archive)
    uri = put(small, case)
    outside = tmp_path / ELSEWHERE
    before = sorted(path.name for path in outside.rglob("*")) if outside.is_dir() else outside.exists()
    if uri == small.mosaic.uri and case[1] != "store beside":
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


@pytest.mark.parametrize("name", ["stages", "stages/rectify", "runs", "spool", ".locks"])
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


# --- one file ---------------------------------------------------------------------------------------------------------


def make(kind: str, path: Path) -> None:
    """Put something of a kind at a path."""
    if kind == "a link":
        path.with_name("target").write_bytes(b"elsewhere")
        path.symlink_to("target")
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a socket":
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(path))
        bound.close()
    else:
        path.write_bytes(b"content")


@pytest.mark.parametrize("kind", ["a link", "a folder", "a pipe", "a socket"])
@pytest.mark.parametrize("use", [read_plain, plain_size, lambda path: open_plain(path, os.O_RDWR | os.O_CREAT)])
def test_what_is_no_file_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, use: object) -> None:
    """Its kind in words, whatever it is opened for; nothing is read, made or waited for."""
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    make(kind, Path("x"))
    assert kind_of(Path("x")) == kind
    with pytest.raises((NotPlainError, IsADirectoryError)) as told:
        use(Path("x"))  # type: ignore[operator]
    assert "expected a file" in str(told.value.strerror) or kind == "a folder"


def test_a_device_is_not_even_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some act on that, and it may give bytes without end."""
    with pytest.raises(ValueError, match="no plain file"):
        read_toml(Path("/dev/zero"))
    monkeypatch.setattr(os, "open", lambda *given: pytest.fail("it was opened"))
    with pytest.raises(NotPlainError, match="it is a device, expected a file"):
        read_plain(Path("/dev/zero"))


def test_a_file_is_read(tmp_path: Path) -> None:
    """Also through folders that are links: what is not followed is the last name."""
    (tmp_path / "real").mkdir()
    make("a file", tmp_path / "real" / "x")
    (tmp_path / "linked").symlink_to("real")
    assert read_plain(tmp_path / "linked" / "x") == b"content"
    assert plain_size(tmp_path / "linked" / "x") == 7
    assert kind_of(tmp_path / "linked") == "a link"
    assert kind_of(tmp_path / "nothing") is None
    (tmp_path / "survey.toml").write_bytes(b"\xef\xbb\xbfseed = 1\r\n")  # some editors write a byte order mark
    assert read_toml(tmp_path / "survey.toml") == {"seed": 1}


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"seed = " + b"9" * 5000, "a number of more than 4300 digits"),
        (b"seed = " + b"[" * 10_000 + b"]" * 10_000, "nested too deeply"),
        (b"seed = ", "Invalid value"),
        (b"name = '\xff'", "can't decode byte 0xff"),
        (b"#" * (MOST_BYTES + 1), "settings have a few thousand"),
        (None, "no plain file"),
    ],
)
def test_what_cannot_be_read_is_said_in_a_sentence(tmp_path: Path, content: bytes | None, why: str) -> None:
    """Endless digits, nesting without end, a pipe that nobody writes to: none hangs, none is another error."""
    path = tmp_path / "scene.toml"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=why):
        read_toml(path)
    with pytest.raises(SceneError, match="cannot be read as TOML"):
        load_scene_settings(path)
