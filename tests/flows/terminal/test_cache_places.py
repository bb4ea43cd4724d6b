"""Caches of libraries for a user without a home: a temporary folder, only where it is needed."""

from __future__ import annotations

import os
import pwd
import stat
import tempfile
from pathlib import Path

import pytest

from flows.terminal.processes import place_caches, place_pages
from pipeline.errors import SettingsError

NOWHERE = "/proc/nonexistent"  # where not even root can write


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_a_home_is_used_as_ever(tmp_path: Path, temporary: Path) -> None:
    """Where ~/.cache or XDG_CACHE_HOME can be written nothing is named and nothing made elsewhere."""
    for environment in ({"HOME": str(tmp_path)}, {"HOME": NOWHERE, "XDG_CACHE_HOME": str(tmp_path / "a" / "b")}):
        before = dict(environment)
        assert place_caches(environment) is None
        assert environment == before
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    "environment", [{"HOME": NOWHERE}, {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE}, {"HOME": "here"}]
)
def test_without_one_they_are_in_a_temporary_folder(environment: dict[str, str], temporary: Path) -> None:
    """Which only this user may enter; those who were told a place keep it."""
    environment = environment | {"MPLCONFIGDIR": "/elsewhere"}
    folder = place_caches(environment)
    assert folder is not None
    assert folder.parent == temporary
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert environment["XDG_CACHE_HOME"] == str(folder)
    assert environment["NUMBA_CACHE_DIR"] == str(folder / "numba")
    assert environment["MPLCONFIGDIR"] == "/elsewhere"


def test_users_without_anything_are_told(temporary: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A home that is not there as on Debian; where nothing can be written, what to set."""
    monkeypatch.setattr(pwd, "getpwuid", lambda number: {}[number])
    environment: dict[str, str] = {}
    assert place_caches(environment) is not None
    assert environment["HOME"] == "/nonexistent"
    monkeypatch.setattr(tempfile, "tempdir", NOWHERE)
    with pytest.raises(SettingsError, match=r"neither a home nor a temporary folder .* set XDG_CACHE_HOME to a folder"):
        place_caches({"HOME": NOWHERE})


def test_pages_of_prefect_are_unpacked_where_that_is_possible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside its code, or in the cache folder."""
    environment = {"XDG_CACHE_HOME": str(tmp_path)}
    monkeypatch.setattr(os, "access", lambda *_: True)
    assert place_pages(environment) == {}
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert place_pages(environment) == {
        "PREFECT_SERVER_UI_STATIC_DIRECTORY": str(tmp_path / "spectralzoom" / "prefect-pages")
    }
