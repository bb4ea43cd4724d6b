"""Camera files in a folder: bytes stay as they came, whatever a file is called and whatever the disk does."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from pipeline.rig.refusals import NotKept
from storage.fetched_files import FetchedFiles


def test_what_was_appended_is_read_back(tmp_path: Path):
    """Sizes and parts of several files; another look at the folder has the same."""
    kept = FetchedFiles(tmp_path / "camera")
    assert kept.size("/captured/a_000000/raw_0") == 0
    assert kept.read("/captured/a_000000/raw_0", 0, 10) == b""
    for data in (b"abc", b"", b"defg"):
        kept.append("/captured/a_000000/raw_0", data)
    kept.append("notes", b"1\n")
    for look in (kept, FetchedFiles(tmp_path / "camera")):
        assert look.size("/captured/a_000000/raw_0") == 7
        assert look.read("/captured/a_000000/raw_0", 2, 5) == b"cde"
        assert look.read("/captured/a_000000/raw_0", 5, 99) == b"fg"
        assert look.read("notes", 0, 2) == b"1\n"


def test_empty_file_is_there(tmp_path: Path):
    """A file without a byte is not one that was never fetched."""
    kept = FetchedFiles(tmp_path)
    kept.append("/a/empty", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["a%2Fempty"]


@pytest.mark.parametrize("name", ["/captured/../../etc/passwd", "..", "/a b/ü", "a%2Fb", "\\..\\x"])
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str):
    """Whatever the camera calls its files, they lie in the folder, each in its own."""
    kept = FetchedFiles(tmp_path / "camera")
    kept.append(name, b"x")
    kept.append("/a/b", b"yy")
    assert kept.size(name) == 1
    assert len(list((tmp_path / "camera").iterdir())) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["camera"]


def test_name_that_is_none_is_refused(tmp_path: Path):
    """Nothing, or more than a file system takes."""
    for name in ("/", "x" * 300):
        with pytest.raises(NotKept, match="use a shorter prefix"):
            FetchedFiles(tmp_path).append(name, b"x")


def test_full_disk_keeps_what_there_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A write that the disk takes a part of is taken back, and told with what to do."""
    kept = FetchedFiles(tmp_path)
    kept.append("/a/raw_0", b"whole")
    write = os.write

    def full(file: int, data: bytes) -> int:
        if len(data) > 2:
            return write(file, bytes(data)[:2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("storage.fetched_files.os.write", full)
    with pytest.raises(NotKept, match=r"cannot keep byte 5 of /a/raw_0 .*No space left.*the 5 bytes before"):
        kept.append("/a/raw_0", b"torn")
    assert kept.read("/a/raw_0", 0, 99) == b"whole"
