"""Camera files in a folder: bytes stay as they came, whatever a file is called and whatever the disk does."""

from __future__ import annotations

import errno
import itertools
import os
import random
import shutil
from pathlib import Path

import pytest

from pipeline.rig.transports import NotKept
from storage.arrays.spool import SUMS, FetchedFiles
from tests.storage.small_archive import flip


def test_what_was_appended_is_read_back(tmp_path: Path):
    """Sizes and parts of several files; another look at the folder has the same."""
    kept = FetchedFiles(tmp_path / "camera")
    assert kept.size("/captured/a_000000/raw_0") == 0
    assert kept.read("/captured/a_000000/raw_0", 0, 10) == b""
    for data in (b"abc", b"", b"defg"):
        kept.append("/captured/a_000000/raw_0", data)
    kept.append("notes", b"1\n")
    for scan_pass in (kept, FetchedFiles(tmp_path / "camera")):
        assert scan_pass.size("/captured/a_000000/raw_0") == 7
        assert scan_pass.read("/captured/a_000000/raw_0", 2, 5) == b"cde"
        assert scan_pass.read("/captured/a_000000/raw_0", 5, 99) == b"fg"
        assert scan_pass.read("notes", 0, 2) == b"1\n"


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
    assert len([path for path in (tmp_path / "camera").iterdir() if not path.name.endswith(SUMS)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["camera"]


def test_name_that_is_none_is_refused(tmp_path: Path):
    """Nothing, or more than a file system takes."""
    for name in ("/", "x" * 300):
        with pytest.raises(NotKept, match="use a shorter prefix"):
            FetchedFiles(tmp_path).append(name, b"x")


@pytest.mark.parametrize("name", ["/a/raw_0", "notes"])
def test_full_disk_keeps_what_there_was(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch):
    """A write that the disk takes a part of is taken back, and told with what to do."""
    kept = FetchedFiles(tmp_path)
    kept.append(name, b"whole")
    write = os.write

    def full(file: int, data: bytes) -> int:
        if len(data) > 2:
            return write(file, bytes(data)[:2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("storage.arrays.spool.os.write", full)
    with pytest.raises(NotKept, match=rf"cannot keep byte 5 of {name} .*the disk is full.*the 5 bytes before"):
        kept.append(name, b"torn")
    assert kept.read(name, 0, 99) == b"whole"


@pytest.mark.parametrize("rotten", ["bytes", "sums"])
def test_flipped_bit_is_cut_off_and_nothing_before_it(tmp_path: Path, rotten: str):
    """Only bytes before the part with the flipped bit are held; the camera gives the rest again."""
    chance, name = random.Random(7), "/captured/a/raw_0"
    parts = [chance.randbytes(chance.randint(1, 40)) for _ in range(12)]
    truth, ends = b"".join(parts), [0, *itertools.accumulate(len(part) for part in parts)]
    before = FetchedFiles(tmp_path / "whole")
    for part in parts:
        before.append(name, part)
    for trial in range(25):
        folder = shutil.copytree(tmp_path / "whole", tmp_path / str(trial))
        path = next(path for path in folder.iterdir() if path.name.endswith(SUMS) == (rotten == "sums"))
        flip(path, at=(place := chance.randrange(path.stat().st_size)), bit=chance.randrange(8))
        kept = FetchedFiles(folder)
        held = kept.size(name)
        assert kept.read(name, 0, held) == truth[:held]
        assert held == (ends[place // 12] if rotten == "sums" else max(end for end in ends if end <= place))
        kept.append(name, truth[held:])
        assert FetchedFiles(folder).read(name, 0, 1000) == truth


def test_file_without_sums_is_fetched_again(tmp_path: Path):
    """As of an earlier version, or of a disk that did not keep them: nothing vouches for a byte of it."""
    (tmp_path / "a%2Fraw_0").write_bytes(b"whatever")
    assert FetchedFiles(tmp_path).size("/a/raw_0") == 0
