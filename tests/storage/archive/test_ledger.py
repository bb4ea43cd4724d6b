"""The ledger: lines that stay, torn lines passed over, one writer at a time."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from pipeline.errors import ArchiveError
from storage.archive.archive import Archive
from storage.archive.ledger import Ledger, ledgers
from storage.remote.opening import verify_archive


def test_lines_come_back_in_order(tmp_path: Path) -> None:
    """What was appended is read, oldest first, and other fields have their own."""
    ledger = Ledger(tmp_path, "north")
    assert ledger.lines() == []
    for number in range(3):
        ledger.append({"number": number, "words": "ä"})
    Ledger(tmp_path, "south").append({"number": 9})
    assert [line["number"] for line in ledger.lines()] == [0, 1, 2]
    assert [one.field for one in ledgers(tmp_path)] == ["north", "south"]


@pytest.mark.parametrize("torn", [b'{"number": 1', b"\x00" * 40, b'{"number": 1}\n[1]\n"x"\nnonsense\n'])
def test_a_torn_line_loses_nothing_else(tmp_path: Path, torn: bytes) -> None:
    """After a power cut the lines before and after what is torn are there."""
    ledger = Ledger(tmp_path, "north")
    ledger.append({"number": 0})
    with ledger.path.open("ab") as file:
        file.write(torn)
    ledger.append({"number": 2})
    numbers = [line["number"] for line in ledger.lines()]
    assert numbers[0] == 0
    assert numbers[-1] == 2


def test_a_line_that_has_changed_is_told_by_its_number(archive: Archive) -> None:
    """The others are read, and so is what follows; a last line that is torn is no change."""
    ledger = Ledger(archive.root, "north")
    for number in range(3):
        ledger.append({"number": number})
    whole = ledger.path.read_bytes()
    ledger.path.write_bytes(whole.replace(b'"number": 1', b'"number": 9') + b'{"number": 3, "wo')
    assert [line["number"] for line in ledger.lines()] == [0, 2]
    found = [one for one in verify_archive(archive) if one.problem is not None]
    told = "line 2 has changed since it was written; the other lines are read"
    assert [(one.uri, one.problem, one.kind) for one in found] == [("schedule/north.jsonl", told, "growing")]


def test_a_ledger_without_checksums_is_read(archive: Archive) -> None:
    """As an earlier version wrote it; lines that are added have them."""
    ledger = Ledger(archive.root, "north")
    ledger.path.parent.mkdir()
    ledger.path.write_bytes(b'{"number": 0}\n{"number": 1}\n')
    ledger.append({"number": 2})
    assert [line["number"] for line in ledger.lines()] == [0, 1, 2]
    assert ledger.path.read_bytes().count(b'"check"') == 1
    assert not any(one.problem for one in verify_archive(archive))


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_link_or_a_pipe_is_no_ledger(tmp_path: Path, kind: str) -> None:
    """Neither followed nor waited for, by readers or writers, and verify tells of it."""
    archive = Archive.open(tmp_path / "archive")
    ledger, away = Ledger(archive.root, "north"), tmp_path / "away"
    away.write_bytes(b"")
    ledger.path.parent.mkdir()
    os.mkfifo(ledger.path) if kind == "pipe" else ledger.path.symlink_to(away)
    for use in (ledger.lines, lambda: ledger.append({"number": 0})):
        with pytest.raises(ArchiveError, match=f"it is a {kind}, expected a file"):
            use()
    assert away.read_bytes() == b""
    (found,) = (one for one in verify_archive(archive) if one.problem is not None)
    assert (found.uri, found.kind) == ("schedule/north.jsonl", "stray")
    assert f"is a {kind}, expected a file" in str(found.problem)


def test_a_refused_line_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that takes half of a line: one message, and the file is as before."""
    ledger = Ledger(tmp_path, "north")
    ledger.append({"number": 0})
    before = ledger.path.read_bytes()
    real, given = os.write, []

    def half(descriptor: int, content: bytes) -> int:
        given.append(content)
        if len(given) > 1:
            raise OSError(28, os.strerror(28), str(ledger.path))
        return real(descriptor, content[:5])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", half)
        with pytest.raises(ArchiveError, match="the disk is full"):
            ledger.append({"number": 1})
    assert ledger.path.read_bytes() == before


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    """Who looks before writing is alone: forty counts in four threads are forty numbers."""

    def count() -> None:
        ledger = Ledger(tmp_path, "north")
        for _ in range(10):
            with ledger.held():
                ledger.append({"number": len(ledger.lines())})

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [line["number"] for line in Ledger(tmp_path, "north").lines()] == list(range(40))


@pytest.mark.parametrize("name", ["", "../north", "a/b", ".hidden", "x.part"])
def test_a_name_that_cannot_be_a_file_is_refused(tmp_path: Path, name: str) -> None:
    """Nothing is written beside the folder of ledgers."""
    with pytest.raises(ArchiveError, match="cannot be a field's name"):
        Ledger(tmp_path, name)
