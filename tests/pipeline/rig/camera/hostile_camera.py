"""A camera that means harm: a file server and a control socket that say what a test wants, as slowly as it wants.

Each is a thread on a free port of this machine. What is said is a list of pieces; a number among them is a pause in
seconds, and a callable gives pieces without end.
"""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

Piece = bytes | float
Pieces = Iterable[Piece] | Callable[[], Iterable[Piece]]
GREETING = b"220 camera\r\n"
REPLIES: dict[str, Pieces] = {
    "USER": [b"331 go on\r\n"],
    "PASS": [b"230 logged in\r\n"],
    "TYPE": [b"200 binary\r\n"],
    "REST": [b"350 from there\r\n"],
    "RETR": [b"150 here it comes\r\n"],
}


def trickled(word: bytes = b"x", pause_s: float = 0.02) -> Callable[[], Iterator[Piece]]:
    """A byte now and then, for ever: never silent, and never done."""
    return lambda: itertools.chain.from_iterable((word, pause_s) for _ in itertools.count())


def flood(word: bytes) -> Callable[[], Iterator[Piece]]:
    """The same words again and again, as fast as they are taken."""
    return lambda: itertools.repeat(word * (65536 // len(word)))


class Hostile:
    """A port where each connection is talked to by :meth:`talk` in a thread; a context that ends them all."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.02)
        self.port = int(self._listener.getsockname()[1])
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> Hostile:
        self._start(self._accept)
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout=10)
        self._listener.close()

    def talk(self, line: socket.socket) -> None:
        """Talk to one client."""
        raise NotImplementedError

    def say(self, line: socket.socket, pieces: Pieces) -> None:
        """Say pieces, until there are no more or the test is over."""
        for piece in pieces() if callable(pieces) else pieces:
            if self._ended.is_set():
                raise OSError
            if isinstance(piece, bytes):
                line.sendall(piece)
            else:
                self._ended.wait(piece)

    def words(self, line: socket.socket) -> Iterator[bytes]:
        """What the client says, as it comes, until it hangs up or the test is over."""
        while not self._ended.is_set():
            with suppress(TimeoutError):
                line.settimeout(0.05)
                data = line.recv(4096)
                line.settimeout(2.0)
                if not data:
                    return
                yield data

    def lines(self, line: socket.socket, end: bytes) -> Iterator[str]:
        """What the client says, up to each line's end."""
        came = b""
        for data in self.words(line):
            came += data
            while end in came:
                said, _, came = came.partition(end)
                yield said.decode(errors="replace")

    def _start(self, run: Callable[..., None], *given: object) -> None:
        self._threads.append(threading.Thread(target=run, args=given, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                line, _ = self._listener.accept()
                self._start(self._talk, line)

    def _talk(self, line: socket.socket) -> None:
        line.settimeout(2.0)
        with line, suppress(OSError):
            self.talk(line)


class HostileFiles(Hostile):
    """A file server: ``says`` are its replies by their command, ``data`` what a transfer brings, then ``end``."""

    def __init__(
        self,
        says: Mapping[str, Pieces] | None = None,
        data: Pieces = (),
        *,
        greeting: Pieces = (GREETING,),
        end: Pieces = (b"226 done\r\n",),
    ) -> None:
        super().__init__()
        self.says, self.data, self.greeting, self.end = {**REPLIES, **(says or {})}, data, greeting, end

    def talk(self, line: socket.socket) -> None:
        """Greet, and answer commands."""
        self.say(line, self.greeting)
        with socket.create_server(("127.0.0.1", 0)) as transfers:
            transfers.settimeout(5)
            port = transfers.getsockname()[1]
            for said in self.lines(line, b"\r\n"):
                name = said.split(" ")[0]
                if name == "PASV":
                    self.say(line, [f"227 here (127,0,0,1,{port >> 8},{port & 255})\r\n".encode()])
                    continue
                self.say(line, self.says.get(name, [b"502 what?\r\n"]))
                if name == "RETR":
                    with transfers.accept()[0] as transfer:
                        transfer.settimeout(2.0)
                        self.say(transfer, self.data)
                    self.say(line, self.end)


@dataclass
class Answers:
    """What the control socket says: its greeting, and replies by their command."""

    greeting: Pieces = (b"hpi> ",)
    says: Mapping[str, Pieces] = field(default_factory=dict)
    usual: Pieces = (b'{"success": true, "response": false, "errorMessage": ""}\r\nhpi> ',)


class HostileControl(Hostile):
    """A control socket with answers of its own."""

    def __init__(self, answers: Answers) -> None:
        super().__init__()
        self.answers = answers

    def talk(self, line: socket.socket) -> None:
        """Greet, and answer commands."""
        self.say(line, self.answers.greeting)
        for said in self.lines(line, b"\r"):
            self.say(line, self.answers.says.get(said.split("(")[0], self.answers.usual))
