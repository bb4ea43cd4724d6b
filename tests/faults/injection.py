"""Inject faults into a process from the inside: refused system calls, and signals before a call.

Each function is called once, in a process that only runs this fault and soon ends, so no function is restored.
"""

from __future__ import annotations

import _pyio
import builtins
import ctypes
import errno
import fcntl
import functools
import importlib
import io
import os
import shutil
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

_CALLS = "open write fsync fdatasync rename replace link mkdir unlink rmdir truncate ftruncate"
ERRORS = {name: getattr(errno, name) for name in ("EACCES", "EROFS", "EIO", "ENOSPC", "EDQUOT")}  # that are tried
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def refuse(
    root: str, at: int, number: int, *, lasting: bool = False, log: str | None = None, kind: str | None = None
) -> None:
    """Let the ``at``-th call (from 1) that changes a file below ``root`` fail with error ``number``.

    With ``lasting``, all later calls fail too; ``at`` 0 refuses no call. A refused write has written its first half.
    ``log`` gets each refused call, or with ``at`` 0 every call: its number, name and path.
    With a ``kind``, only calls count that open a file of this kind, see `label`.
    """
    _install(_Watch(root, at, number, lasting=lasting, log=log, kind=kind))


def fill_disk(root: str, at: int, kind: str) -> None:
    """Fill the disk of ``root`` just before the ``at``-th file of a ``kind`` is opened for writing."""
    _install(_Watch(root, at, kind=kind, fill=Path(root).absolute().parent / "ballast"))


def end_at(root: str, at: int, number: int, log: str | None = None) -> None:
    """Send this process a signal just before the ``at``-th call (from 1) that changes a file below ``root``.

    ``log`` is that of `refuse`.
    """
    _install(_Watch(root, at, log=log, ending=number))


def end_before(place: str, number: int, call: int = 1) -> None:
    """Send this process a signal before the ``call``-th call of a function: ``module:name``, ``module:Class.name``."""
    module, _, path = place.partition(":")
    *outer, name = path.split(".")
    inside = functools.reduce(getattr, outer, importlib.import_module(module))
    real = getattr(inside, name)
    calls = count(1)

    def ended(*given: Any, **named: Any) -> Any:
        if next(calls) == call:
            os.kill(os.getpid(), number)
        return real(*given, **named)

    setattr(inside, name, ended)


def fail_locks(number: int) -> None:
    """Let every lock fail with error ``number``; with 0 every lock is granted, and holds nothing."""

    def flock(*_: Any) -> None:
        if number:
            raise OSError(number, os.strerror(number))

    fcntl.__dict__["flock"] = flock


def stop_without_locks(root: str, at: int) -> None:
    """Stop this process just before its ``at``-th call that changes a file below ``root``; locks hold nothing."""
    fail_locks(0)
    end_at(root, at, signal.SIGSTOP)


def obey_rights() -> None:
    """Give up the rights of root over files, as every other user has no such rights; Linux alone knows them."""
    version_3, this_process, none = 0x20080522, 0, (ctypes.c_uint32 * 6)()
    if ctypes.CDLL(None, use_errno=True).capset((ctypes.c_uint32 * 2)(version_3, this_process), none):
        raise OSError(ctypes.get_errno(), "the rights of root stay")


def vanish_before(root: str, at: int, kept: list[str]) -> None:
    """Remove all stores below ``root`` but those ``kept``, just before the ``at``-th call that looks at a file there.

    Calls that look are `stat`, `scandir` and `open`, also those of the standard library.
    """
    calls = count(1)
    rename, rmtree, glob = os.rename, shutil.rmtree, Path.glob

    def remove() -> None:
        for number, path in enumerate(list(glob(Path(root), "stages/*/*"))):
            if path.relative_to(root).as_posix() not in kept and not path.name.endswith(".part"):
                rename(path, gone := f"{root}/../vanished-{os.getpid()}-{number}")
                rmtree(gone)

    def around(call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*given: Any, **named: Any) -> Any:
            path = os.fsdecode(given[0]) if given and isinstance(given[0], str | bytes | os.PathLike) else ""
            if path.startswith(root) and next(calls) == at:
                remove()
            return call(*given, **named)

        return watched

    for name in ("stat", "lstat", "scandir", "listdir", "open"):
        setattr(os, name, around(getattr(os, name)))
    builtins.open = io.open = _pyio.open


def label(path: Path) -> str | None:
    """Return the kind of an archive's file: store or manifest of a stage, spool or run; None for locks."""
    first, *rest = path.parts or ("",)
    if first not in ("spool", "stages", "runs"):
        return None
    if first == "spool" or len(rest) < 2:
        return "spool" if first == "spool" else None
    name = "run" if first == "runs" else rest[0]
    return f"{name} manifest" if rest[-1] == "manifest.json" else name


def _install(watch: _Watch) -> None:
    for name in _CALLS.split():
        setattr(os, name, watch.around(name, getattr(os, name)))
    # The io module calls the system from C, but its Python version calls os: so the files of every library are seen.
    builtins.open = io.open = _pyio.open


@dataclass
class _Watch:
    """Count calls of all threads."""

    root: str
    at: int
    number: int = 0  # of the error
    lasting: bool = False
    log: str | None = None
    kind: str | None = None  # of the files whose opening counts; None counts every call
    fill: Path | None = None  # file to fill the disk with, instead of refusing
    ending: int | None = None  # signal to send this process, instead of refusing

    def __post_init__(self) -> None:
        self.root = str(Path(self.root).absolute())
        self._lock = threading.Lock()
        self._count = 0
        self._write = os.write
        self._log = None if self.log is None else os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    def around(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return the call with the fault before it."""

        def guarded(*given: Any, **named: Any) -> Any:
            path = self._path(name, given, named)
            due = path is not None and self._due(name, path)
            if due and self.fill is not None:
                _fill(self.fill)
            elif due and self.ending is not None:
                os.kill(os.getpid(), self.ending)
            elif due:
                if name == "write" and len(given[1]) > 1:
                    call(given[0], memoryview(given[1])[: len(given[1]) // 2])
                raise OSError(self.number, os.strerror(self.number), *(() if name in _ON_FILES else (path,)))
            return call(*given, **named)

        return guarded

    def _path(self, name: str, given: tuple[Any, ...], named: dict[str, Any]) -> str | None:
        if name == "open" and not (given[1] if len(given) > 1 else named.get("flags", 0)) & _WRITING:
            return None
        first = given[0]
        try:
            if isinstance(first, int):
                path = str(Path(f"/proc/self/fd/{first}").readlink())
            elif named.get("dir_fd") is not None:
                path = str(Path(f"/proc/self/fd/{named['dir_fd']}").readlink() / os.fsdecode(first))
            else:
                path = str(Path(os.fsdecode(first)).absolute())
        except OSError:
            return None
        if name == "mkdir" and Path(path).is_dir():
            return None  # fails before any change
        return path if path.startswith(self.root) else None

    def _due(self, name: str, path: str) -> bool:
        with self._lock:
            begun = self.lasting and 0 < self.at <= self._count
            counts = self.kind is None or (name == "open" and label(Path(path).relative_to(self.root)) == self.kind)
            self._count += counts
            due = begun or (counts and self._count == self.at)
            if self._log is not None and (due or self.at == 0):
                self._write(self._log, f"{self._count} {name} {path}\n".encode())
        return due


def _fill(ballast: Path) -> None:
    with io.FileIO(str(ballast), "w") as file:
        size = 1 << 20
        while size:
            try:
                file.write(bytes(size))
            except OSError:
                size //= 2  # the last page takes what a larger piece could not


_ON_FILES = {"write", "fsync", "fdatasync", "ftruncate"}  # errors of these have no file name


def logged_calls(log: Path) -> list[tuple[int, str, str]]:
    """Return the entries in the log of `refuse`: number, name and path of calls."""
    lines = log.read_text().splitlines() if log.exists() else []
    parts = (line.split(" ", 2) for line in lines)
    return [(int(count), name, path) for count, name, path in parts]
