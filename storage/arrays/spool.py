"""Store the lines of a capture and the files of its camera while it runs; a crash loses the lines since the last sync.

``<name>.lines`` begins with one line of JSON that describes the sweep. Records of one size follow, one for each line.
A record has number, mirror X and Y, time, exposure, valid, a CRC-32, and the raw numbers (sample, band) uint16. The CRC
continues that of the header, so that a record belongs to one sweep alone.

A torn tail is cut off, and the capture continues there. A line that was damaged after it was synced is lost alone: it
is named in the log, and comes back as an invalid line.

Files of a camera lie in a folder while they are fetched, so that the next transfer continues there. A file is named by
its whole path on the camera, notes about the files by a name alone. Bytes are only appended; a damaged file is dropped
as a whole. Notes are on the disk when ``append`` returns; of a file the camera still has what is not.

::

    <name>          the bytes of a file of the camera, or of notes, which have checksums of their own
    <name>%sums     for each part of it: how far the file reached, and the CRC-32 of its bytes up to there

Each process compares a file that it finds with its sums once, and cuts it off behind the last sum that agrees. The
camera is asked for the rest again.
"""

from __future__ import annotations

import json
import logging
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote

import numpy as np

from spectralzoom.pipeline.errors import PipelineError, RigError, disk_advice, list_some
from spectralzoom.pipeline.rig.transports import NotKept
from spectralzoom.pipeline.source import Line
from spectralzoom.storage.store import plain
from spectralzoom.storage.whole_files import make_folder, open_own, read_own, sync, write_new

SYNC_LINES = 64
MOST_NAMED = 8
LOG = logging.getLogger(__name__)
_LONGEST_HEADER = 1 << 20
_FACTS, _CRC = struct.Struct("<q4d?"), struct.Struct("<I")


class Spool:
    """Lines on disk, appended one by one. Use as a context manager, or close it."""

    def __init__(self, path: Path, head: bytes, shape: tuple[int, int]) -> None:
        self.path = path
        self.samples, self.bands = shape
        self.count = 0  # lines in the file: the number of the next one
        self._head = head
        self._seed = zlib.crc32(head)
        self._size = _FACTS.size + _CRC.size + 2 * shape[0] * shape[1]  # of a record
        self._file: IO[Any] | None = None

    @classmethod
    def open(cls, folder: Path, samples: int, bands: int, *, header: Mapping[str, Any], name: str = "lines") -> Spool:
        """Open the spool in ``folder``, or begin it; lines of an earlier, interrupted capture are kept and counted.

        ``header`` describes the capture (the sweep, the source, the seed). Raises RigError: the disk refuses.
        """
        facts = {"samples": samples, "bands": bands, "header": plain(dict(header))}
        spool = cls(folder / f"{name}.lines", json.dumps(facts).encode() + b"\n", (samples, bands))
        with _refusals(spool.path, 0):
            make_folder(folder, folder.parents[1])
            if not os.path.lexists(spool.path):
                write_new(spool.path, spool._head)
                for named in (spool.path, folder, folder.parent, folder.parent.parent):  # lines need their file's name
                    sync(named)
            spool._recover()
        return spool

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except RigError:
            if kind is None:  # the first error is the one to report
                raise

    def append(self, line: Line) -> None:
        """Write the next line; every 64th call waits until the disk has them.

        Raises RigError: the line is out of order or of another size, or the disk refuses. The lines before it are kept.
        """
        if line.number != self.count or line.data.shape != (self.samples, self.bands):
            raise RigError(
                f"{self.path}: got line {line.number} of shape {line.data.shape}, expected line {self.count} of shape "
                f"{(self.samples, self.bands)} (sample, band). Give lines in order, missing ones with valid=False"
            )
        facts = _FACTS.pack(line.number, line.mirror_x, line.mirror_y, line.time_s, line.exposure_ms, line.valid)
        data = np.ascontiguousarray(line.data, "<u2").data.cast("B")  # no copy: it is written and summed once
        with _refusals(self.path, self.count):
            if self._file is None:
                self._file = open_own(self.path, "ab", 0)
            try:
                for part in (facts + self._crc(facts, data), data):
                    write_all(self._file.fileno(), part)
            except OSError:
                self._cut_back()
                raise
        self.count += 1
        if self.count % SYNC_LINES == 0:
            self.sync()

    def sync(self) -> None:
        """Wait until the disk has every line. Raises RigError where it refuses."""
        if self._file is not None:
            with _refusals(self.path, self.count):
                os.fdatasync(self._file.fileno())

    def blocks(self) -> Iterator[list[Line]]:
        """Yield the lines in blocks of `SYNC_LINES`; the last may be shorter. A damaged line is not valid."""
        nothing = np.zeros((self.samples, self.bands), np.uint16)
        unknown = (float("nan"),) * 4
        with open_own(self.path) as file:
            file.seek(len(self._head))
            for first in range(0, self.count, SYNC_LINES):
                read = [self._line(n, file.read(self._size)) for n in range(first, min(first + SYNC_LINES, self.count))]
                yield [line or Line(n, nothing, *unknown, valid=False) for n, line in enumerate(read, first)]

    def close(self) -> None:
        """Close the file; appended lines stay."""
        try:
            self.sync()
        finally:
            if self._file is not None:
                self._file.close()
            self._file = None

    def _recover(self) -> None:
        """Count the lines, and cut off the first damaged one behind the last sync with all that follows it."""
        with open_own(self.path) as file:
            head = file.readline(_LONGEST_HEADER)
            file.seek(len(self._head))
            records = enumerate(iter(lambda: file.read(self._size), b""))
            whole = [self._line(number, record) is not None for number, record in records]
        if head != self._head:
            with open_own(self.path, "r+b", 0) as file:
                write_all(file.fileno(), self._head)
        if not any(whole):  # a header that was begun, and nothing that belongs to it
            whole = []
        damaged = [number for number, good in enumerate(whole) if not good]
        synced = max(len(whole) - 1, 0) // SYNC_LINES * SYNC_LINES
        self.count = next((number for number in damaged if number >= synced), len(whole))
        if lost := [number for number in damaged if number < synced]:
            LOG.warning("%s: damaged since they were captured, and lost: %s", self.path, line_values(lost))
        self._cut_back()

    def _line(self, number: int, record: bytes) -> Line | None:
        """Return the line of a record; None where the record is torn or damaged."""
        facts, data = record[: _FACTS.size], record[_FACTS.size + _CRC.size :]
        if len(record) < self._size or record[_FACTS.size : _FACTS.size + _CRC.size] != self._crc(facts, data):
            return None
        found, mirror_x, mirror_y, time_s, exposure_ms, valid = _FACTS.unpack(facts)
        values = np.frombuffer(data, "<u2").reshape(self.samples, self.bands).astype(np.uint16)
        return Line(number, values, mirror_x, mirror_y, time_s, exposure_ms, valid) if found == number else None

    def _crc(self, facts: bytes, data: bytes | memoryview) -> bytes:
        return _CRC.pack(zlib.crc32(data, zlib.crc32(facts, self._seed)))

    def _cut_back(self) -> None:
        """Remove everything behind the counted lines, so that the next one begins there."""
        if self._file is not None:
            self._file.close()
            self._file = None
        _cut(self.path, len(self._head) + self.count * self._size)


def line_values(numbers: Sequence[int]) -> str:
    """Return the numbers of lines for a message: the first few, and how many follow."""
    return f"line{'s' if len(numbers) > 1 else ''} {list_some(list(map(str, numbers)), MOST_NAMED)}"


def format_disk_error(error: OSError) -> str:
    """Return `disk_advice`, or the system's message."""
    return disk_advice(error) or f"{error.strerror or error}; free space or rights and run again"


def write_all(descriptor: int, content: bytes | memoryview) -> None:
    """Write every byte, in several calls if need be."""
    view = memoryview(content)
    while view:
        view = view[os.write(descriptor, view) :]


def _cut(path: Path, size: int) -> None:
    with open_own(path, "r+b", 0) as file:
        file.truncate(size)


@contextmanager
def _refusals(path: Path, lines: int) -> Iterator[None]:
    """Turn a disk's refusal into a RigError that says how many lines are kept."""
    try:
        yield
    except PipelineError:
        raise
    except OSError as error:
        raise RigError(
            f"cannot write line {lines} to {path}: {format_disk_error(error)}; the {lines} lines before it are kept"
        ) from error


SUMS = "%sums"  # no quoted name ends with it
_SUM = struct.Struct("<QI")
_BLOCK = 1 << 20
_LONGEST = 240  # of a file's name, in most file systems 255


class FetchedFiles:
    """A :class:`pipeline.rig.camera.camera_files.Kept` in a folder, which is made when the first bytes come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._crc32: dict[str, int] = {}  # of all bytes of the files that were compared

    def size(self, name: str) -> int:
        """Return the number of bytes held of a file; 0 of one that is not there.

        Raises NotKept: the disk does not give them, here or in other calls.
        """
        path = self._path(name)
        with _unread(path):
            if name not in self._crc32 and not _is_note(name):  # bytes that no sum covers are cut off, once for a file
                reached, crc32, count = _agreeing(path)
                if path.exists() and path.stat().st_size > reached:
                    LOG.warning("%s: cut off at byte %d: the rest is damaged or was not synced", path, reached)
                    _cut(path, reached)
                if _sums_of(path).exists():
                    _cut(_sums_of(path), count * _SUM.size)
                self._crc32[name] = crc32
            return path.stat().st_size if path.exists() else 0

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return some of the bytes held."""
        path = self._path(name)
        if not self.size(name):
            return b""
        with _unread(path), open_own(path) as file:
            file.seek(start)
            return bytes(file.read(max(stop - start, 0)))

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end. Raises NotKept: the disk refuses; a part that was written is removed again."""
        path = self._path(name)
        before = self.size(name)
        try:
            if not before:
                make_folder(self.folder, self.folder.parent)
            with open_own(path, "ab", 0) as file:
                write_all(file.fileno(), data)
                if _is_note(name):
                    os.fdatasync(file.fileno())
            if data and not _is_note(name):
                crc32 = zlib.crc32(data, self._crc32[name])
                with open_own(_sums_of(path), "ab", 0) as file:
                    write_all(file.fileno(), _SUM.pack(before + len(data), crc32))
                self._crc32[name] = crc32
            if not before:
                sync(self.folder)
        except OSError as error:
            self._crc32.pop(name, None)  # what the disk took of it is compared next time
            with suppress(OSError):
                _cut(path, before)
            raise NotKept(
                f"cannot keep byte {before} of {name} in {self.folder}: {format_disk_error(error)}; the {before} bytes "
                "before it are kept, and the camera still has the file"
            ) from error

    def _path(self, name: str) -> Path:
        named = quote(name.strip("/"), safe="")
        if not named or len(named) > _LONGEST:
            raise NotKept(f"the camera's file {name!r:.300} cannot be kept under its name; use a shorter prefix")
        return self.folder / ("%2E" + named[1:] if named.startswith(".") else named)


def _is_note(name: str) -> bool:
    return "/" not in name


def _sums_of(path: Path) -> Path:
    return path.with_name(path.name + SUMS)


def _agreeing(path: Path) -> tuple[int, int, int]:
    """Return up to which byte a file agrees with its sums, the CRC-32 of these bytes, and the number of such sums."""
    reached, crc32, count = 0, 0, 0
    with suppress(FileNotFoundError):
        sums = read_own(_sums_of(path))
        with open_own(path) as file:
            for to, expected in _SUM.iter_unpack(sums[: len(sums) // _SUM.size * _SUM.size]):
                at, found = reached, crc32
                while at < to and (data := file.read(min(to - at, _BLOCK))):
                    at, found = at + len(data), zlib.crc32(data, found)
                if (at, found) != (to, expected):
                    break
                reached, crc32, count = at, found, count + 1
    return reached, crc32, count


@contextmanager
def _unread(path: Path) -> Iterator[None]:
    """Turn a disk's refusal into a NotKept error."""
    try:
        yield
    except OSError as error:
        raise NotKept(
            f"cannot use {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
        ) from error
