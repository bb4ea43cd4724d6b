"""Lock the rig for one survey at a time, by its port; the kernel releases the lock when its process ends.

The lock is an abstract socket of Linux (unix(7)): it needs no file, and is the same for all users of the machine. It
belongs to the network namespace of the process. Drivers also lock a serial port itself.
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

_LONGEST_NAME = 60  # of the 107 bytes of a socket name; the rest describes the holder
_NAMES = Path("/proc/net/unix")


@contextmanager
def rig_to_oneself(port: str, holder: str) -> Iterator[None]:
    """Lock the rig at a port for the block; ``holder`` describes the survey.

    Raises RigError: another survey has the lock, or the kernel does not support it.
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
        with suppress(OSError):  # the description is in use
            text = re.sub(r"[^ -~]", "?", f"{holder} (process {os.getpid()})")
            _bind(held, f"{name}/{text[: 106 - len(name)]}")  # for messages of other surveys
        yield


def lock_name(port: str) -> str:
    """Return the name of the lock of the rig at a port, the same for all names of one device."""
    whole = os.path.realpath(port) if port.startswith("/") else port.lower()
    name = re.sub(r"[^A-Za-z0-9.-]+", "-", whole).strip("-") or "rig"
    if len(name) > _LONGEST_NAME - 17:
        name = f"{name[: _LONGEST_NAME - 34]}-{hashlib.sha256(whole.encode()).hexdigest()[:16]}"
    return f"spectralzoom-rig-{name}"


def _bind(held: ExitStack, name: str) -> None:
    one = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
    one.bind(b"\0" + name.encode())


def _holder(name: str) -> str:
    """Return the description of the survey that has the lock."""
    with suppress(OSError):
        names = re.findall(rf" @{re.escape(name)}/(.+)$", _NAMES.read_text(errors="replace"), re.MULTILINE)
        return str(next(iter(names), "another process"))
    return "another process"
