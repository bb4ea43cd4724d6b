"""Camera files on their way here, in a folder: what has come stays, and the next transfer continues there.

A file of the camera is named by its whole path there, notes about the files by a name alone. Bytes are written at the
end and nowhere else; a file that came damaged goes as a whole. Notes are on the disk when ``append`` returns; of files
so is all but the last ``SYNC_BYTES``, since the camera still has them. Held bytes are compared when a transfer
continues.

::

    <name>          the bytes of a file of the camera, or of notes, which have checksums of their own
    <name>%sums     records of how far the file reached, the CRC-32 of its bytes up to there, and that of the record

Files left by an earlier process are compared with their sums once, and cut off where they differ. The camera is asked
for the rest again.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from pipeline.rig.transports import NotKept
from storage.archive.staging import (
    format_disk_error,
    open_plain,
    plain_reader,
    plain_size,
    read_plain,
    sync_path,
    write_all,
)

SYNC_BYTES = 1 << 24
SUMS = "%sums"  # which no quoted name ends with
LOG = logging.getLogger(__name__)
_APPEND = os.O_WRONLY | os.O_APPEND | os.O_CREAT
_RECORD = struct.Struct("<QII")
_BLOCK = 1 << 20
_LONGEST = 240  # of a file's name, in most file systems 255


@dataclass
class _Sums:
    """The part of a file that agrees with its sums, and how many records say so."""

    reached: int = 0
    crc32: int = 0
    records: int = 0


class FetchedFiles:
    """A :class:`pipeline.rig.camera.camera_files.Kept` in a folder, which is made when the first bytes come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._unsynced: dict[str, int] = {}
        self._sums: dict[str, _Sums] = {}

    def size(self, name: str) -> int:
        """Return the number of bytes held of a file; 0 of one that is not there.

        Raises NotKept: the disk does not give them, here or in other calls.
        """
        path = self._path(name)
        try:
            self._compare(name, path)
            return plain_size(path)
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise _unread(path, error) from error

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return some of the bytes held."""
        path = self._path(name)
        try:
            self._compare(name, path)
            with plain_reader(path) as file:
                file.seek(start)
                return file.read(max(stop - start, 0))
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise _unread(path, error) from error

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end.

        Raises NotKept: the disk refuses; a part that was written is taken away again.
        """
        path = self._path(name)
        before = self.size(name)
        try:
            if not before:
                self.folder.mkdir(parents=True, exist_ok=True)
            with os.fdopen(open_plain(path, _APPEND), "ab", buffering=0) as file:
                write_all(file.fileno(), data)
                waiting = self._unsynced.get(name, 0) + len(data)
                if _is_note(name) or waiting >= SYNC_BYTES:
                    os.fdatasync(file.fileno())
                    waiting = 0
                self._unsynced[name] = waiting
            if data and not _is_note(name):
                self._sum_up(name, path, data)
            if not before:
                sync_path(self.folder)
        except OSError as error:
            _cut(path, before)
            raise NotKept(
                f"cannot keep byte {before} of {name} in {self.folder}: {format_disk_error(error)}; the {before} bytes "
                "before it are kept, and the camera still has the file"
            ) from error

    def drop(self, name: str) -> None:
        """Hold no byte of a file any more (NotKept: the disk refuses)."""
        path = self._path(name)
        try:
            path.unlink(missing_ok=True)
            _sums_of(path).unlink(missing_ok=True)
            self._unsynced.pop(name, None)
            self._sums.pop(name, None)
        except OSError as error:
            raise NotKept(
                f"cannot remove {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
            ) from error

    def _sum_up(self, name: str, path: Path, data: bytes) -> None:
        """Take down how far a file reaches now.

        A part that the disk took only half of is cut off when the file is compared.
        """
        known = self._sums[name]
        reached, crc32 = known.reached + len(data), zlib.crc32(data, known.crc32)
        text, sums = _record(reached, crc32), _sums_of(path)
        try:
            with os.fdopen(open_plain(sums, _APPEND), "ab", buffering=0) as file:
                write_all(file.fileno(), text)
        except OSError:
            _cut(sums, known.records * _RECORD.size)
            raise
        self._sums[name] = _Sums(reached, crc32, known.records + 1)

    def _compare(self, name: str, path: Path) -> None:
        """Cut off what an earlier process left and no sum vouches for; notes vouch for themselves."""
        if name in self._sums or _is_note(name):
            return
        found, changed = _agreeing(path)
        size = plain_size(path) if os.path.lexists(path) else 0
        if changed or size > found.reached:
            LOG.warning("%s: what follows byte %d is not as it was fetched, or was not all kept", path, found.reached)
            _cut(path, found.reached)
            _sums_of(path).unlink(missing_ok=True)
            found.records = 0
            if found.reached:
                _sums_of(path).write_bytes(_record(found.reached, found.crc32))
                found.records = 1
        elif os.path.lexists(_sums_of(path)):
            _cut(_sums_of(path), found.records * _RECORD.size)
        self._sums[name] = found

    def _path(self, name: str) -> Path:
        named = quote(name.strip("/"), safe="")
        if not named or len(named) > _LONGEST:
            raise NotKept(f"the camera's file {name!r:.300} cannot be kept under its name; use a shorter prefix")
        return self.folder / ("%2E" + named[1:] if named.startswith(".") else named)


def first_unlike(path: Path) -> int | None:
    """Return the number of the first byte of a fetched file that its sums contradict; None where all fits.

    A torn end is no change. Raises OSError: the file or its sums cannot be read.
    """
    found, changed = _agreeing(path)
    return found.reached if changed else None


def _is_note(name: str) -> bool:
    return "/" not in name


def _sums_of(path: Path) -> Path:
    return path.with_name(path.name + SUMS)


def _agreeing(path: Path) -> tuple[_Sums, bool]:
    """Return up to where bytes and sums of a file agree, and whether any byte of either has changed since.

    Each sum is of all bytes before it, so one that is lost is passed over.
    """
    found, reached, crc32, changed = _Sums(), 0, 0, False
    try:
        sums = read_plain(_sums_of(path))
        with plain_reader(path) as file:
            for number in range(len(sums) // _RECORD.size):
                to, expected, check = _RECORD.unpack_from(sums, number * _RECORD.size)
                if check != zlib.crc32(sums[number * _RECORD.size :][: _RECORD.size - 4]):
                    changed = True
                    continue
                while reached < to and (data := file.read(min(to - reached, _BLOCK))):
                    reached, crc32 = reached + len(data), zlib.crc32(data, crc32)
                if reached < to or crc32 != expected:
                    return found, True
                found = _Sums(reached, crc32, number + 1)
    except FileNotFoundError:
        pass
    return found, changed


def _record(reached: int, crc32: int) -> bytes:
    facts = _RECORD.pack(reached, crc32, 0)[:-4]
    return facts + zlib.crc32(facts).to_bytes(4, "little")


def _unread(path: Path, error: OSError) -> NotKept:
    return NotKept(
        f"cannot read {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
    )


def _cut(path: Path, size: int) -> None:
    try:
        os.truncate(path, size)
    except OSError:
        return  # what is held is compared when the transfer continues
