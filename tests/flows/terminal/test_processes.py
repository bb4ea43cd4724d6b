"""Processes: caches for users without a home, words for what a machine refuses, and a survey within narrow limits."""

from __future__ import annotations

import errno
import os
import pwd
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from flows.terminal.processes import format_refusal, place_caches, place_pages
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


ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError("Unable to allocate 25.3 MiB for an array"), "memory ran out: Unable to allocate 25.3 MiB"),
        (MemoryError(), "memory ran out: the machine has no more"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."), "ask for less"),
        (RuntimeError("can't start new thread"), "memory ran out: can't start new thread"),
        (OSError(errno.EFBIG, "File too large", "/a/b"), "read or write /a/b: a file may not grow so large here"),
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (OSError(errno.ENOENT, "No such file", "/a/b"), None),
        (OSError(errno.ENOENT, "No such file"), "the current folder was removed"),
        (ImportError("libx.so: failed to map segment from shared object"), None),
        (ZeroDivisionError("division by zero"), None),
    ],
)
def test_words(error: Exception, words: str | None) -> None:
    """What was refused and what to do; other errors stay what they are."""
    found = format_refusal(error)
    assert found is None if words is None else words in str(found)


@pytest.mark.parametrize(
    ("limit", "words"),
    [("ulimit -v 999999", "error: memory ran out: "), ("ulimit -f 100", "may not grow so large here: raise ulimit -f")],
)
def test_a_survey_within_narrow_limits(tmp_path: Path, limit: str, words: str) -> None:
    """An address space of 1 GB, files of 100 kB: one message, exit code 1, and no report of a defect."""
    survey = (
        f"{sys.executable} -m flows.cli.main survey --scene farm --size 64x64 --effects all --engine plain "
        f"--out {tmp_path / 'a'}"
    )
    command = ["sh", "-c", f"{limit}; exec {survey}"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert (ended.returncode, len(errors)) == (1, 1), ended.stderr
    assert words in errors[0]
    assert "defect" not in ended.stderr
