"""An HTTP proxy on loopback that breaks requests on their way to a server, as a bad network and a busy server do."""

from __future__ import annotations

import http.client
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from time import sleep
from urllib.parse import urlsplit

ANSWERS = {  # answered without asking the server
    "500": (500, b"<Error><Code>InternalError</Code></Error>"),
    "503": (503, b"<Error><Code>SlowDown</Code></Error>"),
    "429": (429, b""),
    "timeout": (400, b"<Error><Code>RequestTimeout</Code></Error>"),
    "conflict": (409, b"<Error><Code>ConditionalRequestConflict</Code></Error>"),
}
# the server is not asked, it is asked and its answer is lost, half of the answer comes, one bit of it is another
FAULTS = ("reset", *ANSWERS, "lost", "cut", "short", "unsized", "flip")
Choose = Callable[[str, str], str | None]  # a fault or None, from method and path


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Proxy

    def handle_one_request(self) -> None:
        self.raw_requestline = self.rfile.readline(65537)
        if not self.raw_requestline or not self.parse_request():
            self.close_connection = True
            return
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        fault = self.server.choose(self.command, self.path)
        if fault == "stall":
            sleep(STALLED_S)
            self.close_connection = True
        elif fault == "reset":
            self._reset()
        elif fault in ANSWERS:
            status, text = ANSWERS[fault]
            self._answer(status, {"Content-Length": str(len(text))}, text)
        else:
            self._pass_on(body, fault)

    def _pass_on(self, body: bytes, fault: str | None) -> None:
        if fault == "unconditional":
            del self.headers["If-None-Match"]
            fault = None
        upstream = http.client.HTTPConnection(self.server.upstream, timeout=30)
        upstream.request(self.command, self.path, body, dict(self.headers))
        answer = upstream.getresponse()
        content = answer.read()
        upstream.close()
        headers = {name: value for name, value in answer.headers.items() if name.lower() not in _OWN}
        if self.command != "HEAD":
            headers["Content-Length"] = str(len(content))
        if fault is None or (fault != "lost" and not content):
            self._answer(answer.status, headers, content)
        elif fault == "lost":
            self._reset()
        elif fault == "flip":
            self._answer(answer.status, headers, content[:-1] + bytes([content[-1] ^ 1]))
        else:
            if fault == "unsized":
                headers.pop("Content-Length")
            self._answer(answer.status, headers | {"Connection": "close"}, content[: len(content) // 2])
            if fault == "cut":
                self._reset()

    def _answer(self, status: int, headers: dict[str, str], content: bytes) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
        self.wfile.flush()

    def _reset(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()
        self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


STALLED_S = 60.0  # without an answer, on an open connection
_OWN = ("content-length", "connection", "transfer-encoding", "keep-alive")


class _Proxy(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, upstream: str, choose: Choose) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.upstream, self.choose = urlsplit(upstream).netloc, choose

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of clients that went."""


@contextmanager
def faulty_proxy(upstream: str, choose: Choose) -> Iterator[str]:
    """Yield the address of a proxy before ``upstream``, which breaks the requests that ``choose`` selects."""
    with _Proxy(upstream, choose) as proxy:
        thread = Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{proxy.server_port}"
        proxy.shutdown()
        thread.join()
