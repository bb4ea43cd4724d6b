"""A session with the camera's file server whose replies and transfers have an end, whatever the server does.

ftplib waits for each piece of a reply or a file anew, so a server that sends a byte now and then would hold it for
ever, and one that never ends its line would fill the memory. Here a reply has a deadline and a length, logging in has
one deadline as a whole, and a transfer has a least rate.
"""

from __future__ import annotations

import ftplib
import re
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager

from pipeline.errors import PipelineError, RigError
from pipeline.rig.device_settings import FileServer
from pipeline.rig.devices import DeadlinePassed, DeviceGone, DeviceRefused

MOST_REPLY = 1 << 16  # bytes
_SYNTAX = (500, 501)  # of FTP: the server did not understand the words, which may have been damaged on the way
_SIZE = re.compile(r"213 +(\d{1,18})\s*")


class DamagedTransfer(RigError):  # noqa: N818 - the name says what is the case
    """What came is no FTP or not the file, as it is where bytes are lost, doubled or put in between: asked again."""


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
        """Bytes of a file; None where the server does not say, DamagedTransfer where its answer is no size."""
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
        """Give the bytes of a file from ``start`` on, to its end.

        DamagedTransfer where the file goes on after ``size`` bytes, or ends before them; DeadlinePassed where less than
        ``least_kb_s`` came.
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
        """What came of the reply that was waited for last."""
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
    """A session that is logged in; what goes wrong inside is told in our words.

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
