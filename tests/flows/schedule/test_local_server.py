"""Prefect's server in this process: its access control and its initial database."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import httpx
import pytest

from spectralzoom.flows.tasks.local_server import ServerUnavailable, create_database, local_server


def test_a_server_without_a_place_for_its_database_is_unavailable(tmp_path: Path) -> None:
    """This happens on a full disk; surveys then run without a server."""
    (tmp_path / "home").write_text("a file")
    with pytest.raises(ServerUnavailable, match="the Prefect server has no database"), local_server(tmp_path / "home"):
        pass


def test_a_question_mark_in_the_path_is_no_query(tmp_path: Path) -> None:
    """The database is in that folder, and a file with the name before the mark is unchanged."""
    (tmp_path / "field").write_text("mine")
    with local_server(tmp_path / "field?1"):
        assert (tmp_path / "field?1/prefect.db").stat().st_size > 100_000
    assert ((tmp_path / "field").read_text(), len([*tmp_path.iterdir()])) == ("mine", 2)


def test_a_second_archive_copies_the_migrated_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Migrations run once for a version of Prefect: the copy has its tables, and no second process is started."""
    create_database(tmp_path / "first.db")
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("migrates again"))
    create_database(tmp_path / "second.db")
    with closing(sqlite3.connect(tmp_path / "second.db")) as made:
        tables = {name for (name,) in made.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        assert {"flow_run", "task_run", "deployment", "alembic_version"} <= tables
        assert made.execute("SELECT count(*) FROM flow_run").fetchone() == (0,)


def test_failed_migrations_leave_no_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server is then unavailable, and the next survey tries again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("sys.executable", shutil.which("false"))
    with pytest.raises(ServerUnavailable, match="Prefect cannot create its database"):
        create_database(tmp_path / "home" / "prefect.db")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_user_without_a_cache_folder_waits_for_the_migrations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server creates its own tables then."""
    monkeypatch.setattr("spectralzoom.flows.tasks.local_server.cache_folder", lambda: None)
    create_database(tmp_path / "home" / "prefect.db")
    assert [*tmp_path.rglob("*")] == [tmp_path / "home"]


def test_the_server_needs_a_password(server: str) -> None:
    """A request without one is refused; only the health address needs none."""
    assert httpx.get(f"{server}/admin/version").status_code == 401
    assert httpx.get(f"{server}/health").status_code == 200
