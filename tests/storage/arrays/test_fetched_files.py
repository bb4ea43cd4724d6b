"""Fetched camera files keep their bytes, whatever their names are and whatever disk errors occur."""

from __future__ import annotations

import errno
import itertools
import os
import random
import shutil
from pathlib import Path

import pytest

from spectralzoom.pipeline.rig.transports import NotKept
from spectralzoom.storage.arrays.spool import SUMS, FetchedFiles
from tests.storage.small_archive import flip


def test_appended_bytes_are_read_back(tmp_path: Path):
    """Sizes and parts of several files are right; a second object on the same folder reads the same."""
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


def test_an_empty_file_is_stored(tmp_path: Path):
    """An empty file differs from a file that was never fetched."""
    FetchedFiles(tmp_path).append("/a/empty", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["a%2Fempty"]


@pytest.mark.parametrize("name", ["/captured/../../etc/passwd", "..", "/a b/ü", "a%2Fb", "\\..\\x"])
def test_no_file_name_leads_out_of_the_folder(tmp_path: Path, name: str):
    """Each camera file is stored inside the folder under its own name, whatever the camera calls it."""
    kept = FetchedFiles(tmp_path / "camera")
    kept.append(name, b"x")
    kept.append("/a/b", b"yy")
    assert kept.size(name) == 1
    assert len([path for path in (tmp_path / "camera").iterdir() if not path.name.endswith(SUMS)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["camera"]


def test_invalid_file_names_are_refused(tmp_path: Path):
    """An empty name is refused, and so is a name longer than file systems allow."""
    for name in ("/", "x" * 300):
        with pytest.raises(NotKept, match="use a shorter prefix"):
            FetchedFiles(tmp_path).append(name, b"x")


@pytest.mark.parametrize("name", ["/a/raw_0", "notes"])
def test_a_full_disk_keeps_earlier_bytes(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch):
    """A partial write is undone, and the error says what was kept."""
    kept = FetchedFiles(tmp_path)
    kept.append(name, b"whole")
    write = os.write

    def full(file: int, data: bytes) -> int:
        if len(data) > 2:
            return write(file, bytes(data)[:2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("spectralzoom.storage.arrays.spool.os.write", full)
    with pytest.raises(NotKept, match=rf"cannot keep byte 5 of {name} .*the disk is full.*the 5 bytes before"):
        kept.append(name, b"torn")
    assert kept.read(name, 0, 99) == b"whole"


@pytest.mark.parametrize("rotten", ["bytes", "sums"])
def test_a_flipped_bit_cuts_the_file_off_before_its_part(tmp_path: Path, rotten: str):
    """Only parts before the flipped bit are kept; the camera sends the rest again."""
    chance = random.Random(7)
    name = "/captured/a/raw_0"
    parts = [chance.randbytes(chance.randint(1, 40)) for _ in range(12)]
    truth = b"".join(parts)
    ends = [0, *itertools.accumulate(len(part) for part in parts)]
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


def test_a_file_without_checksums_is_fetched_again(tmp_path: Path):
    """Without checksums no byte of the file can be trusted, so its size counts as 0."""
    (tmp_path / "a%2Fraw_0").write_bytes(b"whatever")
    assert FetchedFiles(tmp_path).size("/a/raw_0") == 0
