"""A chaotic line between drivers and an emulated camera: bytes put in, doubled and cut out, on each of its connections.

It stands before the control socket, FTP's control connection and each of FTP's transfers, in both directions. A seed
says where it strikes; with ``calm`` it hands on what it gets.
"""

from __future__ import annotations

import re
import socket
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Kind = Literal["insert", "double", "cut"]
OFTEN = (4000.0, 20_000.0)
_PASSIVE = re.compile(rb"227 [^(]*\((\d+,\d+,\d+,\d+),(\d+),(\d+)\)")


@dataclass
class Mangler:
    """Changes a stream about every ``every`` bytes, by up to ``most`` of them at a time."""

    rng: np.random.Generator
    every: float
    kinds: tuple[Kind, ...] = ("insert", "double", "cut")
    most: int = 16
    strikes: int = 0
    _left: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self._left = self.rng.exponential(self.every)

    def feed(self, data: bytes) -> bytes:
        """What becomes of some bytes."""
        said = b""
        while self._left < len(data):
            at = int(self._left)
            count = int(self.rng.integers(1, self.most + 1))
            kind = self.kinds[int(self.rng.integers(len(self.kinds)))]
            said += data[:at]
            if kind == "insert":
                said += self.rng.bytes(count)
            elif kind == "double":
                said += data[max(at - count, 0) : at]
            else:
                at = min(at + count, len(data))
            data = data[at:]
            self._left = self.rng.exponential(self.every)
            self.strikes += 1
        self._left -= len(data)
        return said + data


class ChaosLine:
    """Ports that stand before a camera's control socket and file server; a context.

    ``every`` are bytes between two strikes, on control connections and on transfers.
    """

    def __init__(self, port: int, file_port: int, seed: int, *, every: tuple[float, float] = OFTEN) -> None:
        self.calm = False
        self.every = every
        self._rng = np.random.default_rng(seed)
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []
        self._manglers: list[Mangler] = []
        self.port = self._before(port, files=False)
        self.file_port = self._before(file_port, files=True)

    def __enter__(self) -> ChaosLine:
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=10)

    @property
    def strikes(self) -> int:
        """How often bytes were changed."""
        return sum(one.strikes for one in self._manglers)

    def strike(self, seed: int, every: tuple[float, float]) -> None:
        """Begin to strike, with other numbers, on connections from now on."""
        self.calm, self.every, self._rng = False, every, np.random.default_rng(seed)

    def _before(self, port: int, *, files: bool, once: bool = False) -> int:
        """Listen on a port of our own for those who want that port."""
        listener = socket.create_server(("127.0.0.1", 0))
        listener.settimeout(0.02)
        self._start(self._accept, listener, port, files, once)
        return int(listener.getsockname()[1])

    def _start(self, run: object, *given: object) -> None:
        thread = threading.Thread(target=run, args=given, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket, port: int, files: bool, once: bool) -> None:
        with listener:
            while not self._ended.is_set():
                with suppress(TimeoutError):
                    client = listener.accept()[0]
                    try:
                        camera = socket.create_connection(("127.0.0.1", port), timeout=5)
                    except OSError:
                        client.close()
                        continue
                    for end in (client, camera):
                        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    every = self.every[once]
                    self._start(self._hand_on, client, camera, every, False)
                    self._start(self._hand_on, camera, client, every, files)
                    if once:
                        return

    def _hand_on(self, source: socket.socket, target: socket.socket, every: float, tells_ports: bool) -> None:
        """Bytes of one direction, until either end hangs up; a transfer that is told of goes through a port of ours."""
        mangler = Mangler(self._rng.spawn(1)[0], every)
        self._manglers.append(mangler)
        source.settimeout(0.05)
        with suppress(OSError):
            while not self._ended.is_set():
                with suppress(TimeoutError):
                    data = source.recv(65536)
                    if not data:
                        break
                    if tells_ports:
                        data = _PASSIVE.sub(self._ours, data)
                    target.sendall(data if self.calm else mangler.feed(data))
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        source.close()

    def _ours(self, said: re.Match[bytes]) -> bytes:
        port = self._before(int(said[2]) << 8 | int(said[3]), files=False, once=True)
        return b"227 here (127,0,0,1,%d,%d)" % (port >> 8, port & 255)
