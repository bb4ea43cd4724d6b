"""Files of the camera over FTP: fetched in order, continued where an earlier try ended, their sizes checked."""

from __future__ import annotations

import ftplib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from pipeline.errors import RigError
from pipeline.rig.clock import SYSTEM_CLOCK, Clock
from pipeline.rig.kept_files import Kept, Progress, RemoteFile
from pipeline.rig.refusals import DeadlinePassed, DeviceGone, DeviceRefused

LOG = logging.getLogger(__name__)
NOT_LOGGED_IN = 530  # of FTP: user or password is not taken, whatever file is asked for


@dataclass(frozen=True)
class FileServer:
    """The camera's FTP server, and how long it is waited for. User and password as public programs use them."""

    host: str = "10.0.65.50"
    port: int = 21
    user: str = "ftpuser"
    password: str = "ftpuser"
    stall_s: float = 10.0  # of silence, after which the server counts as gone
    tries: int = 3  # without a byte gained in between
    pause_s: float = 1.0
    block: int = 1 << 16  # bytes handed over at a time
    overlap: int = 4096  # last bytes held that are fetched again, to see that it is the same file


def fetch_files(
    server: FileServer, files: Sequence[RemoteFile], kept: Kept, progress: Progress | None = None, *,
    clock: Clock = SYSTEM_CLOCK,
) -> None:  # fmt: skip
    """Fetch files one after the other until ``kept`` holds them whole.

    What is held already is continued after a look at its last bytes. A transfer that breaks off is taken up again;
    what has come stays in ``kept`` however this ends, and a later call goes on from there.

    Raises
    ------
    RigError : a file is not the one of which a part is held, or its size is not that of the listing.
    DeviceRefused : the server does not give a file, or takes another password.
    DeadlinePassed, DeviceGone : ``server.tries`` tries in a row brought nothing.
    """
    for file in files:
        _fetch(server, file, kept, progress, clock)


def log_in(server: FileServer) -> str:
    """Log in to the server, look at nothing, and give its welcome.

    Raises
    ------
    DeviceRefused : it takes another password. RigError : no FTP. DeadlinePassed, DeviceGone : it is not there.
    """
    with _session(server) as session:
        return session.getwelcome().removeprefix("220").strip() or "logged in"


def _fetch(server: FileServer, file: RemoteFile, kept: Kept, progress: Progress | None, clock: Clock) -> None:
    failed = 0
    while True:
        held = kept.size(file.name)
        try:
            with _session(server) as session:
                _fetch_once(session, server, file, kept, progress)
            return
        except RigError as error:
            if not isinstance(error, DeadlinePassed | DeviceGone):
                raise
            failed = 0 if kept.size(file.name) > held else failed
            failed += 1
            if failed >= server.tries:
                raise type(error)(
                    f"{error}; {kept.size(file.name)} bytes of {file.name} are kept, and fetching again goes on there"
                ) from error
            LOG.info("%s; going on at byte %d of %s", error, kept.size(file.name), file.name)
            clock.sleep(server.pause_s)


def _fetch_once(
    session: ftplib.FTP, server: FileServer, file: RemoteFile, kept: Kept, progress: Progress | None
) -> None:
    """Bring one file from what is held to its whole size, in one transfer."""
    size = _whole_size(session, file)
    held = kept.size(file.name)
    if held > size:
        raise RigError(
            f"{held} bytes of {file.name} are held, the camera's file has {size}: it is another one; take what is held "
            "away and fetch again"
        )
    start = max(held - server.overlap, 0)
    check = kept.read(file.name, start, held)
    if progress is not None:
        progress(file.name, held, size)
    if size == 0:
        kept.append(file.name, b"")
    if held == size and not check:
        return
    for data in _transfer(session, file.name, start, size, server.block):
        same = min(len(check), len(data))
        if data[:same] != check[:same]:
            raise RigError(
                f"the bytes of {file.name} before byte {held} differ from those held: it is another file; take what is "
                "held away and fetch again"
            )
        check = check[same:]
        if same < len(data):
            kept.append(file.name, data[same:])
            if progress is not None:
                progress(file.name, kept.size(file.name), size)


def _whole_size(session: ftplib.FTP, file: RemoteFile) -> int:
    """Size by the server; the listing must agree, or the file still grows."""
    size = session.size(file.name)
    if size is None:
        size = file.size
    if size is None:
        raise RigError(f"neither the listing nor SIZE tells how long {file.name} is; fetch it by hand")
    if file.size is not None and file.size != size:
        raise RigError(
            f"{file.name} has {size} bytes, {file.size} when it was listed; is the capture still running? "
            "Fetch when it has ended"
        )
    return size


def _transfer(session: ftplib.FTP, name: str, start: int, size: int, block: int) -> Iterator[bytes]:
    """Bytes of a file from ``start`` to its end, and not one beyond ``size``."""
    reached = start
    with session.transfercmd(f"RETR {name}", start or None) as connection:
        while data := connection.recv(block):
            reached += len(data)
            if reached > size:
                raise RigError(f"{name} goes on after its {size} bytes; is the capture still running?")
            yield data
    session.voidresp()
    if reached < size:
        raise DeviceGone(f"the transfer of {name} ended at byte {reached} of {size}")


@contextmanager
def _session(server: FileServer) -> Iterator[ftplib.FTP]:
    """A session that is logged in; what goes wrong inside is told in our words."""
    where = f"the camera's file server {server.host}:{server.port}"
    session = ftplib.FTP(timeout=server.stall_s, encoding="utf-8")
    try:
        session.connect(server.host, server.port)
        session.login(server.user, server.password)
        session.voidcmd("TYPE I")
        yield session
        session.close()
    except TimeoutError as error:
        raise DeadlinePassed(f"{where} was silent for {server.stall_s:g} s; is it on?") from error
    except ftplib.error_perm as error:
        raise DeviceRefused(
            f"{where} refused: {error}; look at user and password, and whether the file is there", _code(error)
        ) from error
    except ftplib.error_temp as error:
        raise DeviceGone(f"{where} broke off: {error}") from error
    except ftplib.Error as error:
        raise RigError(f"{where} answered {str(error)!r:.200}, which is no FTP; check host and port") from error
    except (RigError, GeneratorExit):
        raise
    except (OSError, EOFError) as error:
        why = str(error) or "connection closed"
        raise DeviceGone(f"{where} is not there or went away ({why}); is it on?") from error
    finally:
        session.close()


def _code(error: ftplib.Error) -> int | None:
    digits = str(error)[:3]
    return int(digits) if digits.isdigit() else None
