"""The emulated camera: commands in, replies out, captures of what it looks at, and its sockets.

It speaks the protocol that :mod:`pipeline.rig.camera.headwall_camera` reads; the texts of refusals are made up, since
no document gives them. The files stay in memory; pyftpdlib serves them.
"""

from __future__ import annotations

import io
import itertools
import json
import logging
import socket
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.rig.device_settings import FileServer
from pipeline.rig.emulator import Chunk
from pipeline.rig.transports import Clock, Closing

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Raw = NDArray[np.uint16]

_BLOCK = 8  # frames that are made together, while the camera takes no other request
ROOT = "/captured"
PROMPT = b"\r\nhpi> "
MOST_LINE = 4096
KEPT_CAPTURES = 64  # older ones make room
STARTED_US = 1_500_000_000_000_000  # by the camera's clock at 0 of the emulator's
DELAY_S = 0.01  # from the command to the first exposure


@dataclass
class EmulatedCapture:
    """``frames`` frames from ``began_s`` on, one each period, in one cube."""

    folder: str
    began_s: float
    exposure_s: float
    period_s: float
    frames: int
    wavelength_nm: Sequence[float]
    references: dict[str, Raw] = field(default_factory=dict)  # name -> (frame, sample, band)
    _lines: list[Raw] = field(default_factory=list)
    _taken: int = 0
    _whole: dict[str, bytes] | None = None  # all files, once no frame is to come

    def due(self, now_s: float) -> int:
        """Return how many frames are exposed by now."""
        whole = int(np.floor((now_s - self.began_s - self.exposure_s) / self.period_s + 1e-9)) + 1
        return max(min(whole, self.frames), 0)

    def begins(self, from_s: float, to_s: float) -> Floats:
        """Return when exposures begin (exposure,), from ``from_s`` on and before ``to_s``."""
        bounds = np.ceil((np.array([from_s, to_s]) - self.began_s) / self.period_s - 1e-9).astype(np.int64)
        first, stop = np.clip(bounds, 0, self.frames)
        return np.asarray(self.began_s + np.arange(first, stop) * self.period_s)

    def pending(self, now_s: float) -> Ints:
        """Return the numbers of some of the next frames that are exposed and not taken yet."""
        return np.arange(self._taken, max(min(self._taken + _BLOCK, self.due(now_s)), self._taken))

    def put(self, lines: NDArray[Any]) -> None:
        """Take the next frames, (line, sample, band)."""
        self._lines.append(np.asarray(lines, np.uint16))
        self._taken += len(lines)

    def files(self) -> dict[str, bytes]:
        """Return names, without the folder, and contents of the files taken so far."""
        if self._whole is not None:
            return self._whole
        found: dict[str, bytes] = {"imu_gps.txt": b"Roll\tPitch\tYaw\tLat\tLon\tAlt\tTimestamp\n"}
        for name, frames in self.references.items():
            found |= self._cube(name, frames)
        if self._lines:
            self._lines = [np.concatenate(self._lines)]
            numbers = np.arange(self._taken)
            stamps = STARTED_US + np.rint((self.began_s + numbers * self.period_s) * 1e6).astype(np.int64)
            rows = [f"{number}\t{stamp}\n" for number, stamp in zip(numbers, stamps, strict=True)]
            found |= self._cube("raw_0", self._lines[0])
            found["frameIndex_0.txt"] = "".join(["Frame#\tTimestamp\n", *rows]).encode()
        if self._taken == self.frames:
            self._whole = found
        return found

    def _cube(self, name: str, frames: Raw) -> dict[str, bytes]:
        """Return the files of a cube: its numbers as BIL, and its header."""
        lines, samples, bands = frames.shape
        header = (
            f"ENVI\ninterleave = bil\ndata type = 12\nlines = {lines}\nsamples = {samples}\nbands = {bands}\n"
            "byte order = 0\nheader offset = 0\n"
        )
        if bands and len(self.wavelength_nm) == bands:
            header += "wavelength = {\n" + ",\n".join(f"{value:.17g}" for value in self.wavelength_nm) + "\n}\n"
        return {name: np.ascontiguousarray(frames.transpose(0, 2, 1), "<u2").tobytes(), f"{name}.hdr": header.encode()}


class CameraDevice:
    """One camera. It makes frames when they are asked for.

    ``lines`` gives lines (line, sample, band) uint16 of times (line,) of mid exposure by ``clock``, which may be past.
    """

    def __init__(self, lines: Callable[[Floats], Raw], clock: Clock, *, wavelength_nm: Sequence[float] = ()) -> None:
        self.clock = clock
        self.wavelength_nm = wavelength_nm
        self.exposure_ms, self.period_ms = 10.0, 10.0
        self.captures: list[EmulatedCapture] = []
        self._numbers = itertools.count()
        self._lines = lines
        self._lock = threading.RLock()

    def greet(self) -> list[Chunk]:
        """Return the greeting for a new connection."""
        return [Chunk(0.0, b"Hyperspec control" + PROMPT)]

    def command(self, line: str) -> list[Chunk] | None:
        """Do one command and return its reply, or None where the connection ends."""
        with self._lock:
            if line == "exit":
                return None
            try:
                reply = {"success": True, "response": self._do(line), "errorMessage": ""}
            except RigError as error:
                reply = {"success": False, "response": None, "errorMessage": str(error)}
            return [Chunk(0.0, f"{line}\r\n{json.dumps(reply)}".encode() + PROMPT)]

    def is_capturing(self) -> bool:
        """Return whether a capture runs."""
        return bool(self.captures) and self.captures[-1].due(self.clock.now()) < self.captures[-1].frames

    def files(self) -> dict[str, bytes]:
        """Return all files by their whole names, as they are now."""
        with self._lock:
            self._poll()
            return {f"{one.folder}/{name}": data for one in self.captures for name, data in one.files().items()}

    def keep_looking(self) -> bool:
        """Look at some frames that are over; False where there are none. The lock is free while lines are made."""
        with self._lock:
            waiting = ((one, one.pending(self.clock.now())) for one in self.captures[-2:])
            capture, numbers = next(((one, some) for one, some in waiting if len(some)), (None, np.zeros(0, np.int64)))
        if capture is None:
            return False
        lines = self._lines(capture.began_s + numbers * capture.period_s + capture.exposure_s / 2)
        with self._lock:
            capture.put(lines)
        return True

    def _poll(self) -> None:
        """Look at all frames that are over by now."""
        while self.keep_looking():
            pass

    def _do(self, line: str) -> Any:
        name, _, rest = line.partition("(")
        try:
            argument = json.loads(rest.rstrip().removesuffix(")")) if rest else None
        except ValueError:
            raise RigError(f"argument of {name} is not JSON") from None
        match name.strip():
            case "configure":
                return self._configure(argument)
            case "capture":
                return self._capture(argument)
            case "listFiles":
                return self._list(argument)
            case "isCapturing":
                return self.is_capturing()
            case "stopCapture":
                if runs := self.is_capturing():
                    self.captures[-1].frames = self.captures[-1].due(self.clock.now())
                return runs
        raise RigError(f"unknown command {name}")

    def _configure(self, argument: Any) -> Any:
        if self.is_capturing():
            raise RigError("busy capturing")
        exposure, period = float(argument["exposure"]), float(argument["framePeriod"])
        if not 0 < exposure <= period:
            raise RigError("exposure longer than frame period")
        self.exposure_ms, self.period_ms = exposure, period
        return {"exposure": exposure, "framePeriod": period}

    def _capture(self, argument: Any) -> Any:
        if self.is_capturing():
            raise RigError("busy capturing")
        prefix = f"{argument['prefix']}_" if argument["prefix"] else ""
        self.captures.append(self._begun(f"{ROOT}/{prefix}{next(self._numbers):06d}", argument["maxFramesPerCube"]))
        del self.captures[:-KEPT_CAPTURES]
        return {"folder": self.captures[-1].folder}

    def _begun(self, folder: str, frames: int) -> EmulatedCapture:
        return EmulatedCapture(
            folder,
            began_s=self.clock.now() + DELAY_S,
            exposure_s=self.exposure_ms * 1e-3,
            period_s=self.period_ms * 1e-3,
            frames=frames,
            wavelength_nm=self.wavelength_nm,
        )

    def _list(self, argument: Any) -> list[dict[str, Any]]:
        """List a folder: the root holds the folder of captures, that one holds a folder for each capture."""
        folder = "/" + str(argument or "").strip("/")
        folders = {ROOT, *(capture.folder for capture in self.captures)}
        if folder not in {"/", *folders}:
            raise RigError(f"no such folder {folder}")
        found = [(name, 0, True) for name in folders]
        found += [(name, len(data), False) for name, data in self.files().items()]
        return [
            {"name": name, "size": size, "mtime": 0, "isDirectory": is_folder}
            for name, size, is_folder in sorted(found)
            if (name.rpartition("/")[0] or "/") == folder
        ]


try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # asyncore, which Python 3.11 still has
        from pyftpdlib.authorizers import DummyAuthorizer
        from pyftpdlib.filesystems import AbstractedFS
        from pyftpdlib.handlers import FTPHandler
        from pyftpdlib.ioloop import Acceptor, AsyncChat, IOLoop
        from pyftpdlib.servers import FTPServer
except ImportError as error:
    raise RigError("the emulated camera's files need pyftpdlib; install it: pip install 'pyftpdlib>=2'") from error

_SLICE_S = 0.05  # how soon the thread sees that it is to end
_MOST_READ = 4096  # bytes


class CameraConnection:
    """The camera's end of one connection: cuts bytes into commands at carriage returns."""

    def __init__(self, device: CameraDevice) -> None:
        self._device = device
        self._held = b""

    def feed(self, data: bytes) -> tuple[list[Chunk], bool]:
        """Take bytes; return replies, and whether the connection stays open."""
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


class _Talk(AsyncChat):  # type: ignore[misc]
    """One connection to the control socket, until it says exit or goes away."""

    def __init__(self, connection: socket.socket, device: CameraDevice, ioloop: Any) -> None:
        super().__init__(connection, ioloop=ioloop)
        self._talk = CameraConnection(device)
        self._say(device.greet())

    def handle_read(self) -> None:
        chunks, is_open = self._talk.feed(self.recv(_MOST_READ))
        self._say(chunks)
        if not is_open:
            self.close_when_done()

    def handle_close(self) -> None:
        self.close()

    def _say(self, chunks: list[Chunk]) -> None:
        for chunk in chunks:
            self.push(chunk.data)


class _ControlPort(Acceptor):  # type: ignore[misc]
    """The control socket."""

    def __init__(self, device: CameraDevice, address: tuple[str, int], ioloop: Any) -> None:
        super().__init__(ioloop=ioloop)
        self.device = device
        self.bind_af_unspecified(address)
        self.listen(5)

    def handle_accepted(self, connection: socket.socket, _: Any) -> None:
        _Talk(connection, self.device, self.ioloop)


class CameraServer(Closing):
    """Ports of this machine for a device's control socket and FTP (0: a free one), until ``close``. Also a context."""

    handler: type[FileHandler] | None = None  # of the file server's sessions
    host = "127.0.0.1"

    def __init__(self, device: CameraDevice, ports: tuple[int, int] = (0, 0)) -> None:
        self.device = device
        self._ended = threading.Event()
        logger = logging.getLogger("pyftpdlib")
        logger.setLevel(logging.ERROR)
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())  # else it logs everything on stderr
        authorizer = DummyAuthorizer()
        authorizer.add_user(FileServer.user, FileServer.password, homedir=".", perm="elr")
        attributes = {"device": device, "authorizer": authorizer}
        handler = type("CameraFileHandler", (self.handler or FileHandler,), attributes)
        self._files = FTPServer((self.host, ports[1]), handler, ioloop=IOLoop())
        control = _ControlPort(device, (self.host, ports[0]), self._files.ioloop)
        self.port = int(control.socket.getsockname()[1])
        self.file_port = int(self._files.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True, name="emulated camera")
        self._thread.start()

    def close(self) -> None:
        """Close all connections and both ports."""
        self._ended.set()
        self._thread.join(timeout=10)

    def _serve(self) -> None:
        while not self._ended.is_set():
            self._files.serve_forever(timeout=_SLICE_S, blocking=False)
        self._files.close_all()


class _FilesInMemory(AbstractedFS):  # type: ignore[misc]
    """A device's files by their whole names; the control socket lists them."""

    @property
    def device(self) -> CameraDevice:
        return cast(CameraDevice, self.cmd_channel.device)

    def ftp2fs(self, path: str) -> str:
        return str(self.ftpnorm(path))

    def fs2ftp(self, path: str) -> str:
        return path

    def validpath(self, path: str) -> bool:
        return True

    def realpath(self, path: str) -> str:
        return path

    def isfile(self, path: str) -> bool:
        return path in self.device.files()

    def getsize(self, path: str) -> int:
        return len(self._content(path))

    def open(self, name: str, mode: str) -> io.BytesIO:
        file = io.BytesIO(self._content(name))
        file.name = name  # servers ask for it
        return file

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
