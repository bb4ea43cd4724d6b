"""Lines come back as they went in; a torn tail is cut off, a changed line is named, other lines are not continued."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import RigError
from pipeline.source import Line
from storage.arrays.spool import Spool
from tests.storage.small_archive import flip

HEADER = {"sweep": "fine-0", "seed": 3, "start_px": -40.25}


def _line(number: int, samples: int = 6, bands: int = 4) -> Line:
    data = np.random.default_rng(number).integers(0, 65536, (samples, bands), dtype=np.uint16)
    return Line(number, data, 0.1 / (number + 1), -0.3, 0.1 * number, 100.0, number != 2)


def _fill(folder: Path, count: int) -> None:
    with Spool.open(folder, 6, 4, header=HEADER) as spool:
        for number in range(spool.count, count):
            spool.append(_line(number))


def _same(found: list[Line], first: int = 0) -> bool:
    want = [_line(first + index) for index in range(len(found))]
    return all(
        (a.data == b.data).all() and vars(a) | {"data": 0} == vars(b) | {"data": 0}
        for a, b in zip(found, want, strict=True)
    )


def test_lines_come_back_in_blocks(tmp_path: Path) -> None:
    """150 lines are blocks of 64, 64 and 22, each line with all its facts."""
    for count in (10, 12, 150):  # interrupted, and gone on with
        _fill(tmp_path, count)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert spool.count == 150
        blocks = list(spool.blocks())
    assert [len(block) for block in blocks] == [64, 64, 22]
    assert _same([line for block in blocks for line in block])


def test_every_64th_line_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is synced at lines 64 and 128: a power cut loses fewer than 64 lines."""
    synced_at: list[int] = []
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        real = os.fdatasync
        monkeypatch.setattr(os, "fdatasync", lambda file: (synced_at.append(spool.count), real(file))[1])
        for number in range(130):
            spool.append(_line(number))
        assert synced_at == [64, 128]


RECORD = 45 + 2 * 6 * 4  # bytes of a line


@pytest.mark.parametrize("cut", [1, 30, RECORD - 1, RECORD, RECORD + 1, 3 * RECORD])
def test_a_torn_tail_is_cut_off(tmp_path: Path, cut: int) -> None:
    """Whatever part of the last lines is lost, the whole lines before it are kept and the capture goes on."""
    _fill(tmp_path, 8)
    os.truncate(tmp_path / "lines.lines", (tmp_path / "lines.lines").stat().st_size - cut)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert (spool.count, spool.lost) == (8 - -(-cut // RECORD), [])
        assert _same([line for block in spool.blocks() for line in block])
    _fill(tmp_path, 8)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert _same(next(spool.blocks()))
        assert spool.count == 8


@pytest.mark.parametrize("lost", [[0], [3], [2, 3, 4], list(range(70))])
def test_lost_lines_are_put_back(tmp_path: Path, lost: list[int]) -> None:
    """The same bytes as had nothing been lost; until then the others are there and these are not given."""
    _fill(tmp_path, 75)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for number in lost:
        flip(tmp_path / "lines.lines", (number - 75) * RECORD + 7 * number % RECORD)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert (spool.count, spool.lost) == (75, lost)
        with pytest.raises(RigError, match=f"line {lost[0]} has changed since it was captured"):
            list(spool.blocks(75))
        spool.mend(_line(number) for number in lost)
        assert spool.lost == []
        assert _same(next(spool.blocks(75)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_lines_are_put_back_in_their_places_alone(tmp_path: Path) -> None:
    """Another line than the one that is lost is refused, and nothing is overwritten with it."""
    _fill(tmp_path, 6)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        flip(tmp_path / "lines.lines", -RECORD - 5)
        with pytest.raises(RigError, match="line 4 has changed"):  # reading compares each line's checksum
            list(spool.blocks())
        assert (spool.recover(), spool.lost) == (6, [4])  # and opening again finds it lost, and the one after it good
        with pytest.raises(RigError, match="got line 3"):
            spool.mend([_line(3)])
        assert spool.lost == [4]
        spool.append(_line(6))
        spool.mend([_line(4)])
        assert _same(next(spool.blocks()))


def test_a_damaged_header_costs_no_line_of_this_sweep(tmp_path: Path) -> None:
    """Records go on from the header's checksum: those of this sweep are known without it, another's are not taken."""
    _fill(tmp_path, 6)
    flip(tmp_path / "lines.lines", 30)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert (spool.count, spool.lost) == (6, [])
        assert _same(next(spool.blocks()))
    flip(tmp_path / "lines.lines", 30)
    with Spool.open(tmp_path, 6, 4, header={**HEADER, "seed": 4}) as spool:
        assert spool.count == 0


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_link_or_a_pipe_is_no_spool(tmp_path: Path, kind: str) -> None:
    """Neither followed nor waited for, and what a link leads to stays as it was."""
    _fill(tmp_path / "spool", 3)
    path, away = tmp_path / "spool" / "lines.lines", tmp_path / "away"
    path.rename(away)
    before = away.read_bytes()
    os.mkfifo(path) if kind == "pipe" else path.symlink_to(away)
    with pytest.raises(RigError, match=f"it is a {kind}, expected a file"):
        Spool.open(tmp_path / "spool", 6, 4, header=HEADER)
    assert away.read_bytes() == before


def test_lines_of_another_sweep_are_not_continued(tmp_path: Path) -> None:
    """A header that differs is refused with what differs, and the lines are kept."""
    _fill(tmp_path, 3)
    other = {**HEADER, "seed": 4}
    with pytest.raises(RigError, match="seed is 3, expected 4"):
        Spool.open(tmp_path, 6, 4, header=other)
    with pytest.raises(RigError, match="samples is 6, expected 5"):
        Spool.open(tmp_path, 5, 4, header=HEADER)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        assert spool.count == 3


def test_lines_come_in_order_and_of_one_size(tmp_path: Path) -> None:
    """A line with another number or shape is refused, and so is a file where the folder should be."""
    (tmp_path / "file").write_text("x")
    with pytest.raises(RigError, match="cannot write line 0"):
        Spool.open(tmp_path / "file", 6, 4, header=HEADER)
    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        with pytest.raises(RigError, match="got line 1"):
            spool.append(_line(1))
        with pytest.raises(RigError, match=r"shape \(5, 4\)"):
            spool.append(_line(0, samples=5))


def test_a_full_disk_keeps_the_lines_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk takes half a line and refuses: the message counts what is kept, and the capture can go on at once."""
    _fill(tmp_path, 5)
    real = os.write

    def half(descriptor: int, content: memoryview) -> int:
        if len(content) < 48:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, content[:20])

    with Spool.open(tmp_path, 6, 4, header=HEADER) as spool:
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", half)
            with pytest.raises(RigError, match=r"cannot write line 5.*the disk is full.*the 5 lines before it"):
                spool.append(_line(5))
        spool.append(_line(5))
        assert _same(next(spool.blocks()))
