"""Keep files of the camera in a folder while they are fetched, so that the next transfer continues there.

A file of the camera is named by its whole path there, notes about the files by a name alone. Bytes are only appended;
a file that came damaged is dropped as a whole. Notes are on the disk when ``append`` returns. The last ``SYNC_BYTES``
of a file may not be, since the camera still has them.

::

    <name>          the bytes of a file of the camera, or of notes, which have checksums of their own
    <name>%sums     for each part of it: how far the file reached, and the CRC-32 of its bytes up to there

Each process compares a file that it finds with its sums once, and cuts it off behind the last sum that agrees. The
camera is asked for the rest again.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from pipeline.rig.transports import NotKept
from storage.archive.staging import format_disk_error, sync_path, write_all

SYNC_BYTES = 1 << 24
SUMS = "%sums"  # no quoted name ends with it
LOG = logging.getLogger(__name__)
_SUM = struct.Struct("<QI")
_BLOCK = 1 << 20
_LONGEST = 240  # of a file's name, in most file systems 255


class FetchedFiles:
    """A :class:`pipeline.rig.camera.camera_files.Kept` in a folder, which is made when the first bytes come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._unsynced: dict[str, int] = {}
        self._crc32: dict[str, int] = {}  # of all bytes of the files that were compared

    def size(self, name: str) -> int:
        """Return the number of bytes held of a file; 0 of one that is not there.

        Raises NotKept: the disk does not give them, here or in other calls.
        """
        path = self._path(name)
        try:
            self._compare(name, path)
            return path.stat().st_size
        except FileNotFoundError:
            return 0
        except OSError as error:
            raise _unread(path, error) from error

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return some of the bytes held."""
        path = self._path(name)
        try:
            self._compare(name, path)
            with path.open("rb") as file:
                file.seek(start)
                return file.read(max(stop - start, 0))
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise _unread(path, error) from error

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end. Raises NotKept: the disk refuses; a part that was written is removed again."""
        path = self._path(name)
        before = self.size(name)
        try:
            if not before:
                self.folder.mkdir(parents=True, exist_ok=True)
            with path.open("ab", buffering=0) as file:
                write_all(file.fileno(), data)
                waiting = self._unsynced.get(name, 0) + len(data)
                if _is_note(name) or waiting >= SYNC_BYTES:
                    os.fdatasync(file.fileno())
                    waiting = 0
                self._unsynced[name] = waiting
            if data and not _is_note(name):
                crc32 = zlib.crc32(data, self._crc32[name])
                with _sums_of(path).open("ab", buffering=0) as file:
                    write_all(file.fileno(), _SUM.pack(before + len(data), crc32))
                self._crc32[name] = crc32
            if not before:
                sync_path(self.folder)
        except OSError as error:
            self._crc32.pop(name, None)  # what the disk took of it is compared next time
            with suppress(OSError):
                os.truncate(path, before)
            raise NotKept(
                f"cannot keep byte {before} of {name} in {self.folder}: {format_disk_error(error)}; the {before} bytes "
                "before it are kept, and the camera still has the file"
            ) from error

    def drop(self, name: str) -> None:
        """Remove all bytes of a file (NotKept: the disk refuses)."""
        path = self._path(name)
        try:
            path.unlink(missing_ok=True)
            _sums_of(path).unlink(missing_ok=True)
            self._unsynced.pop(name, None)
            self._crc32.pop(name, None)
        except OSError as error:
            raise NotKept(
                f"cannot remove {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
            ) from error

    def _compare(self, name: str, path: Path) -> None:
        """Cut off the bytes that no sum covers, once for each file; notes have checksums of their own."""
        if name in self._crc32 or _is_note(name):
            return
        reached, crc32, count = _agreeing(path)
        if path.exists() and path.stat().st_size > reached:
            LOG.warning("%s: cut off at byte %d: the rest is damaged or was not synced", path, reached)
            os.truncate(path, reached)
        if _sums_of(path).exists():
            os.truncate(_sums_of(path), count * _SUM.size)
        self._crc32[name] = crc32

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
    try:
        sums = _sums_of(path).read_bytes()
        with path.open("rb") as file:
            for to, expected in _SUM.iter_unpack(sums[: len(sums) // _SUM.size * _SUM.size]):
                at, found = reached, crc32
                while at < to and (data := file.read(min(to - at, _BLOCK))):
                    at, found = at + len(data), zlib.crc32(data, found)
                if (at, found) != (to, expected):
                    break
                reached, crc32, count = at, found, count + 1
    except FileNotFoundError:
        pass
    return reached, crc32, count


def _unread(path: Path, error: OSError) -> NotKept:
    return NotKept(
        f"cannot read {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
    )
