"""Follow the user's links, refuse what is no file, and notice files that change while they are read.

A link in a folder is its owner's, and is followed. Names inside of files are checked by their readers.

A file is unchanged if its inode, size and times are: no program can set its time of change (ctime). Two limits remain:
a file in memory alone (tmpfs) that a memory map keeps writing to, and a server that states a change late.
"""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from errno import ELOOP
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

from spectralzoom.pipeline.errors import FileChangedError, SceneError
from spectralzoom.storage.whole_files import sha256, sync

P = ParamSpec("P")
SECOND_NS = 10**9
GRAIN_NS = SECOND_NS // 50  # of clocks: two changes within it may have one time; 2 s where times are whole seconds
WRITTEN_BACK_NS = 60 * SECOND_NS  # older pages are on the disk, so that the next write through a map gets a time


@dataclass(frozen=True)
class OpenedFiles:
    """Files that readers have opened, with their stamps from before."""

    stamps: dict[Path, tuple[int, ...]] = field(default_factory=dict)
    digests: dict[Path, str] = field(default_factory=dict)
    parts: list[OpenedFiles] = field(default_factory=list)

    def note(self, path: Path, *, synced: bool = False) -> None:
        """Keep the stamp of a file or folder, and wait until every later change alters it.

        The pages of a young file are written to the disk if ``synced``, so that later writes through maps get a time.
        """
        if path in self.stamps:
            return
        self.stamps[path] = stamp = _stamp(path)
        age_ns = time.time_ns() - stamp[-1]
        if synced and age_ns < WRITTEN_BACK_NS:
            with suppress(OSError):
                sync(path)
        grain_ns = GRAIN_NS if stamp[-1] % SECOND_NS else 2 * SECOND_NS
        if abs(age_ns) < grain_ns:
            time.sleep(grain_ns / SECOND_NS)

    def digest(self, path: Path) -> str:
        """Return the SHA-256 of a file's content since it was noted, and keep it (FileChangedError)."""
        found = sha256(path)
        self._check(path)
        self.digests[path] = found
        return found

    def check(self) -> None:
        """Raise FileChangedError if a file has changed."""
        for path in self.stamps:
            self._check(path)
        for part in self.parts:
            part.check()

    def _check(self, path: Path) -> None:
        """Check a file; only rights and other names (links) of one with a digest may have changed."""
        now, stamp = _stamp(path), self.stamps[path]
        if now[:-1] != stamp[:-1] or (now != stamp and self.digests.get(path) != sha256(path)):
            raise FileChangedError(f"{path} changed while it was read; run the survey again when nothing writes to it")
        self.stamps[path] = now

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Check the files when the block ends, also by an error, which a half-written file may have caused."""
        try:
            yield
        finally:
            self.check()

    def guarded(self, read: Callable[P, NDArray[Any]]) -> Callable[P, NDArray[Any]]:
        """Return a reader that returns numbers of its own, and then checks the files."""

        def checked(*args: P.args, **kwargs: P.kwargs) -> NDArray[Any]:
            with self.unchanged():
                return np.require(read(*args, **kwargs), requirements="O")

        return checked


_reading: ContextVar[OpenedFiles | None] = ContextVar("reading", default=None)


@contextmanager
def reading_files() -> Iterator[OpenedFiles]:
    """Note every file that readers open in the block, and check them at its end (FileChangedError)."""
    outer, opened = _reading.get(), OpenedFiles()
    token = _reading.set(opened)
    try:
        with opened.unchanged():
            yield opened
    finally:
        _reading.reset(token)
    if outer is not None:
        outer.parts.append(opened)


def _stamp(path: Path) -> tuple[int, ...]:
    """Return inode, size and times of a file, the time of change last; all 0 if it is gone."""
    try:
        about = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return (0,) * 4
    return about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def is_there(path: Path, *, noted: bool = True) -> bool:
    """Return whether a file or folder has this name, before a reader opens it; `reading_files` notes it.

    Raises SceneError: a link leads nowhere, or it is a pipe, a socket or a device, whose reading may never end.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        if not isinstance(error, FileNotFoundError | NotADirectoryError) and error.errno != ELOOP:
            raise
        led = next((one for one in (path, *path.parents) if one.is_symlink() and not one.exists()), None)
        if led is not None:
            where = f"{led} is a link that leads nowhere, to {led.readlink()}"
            raise SceneError(f"{where}; correct it, mount the disk, or remove the link") from None
        return False
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise SceneError(f"{path} is no file; move it elsewhere")
    if noted and stat.S_ISREG(mode) and (opened := _reading.get()) is not None:
        opened.note(path, synced=True)
    return True


def first_there(names: Iterable[Path]) -> Path | None:
    """Return the first of the names that a file has; None without one (SceneError as `is_there`)."""
    return next((one for one in names if is_there(one) and not one.is_dir()), None)


def files_below(folder: Path) -> list[Path]:
    """Return all files of a folder, sorted; links are followed, each folder is visited once, and all are noted."""
    found: list[Path] = []
    visited: set[tuple[int, int]] = set()
    opened = _reading.get() or OpenedFiles()
    for place, folders, names in os.walk(folder, followlinks=True):
        about = Path(place).stat()
        if (about.st_dev, about.st_ino) in visited:
            folders.clear()
            continue
        visited.add((about.st_dev, about.st_ino))
        own = [path for path in (Path(place, name) for name in names) if path.is_file()]
        for path in (Path(place), *own):
            opened.note(path)
        found += own
    return sorted(found)
