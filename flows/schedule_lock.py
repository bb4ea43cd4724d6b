"""One rig, one survey at a time: a kernel lock on a file named by the rig's port, free when its holder is gone.

A Prefect concurrency limit may show who waits; this lock alone decides.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from flows.settings import Settings
from flows.wall_clock import SystemWallClock, WallClock
from pipeline.errors import RigError
from storage.staging import take_lock

MACHINE_WIDE = Path("/run/lock")
ASK_AGAIN_S = 1.0
A_LOOK = timedelta(seconds=1)


@dataclass
class RigLock:
    """The lock of one rig. Of the simulated rig each archive has its own."""

    path: Path
    _release: Callable[[], None] | None = field(default=None, repr=False)

    @property
    def held(self) -> bool:
        """Whether it is held by this object."""
        return self._release is not None

    def take(self, words: str = "") -> bool:
        """Try to take it, without waiting; ``words`` tell others who holds it.

        Raises
        ------
        RigError : the lock file may not be used.
        """
        if self.held:
            return True
        try:
            self._release = take_lock(self.path, wait=False)
        except OSError as error:
            raise RigError(
                f"cannot use the rig's lock {self.path}: {error.strerror}; it may belong to another user: end that "
                f"user's survey, or remove the file when there is none"
            ) from error
        if self._release is not None:
            with suppress(OSError):  # a full disk keeps nobody from holding it
                self.path.write_text(f"{words or 'a survey'} (process {os.getpid()})\n")
        return self.held

    def wait(self, until: datetime, clock: WallClock, words: str = "") -> bool:
        """Take it, waiting until a moment at most."""
        while not self.take(words):
            if clock.now() >= until:
                return False
            clock.sleep(ASK_AGAIN_S)
        return True

    def take_soon(self, words: str = "") -> bool:
        """Take it now or in a moment: a schedule that only looks whether the rig is free holds it for that long."""
        clock = SystemWallClock()
        return self.wait(clock.now() + A_LOOK, clock, words)

    def release(self) -> None:
        """Let go; harmless where it is not held."""
        release, self._release = self._release, None
        if release is not None:
            release()

    def holder(self) -> str:
        """Who holds it, as far as is known."""
        try:
            return self.path.read_text().strip() or "another process"
        except (OSError, UnicodeDecodeError):
            return "another process"


def rig_lock(settings: Settings, archive: Path) -> RigLock:
    """The lock of the rig that a survey looks through."""
    port = _port(settings)
    if port is None:
        return RigLock(archive / ".locks" / "rig-sim.lock")
    folder = MACHINE_WIDE if os.access(MACHINE_WIDE, os.W_OK) else Path(tempfile.gettempdir())
    return RigLock(folder / f"spectralzoom-rig-{_as_name(port)}.lock")


@contextmanager
def rig_to_oneself(settings: Settings, words: str) -> Iterator[None]:
    """Hold the rig while the block runs; the simulated one needs no holding.

    Raises
    ------
    RigError : another survey holds it.
    """
    if _port(settings) is None:
        yield
        return
    lock = rig_lock(settings, Path())
    if not lock.take_soon(words):
        raise RigError(f"the rig is in use by {lock.holder()}; wait until that survey has ended, or end it")
    try:
        yield
    finally:
        lock.release()


def _port(settings: Settings) -> str | None:
    """Name of the rig's port; None of a source that is no rig."""
    return settings.rig.port if settings.source == "rig" else None


def _as_name(port: str) -> str:
    """A port as part of a file's name; two names of one device are one."""
    whole = os.path.realpath(port) if port.startswith("/") else port
    return re.sub(r"[^A-Za-z0-9.-]+", "-", whole).strip("-") or "rig"
