"""Camera files on their way here, in a folder: what has come stays, whatever ends the transfer, and goes on there.

A file of the camera is named by its whole path there, notes about the files by a name alone. Bytes are written at the
end and nowhere else; a file that came damaged goes as a whole. Notes are on the disk when ``append`` returns; of files
so is all but the last ``SYNC_BYTES``, since the camera still has them. What is held is compared when a transfer goes
on.
"""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from pipeline.rig.refusals import NotKept
from storage.staging import sync_path

SYNC_BYTES = 1 << 24
_LONGEST = 240  # of a file's name, in most file systems 255


class FetchedFiles:
    """A :class:`pipeline.rig.kept_files.Kept` in a folder, which is made when the first bytes come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._unsynced: dict[str, int] = {}

    def size(self, name: str) -> int:
        """Bytes held of a file; 0 of one that is not there."""
        try:
            return self._path(name).stat().st_size
        except FileNotFoundError:
            return 0

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Some of the bytes held.

        Raises
        ------
        NotKept : the disk does not give them.
        """
        path = self._path(name)
        try:
            with path.open("rb") as file:
                file.seek(start)
                return file.read(max(stop - start, 0))
        except FileNotFoundError:
            return b""
        except OSError as error:
            raise NotKept(
                f"cannot read {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
            ) from error

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end.

        Raises
        ------
        NotKept : the disk refuses; a part that was written is taken away again.
        """
        path = self._path(name)
        before = self.size(name)
        try:
            if not before:
                self.folder.mkdir(parents=True, exist_ok=True)
            with path.open("ab", buffering=0) as file:
                _write_all(file.fileno(), data)
                waiting = self._unsynced.get(name, 0) + len(data)
                if "/" not in name or waiting >= SYNC_BYTES:
                    os.fdatasync(file.fileno())
                    waiting = 0
                self._unsynced[name] = waiting
            if not before:
                sync_path(self.folder)
        except OSError as error:
            _cut(path, before)
            raise NotKept(
                f"cannot keep byte {before} of {name} in {self.folder}: {error.strerror or error}; free space or "
                f"rights and run again: the {before} bytes before it are kept, and the camera still has the file"
            ) from error

    def drop(self, name: str) -> None:
        """Hold no byte of a file any more.

        Raises
        ------
        NotKept : the disk refuses.
        """
        path = self._path(name)
        try:
            path.unlink(missing_ok=True)
            self._unsynced.pop(name, None)
        except OSError as error:
            raise NotKept(
                f"cannot remove {path}: {error.strerror or error}; mend the disk and run again: the camera still has it"
            ) from error

    def _path(self, name: str) -> Path:
        named = quote(name.strip("/"), safe="")
        if not named or len(named) > _LONGEST:
            raise NotKept(f"the camera's file {name!r:.300} cannot be kept under its name; use a shorter prefix")
        return self.folder / ("%2E" + named[1:] if named.startswith(".") else named)


def _write_all(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]


def _cut(path: Path, size: int) -> None:
    try:
        os.truncate(path, size)
    except OSError:
        return  # what is held is compared when the transfer goes on
