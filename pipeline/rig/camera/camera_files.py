"""Files of the camera over FTP: fetched in order, and continued where an earlier try ended."""

from __future__ import annotations

import ftplib
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from pipeline.errors import PipelineError, RigError
from pipeline.rig.device_settings import FileServer
from pipeline.rig.transports import SYSTEM_CLOCK, Clock, DeadlinePassed, DeviceGone, DeviceRefused

LOG = logging.getLogger(__name__)
NOT_LOGGED_IN = 530  # of FTP: the user or the password is refused
OVERLAP = 4096  # last bytes held that are fetched again, to see that it is the same file
_BLOCK = 1 << 16  # bytes
_UNFIT = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
Progress = Callable[[str, int, int], None]  # file, bytes held, bytes in all


@dataclass(frozen=True)
class RemoteFile:
    """An entry of a listing."""

    name: str  # whole path
    size: int | None  # bytes; None where the camera does not say
    folder: bool
    most: int | None = None  # bytes that it can have; None where nothing is known

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


@dataclass(frozen=True)
class FrameClaim:
    """The size of a capture: frames, in all its files, of ``samples`` x ``bands`` numbers of 16 bits."""

    frames: int
    samples: int
    bands: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 2 * self.samples * self.bands


def check_remote_name(name: str) -> None:
    """Raise RigError for a name that cannot stand in a line of text, as the protocols need."""
    if _UNFIT.search(name):
        raise RigError(
            f"the camera names a file {name!r:.200}, expected no line ends or control characters in a name; give it "
            "another name there"
        )


class Kept(Protocol):
    """Store of fetched bytes: files named as on the camera, of which a part may be there already."""

    def size(self, name: str) -> int:
        """Return the number of bytes held of a file; 0 of one that is not there."""

    def read(self, name: str, start: int, stop: int) -> bytes:
        """Return some of the bytes held."""

    def append(self, name: str, data: bytes) -> None:
        """Add bytes at the end."""

    def drop(self, name: str) -> None:
        """Hold no byte of a file any more."""


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

    def drop(self, name: str) -> None:
        self.files.pop(name, None)


@contextmanager
def open_session(server: FileServer) -> Iterator[ftplib.FTP]:
    """Yield a session that is logged in; its errors are raised as RigError.

    Raises DeviceRefused where the server refuses, RigError where it speaks no FTP, DeadlinePassed or DeviceGone where
    it does not answer.
    """
    session = ftplib.FTP(timeout=server.stall_s, encoding="utf-8")
    try:
        session.connect(server.host, server.port)
        session.login(server.user, server.password)
        session.voidcmd("TYPE I")
        yield session
    except PipelineError:  # RigErrors are OSErrors too
        raise
    except TimeoutError as error:
        raise DeadlinePassed(f"{server.where} was silent for {server.stall_s:g} s; is it on?") from error
    except ftplib.error_perm as error:
        code = int(str(error)[:3]) if str(error)[:3].isdigit() else None
        raise DeviceRefused(
            f"{server.where} refused: {error!s:.200}; look at user and password, and whether the file is there", code
        ) from error
    except (ftplib.error_proto, ftplib.error_reply, ValueError) as error:
        raise RigError(f"{server.where} answered {str(error)!r:.200}, which is no FTP; check host and port") from error
    except (ftplib.Error, OSError, EOFError) as error:
        reason = str(error) or "connection closed"
        raise DeviceGone(f"{server.where} is not there or went away ({reason}); is it on?") from error
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
    camera's. Raises RigError where they differ or a file is larger than it can be; DeviceRefused where the server
    refuses it; DeadlinePassed or DeviceGone where ``server.tries`` tries in a row brought no byte.
    """
    for file in files:
        check_remote_name(file.name)
        _fetch(server, file, kept, progress, clock)


def _fetch(server: FileServer, file: RemoteFile, kept: Kept, progress: Progress | None, clock: Clock) -> None:
    """Fetch one file, again where a session breaks off."""
    failed = 0
    while True:
        before = kept.size(file.name)
        try:
            with open_session(server) as session:
                _transfer(session, file, kept, progress)
            return
        except (DeadlinePassed, DeviceGone) as error:
            held = kept.size(file.name)
            failed = 1 if held > before else failed + 1
            if failed >= server.tries:
                raise type(error)(
                    f"{error}; {held} bytes of {file.name} are kept, and a later fetch continues there"
                ) from error
            LOG.info("%s; continuing at byte %d of %s", error, held, file.name)
            clock.sleep(server.pause_s)


def _transfer(session: ftplib.FTP, file: RemoteFile, kept: Kept, progress: Progress | None) -> None:
    """Read once from shortly before the end of the held bytes: compare with those, and add the rest."""
    name, size, held = file.name, _whole_size(session, file), kept.size(file.name)
    another = RigError(f"the {held} bytes of {name} that are held are of another file; remove them and fetch again")
    if held > size:
        raise another
    if size == 0:
        kept.append(name, b"")
        return
    at = max(held - OVERLAP, 0)
    with session.transfercmd(f"RETR {name}", at or None) as connection:
        while data := connection.recv(_BLOCK):
            same = min(len(data), max(held - at, 0))
            if data[:same] != kept.read(name, at, at + same):
                raise another
            at += len(data)
            if at > size:
                raise RigError(f"{name} has more than its {size} bytes; fetch it when the capture has ended")
            if same < len(data):
                kept.append(name, data[same:])
                if progress is not None:
                    progress(name, at, size)
    session.voidresp()
    if at < size:
        raise DeviceGone(f"the transfer of {name} ended at byte {at} of {size}; look at the file there")


def _whole_size(session: ftplib.FTP, file: RemoteFile) -> int:
    """Return the size by the server; RigError where the listing differs, or it is more than the file can have."""
    stated = session.size(file.name)
    size = file.size if stated is None else stated
    if size is None:
        raise RigError(f"neither the listing nor SIZE gives the size of {file.name}; fetch it by hand")
    if file.size not in (None, size):
        raise RigError(
            f"{file.name} has {size} bytes, {file.size} when it was listed; fetch it when the capture has ended"
        )
    if file.most is not None and size > file.most:
        raise RigError(
            f"{file.name} has {size} bytes, expected {file.most} at most, and nothing of it is fetched; look at what "
            "the camera wrote"
        )
    return size
