"""The way to the emulated camera: its control socket, and its files over FTP, on free ports.

The files stay in memory; pyftpdlib serves them.
"""

from __future__ import annotations

import io
import logging
import os
import socket
import stat
import threading
import warnings
from contextlib import suppress
from typing import Any

from pipeline.errors import RigError
from pipeline.rig.device_settings import FileServer
from pipeline.rig.devices import Closing
from pipeline.rig.emulator import Chunk
from pipeline.rig.emulator.camera_device import MOST_LINE, PROMPT, CameraDevice

try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # asyncore, which Python 3.11 still has
        from pyftpdlib.authorizers import DummyAuthorizer
        from pyftpdlib.filesystems import AbstractedFS
        from pyftpdlib.handlers import FTPHandler
        from pyftpdlib.ioloop import IOLoop
        from pyftpdlib.servers import FTPServer
except ImportError as error:
    raise RigError("the emulated camera's files need pyftpdlib; install it: pip install 'pyftpdlib>=2'") from error

LOG = logging.getLogger(__name__)
_SLICE_S = 0.05  # how soon threads see that they are to end


class CameraConnection:
    """One connection's own half of the talk: its bytes, cut into commands at carriage returns."""

    def __init__(self, device: CameraDevice) -> None:
        self._device = device
        self._held = b""

    def feed(self, data: bytes) -> tuple[list[Chunk], bool]:
        """Take bytes; give replies, and whether the connection goes on."""
        self._held += data
        chunks: list[Chunk] = []
        while (end := self._held.find(b"\r")) >= 0:
            line, self._held = self._held[:end], self._held[end + 1 :].removeprefix(b"\n")
            text = line.decode("utf-8", errors="replace").strip()
            if not text:
                chunks.append(Chunk(0.0, PROMPT))
                continue
            reply = self._device.command(text)
            if reply is None:
                return chunks, False
            chunks += reply
        return chunks, len(self._held) <= MOST_LINE


class CameraServer(Closing):
    """Both ports of a device, of its control socket and of FTP (0 takes a free one), until ``close``. Also a context.

    RigError where a port is taken.
    """

    handler: type[FileHandler] | None = None  # of the file server's sessions

    def __init__(self, device: CameraDevice, *, host: str = "127.0.0.1", port: int = 0, file_port: int = 0) -> None:
        self.device = device
        self.host = host
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise RigError(
                f"{host}:{port} cannot be listened on ({error}); take another port, or 0 for a free one"
            ) from error
        try:
            self._files = _file_server(device, (host, file_port), self.handler or FileHandler)
        except BaseException:
            self._listener.close()
            raise
        self._listener.settimeout(_SLICE_S)
        self.port = int(self._listener.getsockname()[1])
        self.file_port = int(self._files.socket.getsockname()[1])
        for serve in (self._serve_control, self._serve_files):
            self._start(serve)

    def close(self) -> None:
        """Hang up on everyone, and let go of the ports."""
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=10)
        self._listener.close()

    def _start(self, serve: Any, *arguments: Any) -> None:
        thread = threading.Thread(target=serve, args=arguments, daemon=True, name="emulated camera")
        self._threads.append(thread)
        thread.start()

    def _serve_control(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                self._start(self._talk, self._listener.accept()[0])

    def _talk(self, connection: socket.socket) -> None:
        """One client, until it says exit, goes away, or the server closes."""
        talk = CameraConnection(self.device)
        with connection, suppress(OSError):
            connection.settimeout(_SLICE_S)
            chunks, goes_on = self.device.greet(), True
            while goes_on and not self._ended.is_set():
                for chunk in chunks:
                    self._wait(chunk.delay_s)
                    connection.sendall(chunk.data)
                chunks = []
                with suppress(TimeoutError):
                    data = connection.recv(4096)
                    if not data:
                        return
                    chunks, goes_on = talk.feed(data)
            for chunk in chunks:
                connection.sendall(chunk.data)

    def _wait(self, seconds: float) -> None:
        """Let the device's time pass, unless the server closes."""
        clock = self.device.clock
        until = clock.now() + seconds
        while not self._ended.is_set() and (left := until - clock.now()) > 0:
            clock.sleep(min(left, _SLICE_S * getattr(clock, "speed", 1.0)))

    def _serve_files(self) -> None:
        while not self._ended.is_set():
            self._files.serve_forever(timeout=_SLICE_S, blocking=False)
        self._files.close_all()


def _file_server(device: CameraDevice, address: tuple[str, int], kind: type[FileHandler]) -> FTPServer:
    chatter = logging.getLogger("pyftpdlib")
    chatter.setLevel(logging.ERROR)
    if not chatter.handlers:
        chatter.addHandler(logging.NullHandler())  # else it turns itself up to everything, on stderr
    authorizer = DummyAuthorizer()
    authorizer.add_user(FileServer.user, FileServer.password, homedir=".", perm="elr")
    handler = type("CameraFileHandler", (kind,), {"device": device, "authorizer": authorizer})
    try:
        return FTPServer(address, handler, ioloop=IOLoop())
    except OSError as error:
        raise RigError(f"{address[0]}:{address[1]} cannot be listened on ({error}); take another port") from error


class _FilesInMemory(AbstractedFS):  # type: ignore[misc]
    """A device's files as a read-only file system."""

    @property
    def device(self) -> CameraDevice:
        device: CameraDevice = self.cmd_channel.device
        return device

    def ftp2fs(self, path: str) -> str:
        return str(self.ftpnorm(path))

    def fs2ftp(self, path: str) -> str:
        return path

    def validpath(self, path: str) -> bool:
        return True

    def realpath(self, path: str) -> str:
        return path

    def chdir(self, path: str) -> None:
        self.cwd = path

    def isfile(self, path: str) -> bool:
        return path in self.device.files()

    def isdir(self, path: str) -> bool:
        return path in self.device.folders()

    def lexists(self, path: str) -> bool:
        return self.isfile(path) or self.isdir(path)

    def getsize(self, path: str) -> int:
        return len(self._content(path))

    def open(self, name: str, mode: str) -> io.BytesIO:
        file = io.BytesIO(self._content(name))
        file.name = name  # servers ask for it
        return file

    def listdir(self, path: str) -> list[str]:
        under = path.rstrip("/") + "/"
        every = [*self.device.files(), *self.device.folders()]
        return sorted({name[len(under) :].split("/")[0] for name in every if name.startswith(under) and name != under})

    def stat(self, path: str) -> Any:
        mode = stat.S_IFDIR | 0o555 if self.isdir(path) else stat.S_IFREG | 0o444
        size = 0 if self.isdir(path) else self.getsize(path)
        return os.stat_result((mode, 0, 0, 1, 0, 0, size, 0, 0, 0))

    lstat = stat

    def _content(self, path: str) -> bytes:
        try:
            return self.device.files()[path]
        except KeyError:
            raise FileNotFoundError(2, "No such file", path) from None


class FileHandler(FTPHandler):  # type: ignore[misc]
    """A session of the file server."""

    device: CameraDevice
    abstracted_fs = _FilesInMemory
    use_sendfile = False
    auth_failed_timeout = 0
    banner = "emulated camera"
