"""The line spool: records of a capture while it runs, so that a crash loses at most the lines since the last sync.

``<name>.lines`` begins with one JSON object on a line: the sweep of the lines, with a checksum of its own. Records of
one size follow, one a line: number, mirror X and Y, time, exposure, valid, a CRC-32, and the raw numbers (sample, band)
uint16. The CRC continues that of the header, so that a record belongs to one sweep alone.

A line counts when its record has its CRC. Other records behind the last that counts are cut off, and the capture
continues there. Lines of other records before it are lost, until the source gives them again and they are put back in
their places.
"""

from __future__ import annotations

import json
import logging
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from pipeline.errors import RigError
from pipeline.json_lines import read_checked, with_check
from pipeline.source import Line
from storage.archive.keys import plain
from storage.archive.staging import format_disk_error, open_plain, plain_reader, sync_path, write_all

ENDING = ".lines"
SYNC_LINES = 64
MOST_NAMED = 8
LOG = logging.getLogger(__name__)
_FACTS, _CRC = struct.Struct("<q4d?"), struct.Struct("<I")
_LONGEST_HEADER = 1 << 20


class Spool:
    """Lines on disk, appended one by one. Use as a context manager, or close it."""

    def __init__(self, path: Path, head: bytes, shape: tuple[int, int]) -> None:
        self.path = path
        self.samples, self.bands = shape
        self.count = 0  # lines that are there or lost: the number of the next one appended
        self.lost: list[int] = []  # numbers of those that are lost, in order: `mend` them before the lines are read
        self._head = head
        self._seed = zlib.crc32(head)
        self._size = _FACTS.size + _CRC.size + 2 * shape[0] * shape[1]  # of a record
        self._file: BinaryIO | None = None

    @classmethod
    def open(cls, folder: Path, samples: int, bands: int, *, header: Mapping[str, Any], name: str = "lines") -> Spool:
        """Open the spool in ``folder``, or begin it; lines from an earlier, broken capture are kept and counted.

        ``header`` is what the lines belong to (the sweep, the source, the seed). Raises RigError: the spool holds lines
        of anything else, or the disk refuses.
        """
        facts = {"samples": samples, "bands": bands, "header": plain(dict(header))}
        spool = cls(folder / f"{name}{ENDING}", with_check(json.dumps(facts).encode()), (samples, bands))
        with _refusals(spool.path, 0):
            folder.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(spool.path):
                with os.fdopen(open_plain(spool.path, os.O_WRONLY | os.O_CREAT), "wb") as file:
                    file.write(spool._head)
                for named in (spool.path, folder, folder.parent, folder.parent.parent):  # lines need their file's name
                    sync_path(named)
            spool.recover()
        return spool

    @classmethod
    def known(cls, path: Path) -> Spool | None:
        """Open a spool by its own header, to be read; None where that is damaged."""
        with plain_reader(path) as file:
            head = file.readline(_LONGEST_HEADER)
        facts = _header(head)
        return None if facts is None else cls(path, head, (facts["samples"], facts["bands"]))

    def __enter__(self) -> Spool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RigError:
            if kind is None:  # else what went wrong first is what the user should read
                raise

    def append(self, line: Line) -> None:
        """Write the next line; every 64th call waits until the disk has them.

        Raises RigError: the line is out of order or of another size, or the disk refuses. The lines before it are kept.
        """
        record = self._record(line, self.count)
        with _refusals(self.path, self.count):
            if self._file is None:
                self._file = self._writer(os.O_APPEND)
            try:
                write_all(self._file.fileno(), record)
            except OSError:
                self._cut_back()
                raise
        self.count += 1
        if self.count % SYNC_LINES == 0:
            self.sync()

    def mend(self, lines: Iterable[Line]) -> None:
        """Put lost lines back: one for each number in `lost`, in that order.

        Afterwards the file is what it would be had nothing been lost; killed in between, some are lost yet. Raises
        RigError: a line is out of order or of another size, or the disk refuses.
        """
        for number, line in zip(list(self.lost), lines if self.lost else (), strict=True):
            record = self._record(line, number)
            with _refusals(self.path, number), self._writer() as file:
                file.seek(self._place(number))
                write_all(file.fileno(), record)
                os.fdatasync(file.fileno())
            self.lost = [one for one in self.lost if one != number]

    def sync(self) -> None:
        """Wait until the disk has every line. Raises RigError where it refuses."""
        if self._file is not None:
            with _refusals(self.path, self.count):
                os.fdatasync(self._file.fileno())

    def recover(self) -> int:
        """Find the good lines and those that are lost, cut off what a crash left torn behind the last good one.

        Gives the number of the next line. Raises RigError: the lines are of another sweep.
        """
        with plain_reader(self.path) as file:
            head = file.readline(_LONGEST_HEADER)
        good = [number for number, line in enumerate(self.read()) if line is not None]
        if head != self._head:
            found = _header(head)
            if found is not None and not good:
                raise RigError(
                    f"{self.path} holds lines of another sweep ({_difference(found, _header(self._head) or {})}); "
                    f"finish that capture, or remove the folder to start anew"
                )
            LOG.warning("%s: its header has changed; lines that belong to this sweep are kept", self.path)
            with self._writer() as file:
                write_all(file.fileno(), self._head)
        self.count = max(good, default=-1) + 1
        self.lost = sorted(set(range(self.count)) - set(good))
        if self.lost:
            LOG.warning("%s: not as it was captured, and asked for again: %s", self.path, line_values(self.lost))
        self._cut_back()
        return self.count

    def read(self, first: int = 0, last: int | None = None) -> Iterator[Line | None]:
        """Yield the lines from ``first`` on, before ``last``; None for each that is not as it was captured."""
        with plain_reader(self.path) as file:
            file.seek(self._place(first))
            for number in count(first) if last is None else range(first, last):
                record = file.read(self._size)
                if len(record) < self._size:
                    return
                yield self._line(number, record)

    def blocks(self, size: int = SYNC_LINES) -> Iterator[list[Line]]:
        """Yield the lines in blocks of ``size``; the last may be shorter.

        Raises RigError: a line has changed since it was written, or is lost and not mended; names it.
        """
        for first in range(0, self.count, size):
            block = list(self.read(first, min(first + size, self.count)))
            whole = [line for line in block if line is not None]
            if len(whole) < len(block):
                raise RigError(
                    f"{self.path}: line {first + block.index(None)} has changed since it was captured (CRC-32 "
                    f"differs); run again: it is asked for again, and the other lines are kept"
                )
            yield whole

    def close(self) -> None:
        """Close the file; what was appended stays."""
        try:
            self.sync()
        finally:
            if self._file is not None:
                self._file.close()
            self._file = None

    def _record(self, line: Line, number: int) -> bytes:
        if line.number != number or line.data.shape != (self.samples, self.bands):
            raise RigError(
                f"{self.path}: got line {line.number} of shape {line.data.shape}, expected line {number} of shape "
                f"{(self.samples, self.bands)} (sample, band); lines come in order, invalid ones with valid=False"
            )
        facts = _FACTS.pack(number, line.mirror_x, line.mirror_y, line.time_s, line.exposure_ms, line.valid)
        data = np.ascontiguousarray(line.data, "<u2").tobytes()
        return facts + _CRC.pack(zlib.crc32(data, zlib.crc32(facts, self._seed))) + data

    def _line(self, number: int, record: bytes) -> Line | None:
        facts, data = record[: _FACTS.size], record[_FACTS.size + _CRC.size :]
        (crc,) = _CRC.unpack_from(record, _FACTS.size)
        if crc != zlib.crc32(data, zlib.crc32(facts, self._seed)):
            return None
        found, mirror_x, mirror_y, time_s, exposure_ms, valid = _FACTS.unpack(facts)
        values = np.frombuffer(data, "<u2").reshape(self.samples, self.bands).astype(np.uint16)
        return Line(number, values, mirror_x, mirror_y, time_s, exposure_ms, valid) if found == number else None

    def _place(self, number: int) -> int:
        return len(self._head) + number * self._size

    def _writer(self, more: int = 0) -> BinaryIO:
        return os.fdopen(open_plain(self.path, os.O_WRONLY | more), "wb", buffering=0)

    def _cut_back(self) -> None:
        """Take away what stands behind the last good line, so that the next one begins in its place."""
        if self._file is not None:
            self._file.close()
            self._file = None
        with self._writer() as file:
            file.truncate(self._place(self.count))


def spool_problems(path: Path) -> Iterator[str]:
    """Yield what is not as it was captured of the lines at a path; a record that is not all there is no damage."""
    spool = Spool.known(path)
    if spool is None:
        with plain_reader(path) as file:
            if b'"check"' not in file.readline(_LONGEST_HEADER):
                return  # about to be begun
        yield f"{path.name}: its header has changed; lines that belong to it are told when the capture goes on"
        return
    lost = [number for number, line in enumerate(spool.read()) if line is None]
    if lost:
        words = "not as captured (CRC-32), or never on the disk: asked for again when the capture goes on"
        yield f"{path.name}: {line_values(lost)} {words}"


def line_values(numbers: Sequence[int]) -> str:
    """Return the numbers of lines for a message: the first few, and how many follow."""
    named = ", ".join(str(number) for number in numbers[:MOST_NAMED])
    more = f" and {len(numbers) - MOST_NAMED} more" if len(numbers) > MOST_NAMED else ""
    return f"line{'s' if len(numbers) > 1 else ''} {named}{more}"


def _header(head: bytes) -> dict[str, Any] | None:
    """Return the header on a file's first line, which names the sweep of its lines; None where it is damaged."""
    found = next(read_checked(head), None)
    if found is None or found.state != "whole" or found.content is None or found.text + b"\n" != head:
        return None
    sizes = [found.content.get(name) for name in ("samples", "bands")]
    good = all(type(size) is int and size > 0 for size in sizes) and isinstance(found.content.get("header"), dict)
    return {name: value for name, value in found.content.items() if name != "check"} if good else None


def _difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Return the first difference between two headers, in words."""
    have, want = ({**head, **head["header"]} for head in (found, wanted))
    for name in sorted((set(have) | set(want)) - {"header"}):
        if have.get(name) != want.get(name):
            return f"{name} is {have.get(name)!r}, expected {want.get(name)!r}"
    return "its header differs"


@contextmanager
def _refusals(path: Path, lines: int) -> Iterator[None]:
    """Turn a disk's refusal into a RigError that says how many lines are safe."""
    try:
        yield
    except RigError:
        raise
    except OSError as error:
        raise RigError(
            f"cannot write line {lines} to {path}: {format_disk_error(error)}; the {lines} lines before it are kept"
        ) from error
