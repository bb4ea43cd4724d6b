"""Prefect's server in this process: its access control and its initial database.

`python tests/flows/schedule/test_local_server.py` writes the database's schema for another version of Prefect.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import httpx
import pytest

from flows.tasks.local_server import ServerUnavailable, local_server

SCHEMA = Path(__file__).parents[3] / "flows" / "tasks" / "prefect_schema.sql"
HEAD = """-- The empty database of Prefect {}
-- python tests/flows/schedule/test_local_server.py writes this file.
-- SHA-256 of the statements: {}
"""
MIGRATE = """
import asyncio
from prefect.server.database.dependencies import provide_database_interface
asyncio.run(provide_database_interface().create_db())
"""


def sealed(statements: str) -> str:
    """Return the content of the file: these statements after the installed version of Prefect and their hash."""
    return HEAD.format(metadata.version("prefect"), hashlib.sha256(statements.encode()).hexdigest()) + statements


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


def test_the_schema_was_written_for_the_installed_prefect() -> None:
    """Version and hash are those of the file; ten seconds of migrations write it, when another version is pinned."""
    text = SCHEMA.read_text()
    assert sealed(text.split("\n", HEAD.count("\n"))[-1]) == text


def test_the_server_needs_a_password(server: str) -> None:
    """A request without one is refused; only the health address needs none."""
    assert httpx.get(f"{server}/admin/version").status_code == 401
    assert httpx.get(f"{server}/health").status_code == 200


if __name__ == "__main__":
    os.environ["DO_NOT_SCAN_PATH"] = "1"
    with tempfile.TemporaryDirectory() as folder:  # Prefect's own migrations run in a process with its own settings
        file = Path(folder) / "migrated.db"
        settings = {"PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{file}", "PREFECT_HOME": folder}
        subprocess.run([sys.executable, "-c", MIGRATE], env={**os.environ, **settings}, check=True)
        with sqlite3.connect(file) as made:
            text = "\n".join(made.iterdump())
        made.close()
        SCHEMA.write_text(sealed(text + "\n"))
