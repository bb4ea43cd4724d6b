"""One rig, one survey at a time: a lock by the rig's port that the kernel holds, free when its holder is gone.

It is a name in the kernel itself (an abstract socket of Linux, unix(7)): no folder has to be writable, no file can be
linked, removed or left behind, and every user of the machine has the same one. It belongs to the network that a process
sees, which is the one it reaches the camera by. A serial port is also held by its driver, on the device itself. A
Prefect concurrency limit may show who waits; this lock alone decides.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from pipeline.errors import RigError

_LONGEST_NAME = 60  # of the 107 bytes that a name in the kernel may have; the rest is for its holder's words
_NAMES = Path("/proc/net/unix")


@contextmanager
def rig_to_oneself(port: str, words: str) -> Iterator[None]:
    """Hold the rig at a port while the block runs; ``words`` say who holds it.

    Raises RigError: another survey holds it, or the kernel refuses the lock.
    """
    name = lock_name(port)
    with ExitStack() as held:
        try:
            _bind(held, name)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise RigError(
                    f"the rig is in use by {_holder(name)}; wait until that survey has ended, or end it"
                ) from error
            raise RigError(
                f"cannot lock the rig by {name}: {error.strerror}; surveys of a rig need Linux's abstract sockets"
            ) from error
        with suppress(OSError):  # words that are held already
            said = re.sub(r"[^ -~]", "?", f"{words} (process {os.getpid()})")
            _bind(held, f"{name}/{said[: 106 - len(name)]}")  # below the name, for others to read
        yield


def lock_name(port: str) -> str:
    """Return the name of the lock of the rig at a port; two names of one device give one."""
    whole = os.path.realpath(port) if port.startswith("/") else port.lower()
    name = re.sub(r"[^A-Za-z0-9.-]+", "-", whole).strip("-") or "rig"
    if len(name) > _LONGEST_NAME - 17:
        name = f"{name[: _LONGEST_NAME - 34]}-{hashlib.sha256(whole.encode()).hexdigest()[:16]}"
    return f"spectralzoom-rig-{name}"


def _bind(held: ExitStack, name: str) -> None:
    one = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
    one.bind(b"\0" + name.encode())


def _holder(name: str) -> str:
    """Return the words of the survey that holds a name."""
    with suppress(OSError):
        names = re.findall(rf" @{re.escape(name)}/(.+)$", _NAMES.read_text(errors="replace"), re.MULTILINE)
        return str(next(iter(names), "another process"))
    return "another process"
