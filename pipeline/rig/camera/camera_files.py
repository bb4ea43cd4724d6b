"""Files of the camera over FTP: fetched in order, continued where an earlier try ended, and every byte read twice.

FTP has no checksums: a file with bytes lost, doubled or inserted can have the right size. Held bytes are therefore read
again and compared before they count, and dropped whole where two readings differ from them. Bytes that the camera
itself gives alike twice cannot be doubted here.
"""

from __future__ import annotations

import ftplib
import logging
import re
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from pipeline.errors import PipelineError, RigError
from pipeline.rig.device_settings import FileServer
from pipeline.rig.transports import SYSTEM_CLOCK, Clock, DeadlinePassed, DeviceGone, DeviceRefused

MOST_REPLY = 1 << 16  # bytes
_SYNTAX = (500, 501)  # of FTP: the server did not understand the words, which may have been damaged on the way
_SIZE = re.compile(r"213 +(\d{1,18})\s*")


class DamagedTransfer(RigError):  # noqa: N818 - the name says what is the case
    """A transfer is no FTP or not the file, as it is where bytes are lost, doubled or put in between: asked again."""


class FileSession(ftplib.FTP):
    """A session that is logged in, see :func:`open_session`."""

    def __init__(self, server: FileServer) -> None:
        super().__init__(timeout=server.stall_s, encoding="utf-8")
        self.server = server
        self._came = b""
        self._until, self._most = 0.0, MOST_REPLY
        self._together = False  # whether replies share a deadline

    def log_in(self) -> None:
        """Connect, greet and log in, all within ``stall_s`` once the server is there."""
        self._together = True
        self.connect(self.server.host, self.server.port)
        self.login(self.server.user, self.server.password)
        self.voidcmd("TYPE I")
        self._together = False

    def size_of(self, name: str) -> int | None:
        """Return the bytes of a file; None where the server does not say.

        Raises DamagedTransfer: its answer is no size.
        """
        said = self.sendcmd(f"SIZE {name}")
        if not said.startswith("213"):
            return None
        found = _SIZE.fullmatch(said)
        if found is None:
            raise DamagedTransfer(
                f"{self.server.where} says that {name} has {said[3:].strip()!r:.100} bytes, expected a number; look "
                "at the file there"
            )
        return int(found[1])

    def pieces(self, name: str, start: int, size: int) -> Generator[bytes]:
        """Return the bytes of a file from ``start`` on, to its end.

        DamagedTransfer where the file continues after ``size`` bytes, or ends before them; DeadlinePassed where less
        than ``least_kb_s`` came.
        """
        reached = start
        with self.transfercmd(f"RETR {name}", start or None) as connection:
            least, gained, waited = 1e3 * self.server.least_kb_s * self.server.stall_s, 0, 0.0
            while True:
                began = time.monotonic()
                connection.settimeout(max(self.server.stall_s - waited, 1e-3))
                try:
                    data = connection.recv(self.server.block)
                except TimeoutError as error:
                    raise DeadlinePassed(self._too_slow(name, gained), silent=not gained) from error
                waited += time.monotonic() - began  # and not what is done with the bytes in between
                if not data:
                    break
                gained, reached = gained + len(data), reached + len(data)
                if reached > size:
                    raise DamagedTransfer(f"{name} goes on after its {size} bytes; is the capture still running?")
                if gained >= least:
                    gained, waited = 0, 0.0
                elif waited >= self.server.stall_s:
                    raise DeadlinePassed(self._too_slow(name, gained))
                yield data
        self.voidresp()
        if reached < size:
            raise DamagedTransfer(f"the transfer of {name} ended at byte {reached} of {size}; look at the file there")

    def makepasv(self) -> tuple[str, int]:
        """Ask where a file can be had."""
        try:
            return super().makepasv()
        except ValueError as error:
            raise ftplib.error_proto(str(error)) from error

    def getresp(self) -> str:
        """Read a reply, within ``stall_s``."""
        if not (self._together and self._until):
            self._until = time.monotonic() + self.server.stall_s
        self._most = MOST_REPLY
        return super().getresp()

    def getline(self) -> str:
        """Read a line of a reply; what is no UTF-8 in it is shown as such."""
        assert self.sock is not None
        while b"\n" not in self._came:
            left = self._until - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self.sock.settimeout(left)
            data = self.sock.recv(4096)
            if not data:
                raise EOFError
            self._came += data
            self._most -= len(data)
            if self._most < 0:
                raise ftplib.error_proto(f"{self._came[:80]!r} and on, more than {MOST_REPLY} bytes")
        self.sock.settimeout(self.server.stall_s)
        line, _, self._came = self._came.partition(b"\n")
        return line.rstrip(b"\r").decode("utf-8", errors="replace")

    @property
    def heard(self) -> str:
        """Return in words how much came of the reply that was waited for last."""
        return f"{MOST_REPLY - self._most} bytes of a reply came" if self._most < MOST_REPLY else "nothing came"

    def _too_slow(self, name: str, gained: int) -> str:
        stall_s = self.server.stall_s
        if not gained:
            return f"{self.server.where} was silent for {stall_s:g} s amid {name}; is it on?"
        return (
            f"{self.server.where} gave {gained} bytes of {name} in {stall_s:g} s, expected "
            f"{self.server.least_kb_s:g} kB a second; look at its network, or set rig.least_kb_s lower"
        )


@contextmanager
def open_session(server: FileServer) -> Iterator[FileSession]:
    """Yield a session that is logged in; its errors are raised as RigError.

    DeviceRefused where the server says no, DamagedTransfer where it speaks no FTP, DeadlinePassed or DeviceGone where
    it is not there.
    """
    session = FileSession(server)
    try:
        session.log_in()
        yield session
        session.close()
    except (PipelineError, GeneratorExit):  # RigErrors are OSErrors too
        raise
    except TimeoutError as error:
        raise DeadlinePassed(
            f"{server.where} was silent for {server.stall_s:g} s, or said too little ({session.heard}); is it on?"
        ) from error
    except ftplib.error_perm as error:
        code = int(str(error)[:3]) if str(error)[:3].isdigit() else None
        if code in _SYNTAX:
            raise DamagedTransfer(f"{server.where} refused: {error!s:.200}; is it an FTP server?") from error
        raise DeviceRefused(
            f"{server.where} refused: {error!s:.200}; look at user and password, and whether the file is there", code
        ) from error
    except ftplib.error_temp as error:
        raise DeviceGone(f"{server.where} broke off: {error!s:.200}") from error
    except ftplib.Error as error:
        raise DamagedTransfer(
            f"{server.where} answered {str(error)!r:.200}, which is no FTP; check host and port"
        ) from error
    except (OSError, EOFError) as error:
        why = str(error) or "connection closed"
        raise DeviceGone(f"{server.where} is not there or went away ({why}); is it on?") from error
    finally:
        session.close()


LOG = logging.getLogger(__name__)
NOT_LOGGED_IN = 530  # of FTP: user or password is not taken, whatever file is asked for
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


def check_remote_name(name: str) -> None:
    """Refuse a name that cannot stand in a line of text, as files are asked for (RigError)."""
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


def fetch_files(
    server: FileServer,
    files: Sequence[RemoteFile],
    kept: Kept,
    progress: Progress | None = None,
    *,
    clock: Clock = SYSTEM_CLOCK,
) -> None:
    """Fetch files one after the other until ``kept`` holds them whole.

    Bytes held from an earlier call are compared before any are added. A transfer that breaks off is taken up again.
    Fetched bytes stay in ``kept`` however this ends, unless they are damaged, and a later call continues there.

    Raises RigError where a file is not the one of which a part is held, is larger than it can be, or comes damaged each
    time; DeviceRefused where the server does not give it, or takes another password; DeadlinePassed or DeviceGone where
    ``server.tries`` tries in a row brought nothing, or all of them took too long.
    """
    for file in files:
        check_remote_name(file.name)
        _Fetch(server, file, kept, progress, clock).run()


def log_in(server: FileServer) -> str:
    """Log in to the server, look at nothing, and give its welcome; DeviceRefused where it takes another password."""
    try:
        with open_session(server) as session:
            return session.getwelcome().removeprefix("220").strip() or "logged in"
    except DamagedTransfer as error:
        raise RigError(str(error)) from error


@dataclass
class _Fetch:
    """One file on its way. The first ``sure`` bytes of those held came alike twice."""

    server: FileServer
    file: RemoteFile
    kept: Kept
    progress: Progress | None
    clock: Clock
    sure: int = 0
    doubted: tuple[int, int] = (-1, 0)  # the first byte that came differently, and how often in a row
    damaged: int = 0
    refused: int = 0

    def __post_init__(self) -> None:
        self.earlier = self.held  # by another call, maybe of another file of that name
        self.began = time.monotonic()

    @property
    def held(self) -> int:
        """Bytes that are kept."""
        return self.kept.size(self.file.name)

    def run(self) -> None:
        """Read until the file is whole and sure, again where a session breaks off."""
        failed = 0
        while True:
            before = (self.held, self.sure)
            try:
                with open_session(self.server) as session:
                    self._go_on(session)
                return
            except (DamagedTransfer, DeadlinePassed, DeviceGone, DeviceRefused) as error:
                failed = 1 if (self.held, self.sure) > before else failed + 1
                self._judge(error, failed)
                LOG.info("%s; going on at byte %d of %s", error, self.held, self.file.name)
                self.clock.sleep(self.server.pause_s)

    def _judge(self, error: RigError, failed: int) -> None:
        """Raise what ends the fetching; nothing where the file may be asked for again."""
        late = time.monotonic() - self.began > self.server.most_s(self.file.size or self.held)
        if isinstance(error, DeviceRefused):
            self.refused += 1
            if self.refused > 1 or late:  # once more: the words may have been damaged on their way there
                raise error
        elif isinstance(error, DamagedTransfer):
            self.damaged += 1
            if self.damaged >= 2 * self.server.tries - 1 or late:  # it may be dropped and begun anew meanwhile
                self._drop(error)
                raise RigError(str(error)) from error
        elif failed >= self.server.tries or late:
            raise type(error)(
                f"{error}; {self.held} bytes of {self.file.name} are kept, and fetching again goes on there"
            ) from error

    def _go_on(self, session: FileSession) -> None:
        size = self._whole_size(session)
        if self.held > size:
            self._drop(
                RigError(
                    f"{self.held} bytes of {self.file.name} are held, the camera's file has {size}: it is another one; "
                    "take what is held away and fetch again"
                )
            )
        self._tell(size)
        if size == 0:
            self.kept.append(self.file.name, b"")
        while self.sure < size:
            held = self.held
            try:
                self._read(session, held, size)
            except DamagedTransfer as error:
                if self.held > held:  # what this reading brought may lie beside its place
                    self._drop(error)
                raise
            self.sure = held if self.server.read_twice else size

    def _read(self, session: FileSession, held: int, size: int) -> None:
        """Read once from where nothing is sure: compare with what is held, and add what is beyond it."""
        at = self.sure if self.server.read_twice else max(held - self.server.overlap, 0)
        with closing(session.pieces(self.file.name, at, size)) as pieces:
            for data in pieces:
                same = min(len(data), max(held - at, 0))
                known = self.kept.read(self.file.name, at, at + same)
                if data[:same] != known:
                    self._differ(at + next(i for i in range(same) if data[i] != known[i]), held)
                if self.server.read_twice:
                    self.sure = max(self.sure, min(at + same, held))
                at += len(data)
                if same < len(data):
                    self.kept.append(self.file.name, data[same:])
                    self._tell(size)

    def _tell(self, size: int) -> None:
        if self.progress is not None:
            self.progress(self.file.name, self.held, size)

    def _differ(self, at: int, held: int) -> None:
        """Doubt this reading where it differs from what is held; where the next one does too, what is held goes."""
        self.doubted = (at, self.doubted[1] + 1 if self.doubted[0] == at else 1)
        if self.doubted[1] > 1 or not self.server.read_twice:
            self._drop(
                RigError(
                    f"the bytes of {self.file.name} before byte {held} differ from those held: it is another file; "
                    "take what is held away and fetch again"
                )
            )
        raise DamagedTransfer(
            f"byte {at} of {self.file.name} came differently each time; look at the network between here and the "
            "camera, then run again"
        )

    def _drop(self, error: RigError) -> None:
        """Hold nothing of the file any more, unless it is of an earlier call and may be of another file: then raise."""
        if self.sure < self.earlier:
            raise RigError(str(error)) from error
        self.kept.drop(self.file.name)
        self.sure = self.earlier = 0

    def _whole_size(self, session: FileSession) -> int:
        """Return the size by the server; where the listing differs, the file still grows."""
        listed, most = self.file.size, self.file.most
        told = session.size_of(self.file.name)
        size = listed if told is None else told
        if size is None:
            raise RigError(f"neither the listing nor SIZE tells how long {self.file.name} is; fetch it by hand")
        if listed is not None and listed != size:
            raise DamagedTransfer(
                f"{self.file.name} has {size} bytes, {listed} when it was listed; is the capture still running? "
                "Fetch when it has ended"
            )
        if most is not None and size > most:
            raise RigError(
                f"{self.file.name} is said to have {size} bytes, expected {most} at most; nothing of it is fetched: "
                "look at what the camera wrote"
            )
        return size
