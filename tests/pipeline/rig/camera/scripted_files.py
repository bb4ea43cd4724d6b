"""A file server on this machine that says what the camera's FTP server says, and breaks off where a test wants."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import pytest

from spectralzoom.pipeline.rig.camera import camera_files
from spectralzoom.pipeline.rig.device_settings import FileServer


@dataclass
class ScriptedFiles:
    """Files by whole names. ``cuts`` has the bytes of the next transfers before they break off; None: whole.

    ``refusals`` connections are closed before a word; ``stated`` replaces the size of a file.
    """

    files: dict[str, bytes]
    cuts: list[int | None] = field(default_factory=list)
    refusals: int = 0
    stated: dict[str, int] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)

    def session(self, control: socket.socket) -> None:
        """Answer one session, until it ends or breaks off."""
        if self.refusals:
            self.refusals -= 1
            return
        start, listener, lines = 0, socket.create_server(("127.0.0.1", 0)), control.makefile("r", newline="\r\n")

        def say(text: str) -> None:
            control.sendall(f"{text}\r\n".encode())

        say("220 scripted camera")
        with listener, lines:
            for line in lines:
                word, _, rest = line.strip().partition(" ")
                self.said.append(line.strip())
                match word:
                    case "USER":
                        say("331 password")
                    case "PASS":
                        say("230 in" if rest == FileServer.password else "530 no")
                    case "SIZE" if rest in self.files:
                        say(f"213 {self.stated.get(rest, len(self.files[rest]))}")
                    case "REST":
                        start = int(rest)
                        say("350 there")
                    case "PASV":
                        high, low = divmod(listener.getsockname()[1], 256)
                        say(f"227 Entering Passive Mode (127,0,0,1,{high},{low})")
                    case "RETR" if rest in self.files:
                        say("150 here")
                        if not self._send(listener, self.files[rest][start:]):
                            return
                        start = 0
                        say("226 done")
                    case "SIZE" | "RETR":
                        say("550 no such file")
                    case _:
                        say("200 well")

    def _send(self, listener: socket.socket, data: bytes) -> bool:
        cut = self.cuts.pop(0) if self.cuts else None
        with listener.accept()[0] as peer:
            peer.sendall(data if cut is None else data[:cut])
        return cut is None


@contextmanager
def served(files: ScriptedFiles) -> Iterator[FileServer]:
    """Serve files for the block with short timeouts, and yield the server's address."""
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.MonkeyPatch.context() as patched:
        patched.setattr(camera_files, "STALL_S", 2.0)
        patched.setattr(camera_files, "PAUSE_S", 0.01)

        def serve() -> None:
            with suppress(OSError):
                while True:
                    with server.accept()[0] as control, suppress(OSError):
                        files.session(control)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield FileServer("127.0.0.1", server.getsockname()[1])
        server.shutdown(socket.SHUT_RDWR)
    thread.join(5)
