"""Prefect's server under a schedule, asked by pages of a real browser: its own are answered, nobody else's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from threading import Thread

import pytest

from flows.schedule.guarded_server import OwnPagesOnly, own_origins
from flows.schedule.server import server_for
from pipeline.errors import SettingsError
from tests.soak.prefect_schedule import free_port

CHROMIUM = shutil.which("chromium")
QUIETLY = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--host-resolver-rules=MAP rebound.example 127.0.0.1",
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed: no page can be tried")

# What a page of somebody else tries: to read, to ask for a run, to do so without asking for leave, and by a web socket.
TRIES = """<html><body><script>
const api = "http://127.0.0.1:PORT/api", found = {};
const json = {method: "POST", headers: {"content-type": "application/json"}, body: "{}"};
async function attempt(name, ask) {
  try { const answer = await ask(); found[name] = answer.type == "opaque" ? "opaque" : String(answer.status); }
  catch (error) { found[name] = "refused"; }
}
function socket() {
  return new Promise((done, fail) => {
    const line = new WebSocket("ws://127.0.0.1:PORT/api/events/in");
    line.onopen = () => done({status: "open"}); line.onerror = () => fail();
  });
}
(async () => {
  await attempt("health", () => fetch(api + "/health"));
  await attempt("list", () => fetch(api + "/flow_runs/filter", json));
  await attempt("run", () => fetch(api + "/deployments/name/survey/north", {}));
  await attempt("blind", () => fetch(api + "/work_pools/", {method: "POST", mode: "no-cors", body: '{"name": "x"}'}));
  await attempt("socket", socket);
  await fetch("/", {method: "POST", body: JSON.stringify(found)});
})();
</script></body></html>"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, Path]]:
    """A server as `serve` starts it: its port, and the file of its password."""
    home, port = tmp_path_factory.mktemp("served"), free_port()
    with pytest.MonkeyPatch.context() as patch:
        for name in ("PREFECT_HOME", "PREFECT_SERVER_API_AUTH_STRING"):
            patch.delenv(name)
        with server_for(home, port) as local:
            assert local is not None
            yield port, local.password_file


@pytest.fixture
def stranger(server: tuple[int, Path]) -> Iterator[tuple[str, Queue[dict[str, str]]]]:
    """A page of another port of this machine, and what it has found out."""
    found: Queue[dict[str, str]] = Queue()

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(TRIES.replace("PORT", str(server[0])).encode())

        def do_POST(self) -> None:
            found.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self._answer(b"")

        def _answer(self, content: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *words: object) -> None:
            pass

    pages = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = Thread(target=pages.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{pages.server_port}/", found
    pages.shutdown()
    pages.server_close()
    thread.join()


def browser(address: str, profile: Path, *flags: str) -> list[str]:
    """The command of a browser without a past."""
    assert CHROMIUM is not None
    return [CHROMIUM, *QUIETLY, *flags, f"--user-data-dir={profile}", address]


def browse(address: str, profile: Path) -> str:
    """What a page has become."""
    words = browser(address, profile, "--virtual-time-budget=20000", "--dump-dom")
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False).stdout


def status(port: int, path: str, **headers: str) -> int:
    """How the server answers a request that no browser makes."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


@needs_browser
def test_a_page_of_another_address_gets_nothing(
    server: tuple[int, Path], stranger: tuple[str, Queue[dict[str, str]]], tmp_path: Path
) -> None:
    """It can read nothing, ask for nothing, and what it sends unseen is refused before Prefect sees it."""
    address, told = stranger
    words = browser(address, tmp_path, "--remote-debugging-port=0")
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            found = told.get(timeout=60)
        finally:
            process.terminate()
    assert found == {"health": "refused", "list": "refused", "run": "refused", "blind": "opaque", "socket": "refused"}
    assert status(server[0], "/api/work_pools/", Origin="http://127.0.0.1:1") == 403


@needs_browser
def test_only_the_servers_own_names_are_answered(server: tuple[int, Path], tmp_path: Path) -> None:
    """Its address shows pages that want the password, and so does localhost; a stranger's name for it does not."""
    page = browse(f"http://localhost:{server[0]}/", tmp_path)
    assert "<title>Prefect" in page
    assert "password" in page.lower()
    assert status(server[0], "/") == 200
    assert "Invalid host header" in browse(f"http://rebound.example:{server[0]}/api/health", tmp_path)


def test_who_knows_the_password_is_answered(server: tuple[int, Path]) -> None:
    """It lies in a file that only its owner can read; without it, or from a foreign host, there is no answer."""
    port, file = server
    assert file.stat().st_mode & 0o777 == 0o600
    assert status(port, "/api/health") == 200
    assert status(port, "/api/admin/version") == 401
    assert status(port, "/api/health", Host="rebound.example") == 400
    assert status(port, "/api/health", Origin=f"http://localhost:{port}") == 200
    assert os.environ["PREFECT_API_AUTH_STRING"] == file.read_text().strip()


@pytest.mark.parametrize("kept", ["open to all", "empty", "a link", "a pipe"])
def test_a_password_that_others_may_know_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: str) -> None:
    """One message says which file, why, and that a new one is made when it is gone."""
    for name in ("PREFECT_API_URL", "PREFECT_SERVER_API_AUTH_STRING"):
        monkeypatch.delenv(name, raising=False)
    file = tmp_path / "password"
    if kept == "a pipe":
        os.mkfifo(file, 0o600)
    elif kept == "a link":
        (tmp_path / "other").write_text("spectralzoom:word")
        file.symlink_to(tmp_path / "other")
    else:
        file.write_text("" if kept == "empty" else "spectralzoom:word")
        file.chmod(0o644 if kept == "open to all" else 0o600)
    refused = pytest.raises(SettingsError, match=r"password, the password of Prefect's pages, .*: remove it, a new one")
    with refused, server_for(tmp_path, free_port()):
        pass


@pytest.mark.parametrize(("kind", "sent"), [("http", [403]), ("websocket", [1008])])
@pytest.mark.parametrize("origin", ["http://127.0.0.1:4201", "https://127.0.0.1:4200", "null", "http://a.example"])
def test_origins_are_compared_whole(kind: str, sent: list[int], origin: str) -> None:
    """Another port, scheme or host, and a page without an origin of its own, are somebody else's."""
    import asyncio

    told: list[int] = []

    async def app(scope: object, receive: object, send: object) -> None:
        told.append(200)

    async def send(message: dict[str, object]) -> None:
        told.extend(int(str(message[key])) for key in ("status", "code") if key in message)

    async def receive() -> None:
        """Nothing comes."""

    guard = OwnPagesOnly(app, own_origins(4200))
    for value in (origin, "http://localhost:4200"):
        asyncio.run(guard({"type": kind, "headers": [(b"origin", value.encode())]}, receive, send))
    assert told == [*sent, 200]
