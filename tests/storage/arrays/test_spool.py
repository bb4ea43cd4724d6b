"""Spooled lines are read as written; a truncated tail is cut off, and a damaged line harms no other."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spectralzoom.pipeline.errors import RigError
from spectralzoom.pipeline.source import Line
from spectralzoom.storage.arrays.spool import Spool
from tests.storage.small_archive import flip

HEADER = {"sweep": "fine-0", "seed": 3, "start_px": -40.25}
RECORD = 45 + 2 * 6 * 4  # bytes of a line


def _line(number: int, samples: int = 6, bands: int = 4) -> Line:
    data = np.random.default_rng(number).integers(0, 65536, (samples, bands), dtype=np.uint16)
    return Line(number, data, 0.1 / (number + 1), -0.3, 0.1 * number, 100.0, number != 2)


def _open(folder: Path) -> Spool:
    return Spool.open(folder, 6, 4, header=HEADER)


def _fill(folder: Path, count: int) -> None:
    with _open(folder) as spool:
        for number in range(spool.count, count):
            spool.append(_line(number))


def _lines(spool: Spool) -> list[Line]:
    return [line for block in spool.blocks() for line in block]


def _wrong(spool: Spool) -> list[int]:
    """Return the numbers of the lines that are not as they were written."""
    pairs = [(line, _line(line.number)) for line in _lines(spool)]
    return [a.number for a, b in pairs if (a.data != b.data).any() or replace(a, data=b.data) != b]


def test_spooled_lines_are_read_in_blocks_of_64(tmp_path: Path) -> None:
    """150 lines give blocks of 64, 64 and 22, each line with all its facts."""
    for count in (10, 12, 150):  # interrupted, and continued
        _fill(tmp_path, count)
    with _open(tmp_path) as spool:
        assert spool.count == 150
        assert [len(block) for block in spool.blocks()] == [64, 64, 22]
        assert _wrong(spool) == []


def test_spool_syncs_after_every_64_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is synced at lines 64 and 128 of 130: a power cut loses fewer than 64 lines."""
    synced_at: list[int] = []
    with _open(tmp_path) as spool:
        real = os.fdatasync
        monkeypatch.setattr(os, "fdatasync", lambda file: (synced_at.append(spool.count), real(file))[1])
        for number in range(130):
            spool.append(_line(number))
        assert synced_at == [64, 128]


@pytest.mark.parametrize("cut", [1, 30, RECORD - 1, RECORD, RECORD + 1, 3 * RECORD])
def test_a_truncated_tail_is_cut_off(tmp_path: Path, cut: int) -> None:
    """Whole lines before the cut are kept, and the capture continues after them."""
    _fill(tmp_path, 8)
    before = (tmp_path / "lines.lines").read_bytes()
    os.truncate(tmp_path / "lines.lines", len(before) - cut)
    with _open(tmp_path) as spool:
        assert spool.count == 8 - -(-cut // RECORD)
        assert _wrong(spool) == []
    _fill(tmp_path, 8)
    assert (tmp_path / "lines.lines").read_bytes() == before


@pytest.mark.parametrize(
    ("damaged", "lost", "count"), [([0], [0], 128), ([3, 63], [3, 63], 128), ([64], [], 64), ([5, 127], [5], 127)]
)
def test_a_damaged_line_harms_no_other_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damaged: list[int], lost: list[int], count: int
) -> None:
    """Before the last sync the line is reported and invalid; after it the capture continues from that line."""
    _fill(tmp_path, 128)  # the second sync may not have ended
    for number in damaged:
        flip(tmp_path / "lines.lines", (number - 128) * RECORD + 7 * number % RECORD)
    with _open(tmp_path) as spool:
        assert spool.count == count
        found = _lines(spool)
        assert _wrong(spool) == lost
    assert not any(found[number].valid or found[number].data.any() for number in lost)
    assert all(str(number) in caplog.text for number in lost)


def test_a_damaged_header_loses_no_line(tmp_path: Path) -> None:
    """Records continue the header's checksum, which identifies this capture's lines; a broken header alone has none."""
    _fill(tmp_path, 6)
    before = (tmp_path / "lines.lines").read_bytes()
    flip(tmp_path / "lines.lines", 30)
    with _open(tmp_path) as spool:
        assert spool.count == 6
    assert (tmp_path / "lines.lines").read_bytes() == before
    for left in (b"", b'{"samp', bytes(100)):  # by a crash at the start of a capture
        (tmp_path / "lines.lines").write_bytes(left)
        with _open(tmp_path) as spool:
            assert spool.count == 0


def test_lines_of_another_capture_are_not_continued(tmp_path: Path) -> None:
    """With another header or band count the spool begins at line 0."""
    _fill(tmp_path, 70)
    for bands, header in ((4, {**HEADER, "seed": 4}), (5, HEADER)):
        with Spool.open(tmp_path, 6, bands, header=header) as spool:
            assert spool.count == 0


def test_spool_refuses_a_wrong_line_number_or_shape(tmp_path: Path) -> None:
    """A file in place of the folder is refused as well."""
    (tmp_path / "file").write_text("x")
    with pytest.raises(RigError, match="cannot write line 0"):
        _open(tmp_path / "file")
    with _open(tmp_path) as spool:
        with pytest.raises(RigError, match="got line 1"):
            spool.append(_line(1))
        with pytest.raises(RigError, match=r"shape \(5, 4\)"):
            spool.append(_line(0, samples=5))


def test_a_full_disk_keeps_earlier_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk takes part of a line: the error counts the kept lines, and the capture can continue at once."""
    _fill(tmp_path, 5)
    real = os.write

    def half(descriptor: int, content: memoryview) -> int:
        if len(content) < 48:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, content[:20])

    with _open(tmp_path) as spool:
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", half)
            with pytest.raises(RigError, match=r"cannot write line 5.*the disk is full.*the 5 lines before it"):
                spool.append(_line(5))
        spool.append(_line(5))
        assert _wrong(spool) == []
