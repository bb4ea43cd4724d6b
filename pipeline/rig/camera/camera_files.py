"""Files of the camera over FTP: fetched in order, and continued where an earlier try ended."""

from __future__ import annotations

import ftplib
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from spectralzoom.pipeline.errors import PipelineError, RigError
from spectralzoom.pipeline.rig.device_settings import FileServer
from spectralzoom.pipeline.rig.transports import SYSTEM_CLOCK, Clock, DeviceGone, DeviceRefused

LOG = logging.getLogger(__name__)
NOT_LOGGED_IN = 530  # of FTP: the user or the password is refused
OVERLAP = 4096  # last bytes held that are fetched again, to see that it is the same file
BLOCK = 1 << 16  # bytes
STALL_S = 10.0  # longest silence before a transfer is continued anew
TRIES = 3  # in a row that bring no byte
PAUSE_S = 1.0  # between them
Progress = Callable[[str, int, int], None]  # file, bytes held, bytes in all


@dataclass(frozen=True)
class RemoteFile:
    """A file in a listing."""

    name: str  # whole path
    size: int | None  # bytes; None where the camera does not say

    @property
    def base(self) -> str:
        """The name without its folder."""
        return self.name.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class Capture:
    """A capture that the camera acknowledged."""

    folder: str
    sent_s: float  # when the command was sent, by the clock of the rig's drivers
    acknowledged_s: float  # when its reply was complete: exposures began between the two, or soon after


class Kept(Protocol):
    """Store of fetched bytes: files named as on the camera, of which a part may be there already."""

    def size(self, name: str) -> int:
        """Return the number of bytes held of a file; 0 of one that is not there."""

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return some of the bytes held."""

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end."""


@dataclass
class KeptInMemory:
    """Files held in memory, for tests and for captures that fit."""

    files: dict[str, bytearray] = field(default_factory=dict)

    def size(self, name: str) -> int:
        return len(self.files.get(name, b""))

    def read(self, name: str, start: int, stop: int) -> bytes:
        return bytes(self.files.get(name, bytearray())[start:stop])

    def append(self, name: str, data: bytes) -> None:
        self.files.setdefault(name, bytearray()).extend(data)


@contextmanager
def open_session(server: FileServer) -> Iterator[ftplib.FTP]:
    """Yield a session that is logged in; its errors are raised as RigError.

    Raises DeviceRefused where the server refuses, DeviceGone where it does not answer, or not as an FTP server.
    """
    session = ftplib.FTP(timeout=STALL_S, encoding="utf-8")
    try:
        session.connect(server.host, server.port)
        session.login(server.user, server.password)
        session.voidcmd("TYPE I")
        yield session
    except PipelineError:  # RigErrors are OSErrors too
        raise
    except ftplib.error_perm as error:
        code = int(str(error)[:3]) if str(error)[:3].isdigit() else None
        raise DeviceRefused(
            f"{server.where} refused: {error!s:.200}; look at user and password, and whether the file is there", code
        ) from error
    except (ftplib.Error, OSError, EOFError, ValueError) as error:
        reason = str(error)[:200] or "connection closed"
        raise DeviceGone(
            f"{server.where} is not there, fell silent or is no FTP server ({reason!r}); is it on, and are host and "
            "port right?"
        ) from error
    finally:
        session.close()


def log_in(server: FileServer) -> str:
    """Log in to the server and return its welcome; DeviceRefused where it refuses the password."""
    with open_session(server) as session:
        return session.getwelcome().removeprefix("220").strip() or "logged in"


def fetch_files(
    server: FileServer,
    files: Sequence[RemoteFile],
    kept: Kept,
    progress: Progress | None = None,
    *,
    clock: Clock = SYSTEM_CLOCK,
) -> None:
    """Fetch files one after the other until ``kept`` holds them whole.

    A transfer that breaks off is continued, in a later call too. The last bytes held from before are compared with the
    camera's. Raises RigError where they differ or a file grows; DeviceRefused where the server refuses it; DeviceGone
    where TRIES tries in a row brought no byte.
    """
    for file in files:
        failed = 0
        while True:
            before = kept.size(file.name)
            try:
                with open_session(server) as session:
                    _transfer(session, file, kept, progress)
                break
            except DeviceGone as error:
                held = kept.size(file.name)
                failed = 1 if held > before else failed + 1
                if failed >= TRIES:
                    raise DeviceGone(
                        f"{error}; {held} bytes of {file.name} are kept, and a later fetch continues there"
                    ) from error
                LOG.info("%s; continuing at byte %d of %s", error, held, file.name)
                clock.sleep(PAUSE_S)


def _transfer(session: ftplib.FTP, file: RemoteFile, kept: Kept, progress: Progress | None) -> None:
    """Read once from shortly before the end of the held bytes: compare with those, and add the rest."""
    name = file.name
    size = session.size(name)
    held = kept.size(name)
    if size is None or file.size not in (None, size):
        raise RigError(f"{name} has {size} bytes, {file.size} when it was listed; fetch it when the capture has ended")
    another = RigError(f"the {held} bytes of {name} that are held are of another file; remove them and fetch again")
    if held > size:
        raise another
    at, total = max(held - OVERLAP, 0), size
    if not total:
        kept.append(name, b"")

    def take(data: bytes) -> None:
        nonlocal at
        same = min(len(data), max(held - at, 0))
        if data[:same] != kept.read(name, at, at + same):
            raise another
        at += len(data)
        if at > total:
            raise RigError(f"{name} has more than its {total} bytes; fetch it when the capture has ended")
        if same < len(data):
            kept.append(name, data[same:])
            if progress is not None:
                progress(name, at, total)

    if total:
        session.retrbinary(f"RETR {name}", take, BLOCK, rest=at or None)
    if at < total:
        raise DeviceGone(f"the transfer of {name} ended at byte {at} of {total}; look at the file there")
