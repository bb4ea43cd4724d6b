"""Prefect's server in this process: who may use it, its files, and its initial database."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from spectralzoom.flows.local_server import (
    ServerUnavailable,
    check_tables,
    copy_tables,
    local_server,
    private_files,
    silence_of,
)

FOREIGN = "http://evil.example"


def test_a_server_without_a_place_for_its_database_is_unavailable(tmp_path: Path) -> None:
    """This happens on a full disk; surveys then run without a server."""
    (tmp_path / "home").write_text("a file")
    with pytest.raises(ServerUnavailable, match="cannot use its folder"), local_server(tmp_path / "home"):
        pass


def test_an_empty_password_is_replaced(tmp_path: Path) -> None:
    """A full disk leaves an empty file, which would let everybody in."""
    (tmp_path / "password").touch()
    first = private_files(tmp_path)
    assert len(first.removeprefix("spectralzoom:")) >= 32
    assert private_files(tmp_path) == first


def test_signs_in_the_path_are_no_query(tmp_path: Path) -> None:
    """The database is in that folder, and a file with the name before the mark is unchanged."""
    (tmp_path / "field").write_text("mine")
    with local_server(tmp_path / "field?1 #%20"):
        assert (tmp_path / "field?1 #%20/prefect.db").stat().st_size > 100_000
    assert ((tmp_path / "field").read_text(), len([*tmp_path.iterdir()])) == ("mine", 2)


def test_a_second_archive_copies_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Migrations run once for a version of Prefect: the copy has its tables, and no second process is started."""
    copy_tables(tmp_path / "first.db")
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("migrates again"))
    copy_tables(tmp_path / "second.db")
    with closing(sqlite3.connect(tmp_path / "second.db")) as made:
        tables = {name for (name,) in made.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        assert {"flow_run", "task_run", "deployment", "alembic_version"} <= tables
        assert made.execute("SELECT count(*) FROM flow_run").fetchone() == (0,)


@pytest.mark.parametrize("cache", ["cache", None])
def test_failed_migrations_leave_no_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: str | None
) -> None:
    """The server is then unavailable, and the next survey tries again; a user may have no cache folder."""
    folder = None if cache is None else tmp_path / cache
    monkeypatch.setattr("spectralzoom.flows.local_server.cache_folder", lambda: folder)
    monkeypatch.setattr("sys.executable", shutil.which("false"))
    with pytest.raises(ServerUnavailable, match="cannot use its folder"), local_server(tmp_path / "home"):
        pass
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["password"]


@pytest.fixture(scope="module")
def home(prefect_home: Path) -> Path:
    """Return the folder of the server of this module, which another user could open before."""
    folder = prefect_home / "doors"
    folder.mkdir(mode=0o755, exist_ok=True)  # a worker may take tests of this module twice
    return folder


@pytest.fixture(scope="module")
def api(home: Path) -> Iterator[str]:
    """Yield the API address of a server with pages."""
    with local_server(home, schedules=True) as address:
        yield address


@pytest.fixture
def user(home: Path, api: str) -> tuple[str, ...]:
    """Return name and password."""
    return tuple((home / "password").read_text().strip().split(":"))


def test_a_request_needs_the_password(api: str, user: tuple[str, str]) -> None:
    """Only the health address and the pages themselves need none."""
    address = f"{api}/admin/version"
    assert httpx.get(address).status_code == 401
    assert httpx.get(address, auth=(user[0], "guess")).status_code == 401
    assert httpx.get(address, auth=user).status_code == 200
    assert httpx.get(f"{api}/health").status_code == 200


def test_another_name_of_this_machine_is_refused(api: str, user: tuple[str, str]) -> None:
    """A page whose name is made to lead here reaches neither the API, with the password too, nor pages or sockets."""
    for path in ("/admin/version", "/health", "/../", "/../ui-settings"):
        for host in ("evil.example", "127.0.0.1.evil.example", ""):
            assert httpx.get(f"{api}{path}", auth=user, headers={"Host": host}).status_code == 400
    assert httpx.get(f"{api.replace('127.0.0.1', 'localhost')}/admin/version", auth=user).status_code == 200
    with pytest.raises(InvalidStatus, match="400"):
        connect(f"{api.replace('http', 'ws')}/events/in", additional_headers={"Host": "evil.example"})


def test_pages_of_another_origin_are_refused(api: str, user: tuple[str, str]) -> None:
    """A browser may not send the password from them, and may not show them an answer."""
    asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization"}
    own = api.removesuffix("/api")
    for origin, code, allowed in ((FOREIGN, 400, None), ("null", 400, None), (own, 200, own)):
        preflight = httpx.options(f"{api}/flow_runs/filter", headers={"Origin": origin, **asked})
        answer = httpx.get(f"{api}/admin/version", auth=user, headers={"Origin": origin})
        assert preflight.status_code == code
        assert answer.headers.get("access-control-allow-origin") == allowed
    assert httpx.post(f"{api}/flow_runs/filter", headers={"Origin": FOREIGN}, content="{}").status_code == 401


@pytest.mark.parametrize("path", ["events/in", "events/out", "logs/out"])
def test_a_socket_needs_the_password(api: str, path: str, user: tuple[str, str]) -> None:
    """Events and logs are neither sent nor read without it."""
    address = f"{api.replace('http', 'ws')}/{path}"
    with pytest.raises((ConnectionClosed, InvalidStatus)), connect(address) as line:
        line.recv(timeout=10)
    for token, end in (("guess", "closed"), (":".join(user), "auth_success")):
        with connect(address, subprotocols=["prefect"]) as line:
            line.send(json.dumps({"type": "auth", "token": token}))
            try:
                assert json.loads(line.recv(timeout=10))["type"] == end
            except ConnectionClosed:
                assert end == "closed"


def test_other_users_cannot_open_the_folder(home: Path, api: str, user: tuple[str, str]) -> None:
    """It was open before. The password is in no variable, so that no list of processes can show it."""
    assert home.stat().st_mode & 0o777 == 0o700
    assert user[1] not in str(os.environ)


@pytest.mark.parametrize("harm", ["damaged", "no database", "locked"])
def test_a_database_that_cannot_serve_is_refused(harm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server would try again for minutes; a survey runs without it."""
    monkeypatch.setattr("spectralzoom.flows.local_server.ANSWERED_WITHIN_S", 0.2)
    place = tmp_path / "prefect.db"
    with closing(sqlite3.connect(place)) as tables:
        tables.execute("CREATE TABLE one (x)")
        tables.executemany("INSERT INTO one VALUES (?)", [(number,) for number in range(9999)])
        tables.commit()
        check_tables(place)
        if harm == "locked":
            tables.execute("BEGIN EXCLUSIVE")
        else:
            content = bytearray(place.read_bytes())
            content[:100] = b"x" * 100 if harm == "no database" else content[:100]
            content[4096:] = bytes(len(content) - 4096)
            place.write_bytes(content)
        with pytest.raises(sqlite3.Error):
            check_tables(place)


@pytest.mark.parametrize(
    ("head", "body", "why"),
    [
        ("200 OK", [b"true"], None),
        ("401 Unauthorized", [b"no"], None),
        ("503 Service Unavailable\r\nRetry-After: 90", [b"later"], "it answers 503 Service Unavailable"),
        ("429 Too Many Requests", [b""], "it answers 429 Too Many Requests"),
        ("200 OK", [b"t"] * 40, "its answer takes more than 0.3 s"),
    ],
)
def test_a_server_that_puts_off_is_silent(head: str, body: list[bytes], why: str | None) -> None:
    """A refusal is an answer; a wish to wait, or a body that never ends, is none."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def answer() -> None:
            with listening.accept()[0] as line, suppress(OSError):
                line.recv(9999)
                line.sendall(f"HTTP/1.1 {head}\r\nConnection: close\r\n\r\n".encode())
                for part in body:
                    line.sendall(part)
                    time.sleep(0.05 * (len(body) > 1))

        with ThreadPoolExecutor(1) as team:
            team.submit(answer)
            assert silence_of(f"http://127.0.0.1:{listening.getsockname()[1]}/api", 0.3) == why
