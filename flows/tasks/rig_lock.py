"""One rig, one survey at a time: a lock by the rig's port that the kernel holds, free when its holder is gone.

On Linux it is a name in the kernel itself (an abstract socket, unix(7)): no folder has to be writable, no file can be
linked, removed or left behind, and every user and TMPDIR of the machine has the same one. It belongs to the network
that a process sees, which is the one it reaches the camera by. Elsewhere it is a file at a fixed place. A serial port
is also held by its driver, on the device itself. A Prefect concurrency limit may show who waits; this lock alone
decides.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import ArchiveError, RigError
from storage.archive.staging import take_lock

FIXED_FOLDER = Path("/tmp")  # not TMPDIR, of which each user may have another
_LONGEST_NAME = 60  # of the 107 bytes that a name in the kernel may have; the rest is for its holder's words
_NAMES = Path("/proc/net/unix")


@dataclass
class RigLock:
    """The lock of one rig: a name in the kernel, or a file."""

    place: Path | str
    _release: Callable[[], None] | None = field(default=None, repr=False)

    def take(self, words: str) -> bool:
        """Try to take it; ``words`` say who holds it. RigError: it cannot be had at all, ArchiveError: a link."""
        if self._release is None:
            self._release = hold_place(self.place, f"{words} (process {os.getpid()})")
        return self._release is not None

    def release(self) -> None:
        """Let go; harmless where it is not held."""
        release, self._release = self._release, None
        if release is not None:
            release()

    def holder(self) -> str:
        with suppress(OSError, UnicodeDecodeError, IndexError):
            if isinstance(self.place, Path):
                return self.place.read_text().strip() or "another process"
            below = rf" @{re.escape(self.place)}/(.+)$"  # the words below a name that is held
            names: list[str] = re.findall(below, _NAMES.read_text(errors="replace"), re.MULTILINE)
            return names[0]
        return "another process"


def rig_lock(port: str) -> RigLock:
    """Return the lock of the rig at a port."""
    name = f"spectralzoom-rig-{_as_name(port)}"
    return RigLock(name if sys.platform == "linux" else FIXED_FOLDER / f"{name}.lock")


def hold_place(place: Path | str, words: str) -> Callable[[], None] | None:
    """Hold a name in the kernel, or a file, until what is returned is called; None where another holds it.

    Raises RigError: it cannot be held by anybody here; ArchiveError: a link is in the place of a file.
    """
    try:
        if isinstance(place, str):
            return _hold_name(place, words)
        return take_lock(place, wait=False, words=f"{words}\n")
    except ArchiveError:  # which is an OSError too
        raise
    except OSError as error:
        raise RigError(
            f"cannot lock the rig by {place}: {error.strerror}; it may belong to another user: end that user's survey, "
            "or mend the rights: no survey goes on without the lock"
        ) from error


def _hold_name(name: str, words: str) -> Callable[[], None] | None:
    """Bind a name that one socket of the machine can have; a second one, below it, carries the words."""
    with ExitStack() as held:
        try:
            _bind(held, name)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return None
            raise
        with suppress(OSError):  # words that are held already, by nobody knows whom
            said = re.sub(r"[^ -~]", "?", words)
            _bind(held, f"{name}/{said[: 106 - len(name)]}")
        return held.pop_all().close


def _bind(held: ExitStack, name: str) -> None:
    one = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
    one.bind(b"\0" + name.encode())


@contextmanager
def rig_to_oneself(port: str, words: str) -> Iterator[None]:
    """Hold the rig at a port while the block runs (RigError: another survey holds it)."""
    lock = rig_lock(port)
    if not lock.take(words):
        raise RigError(f"the rig is in use by {lock.holder()}; wait until that survey has ended, or end it")
    try:
        yield
    finally:
        lock.release()


def _as_name(port: str) -> str:
    """A port as part of a name; two names of one device are one."""
    whole = os.path.realpath(port) if port.startswith("/") else port.lower()
    name = re.sub(r"[^A-Za-z0-9.-]+", "-", whole).strip("-") or "rig"
    if len(name) <= _LONGEST_NAME - 17:
        return name
    return f"{name[: _LONGEST_NAME - 34]}-{hashlib.sha256(whole.encode()).hexdigest()[:16]}"
