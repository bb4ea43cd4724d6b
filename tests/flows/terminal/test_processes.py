"""Processes: cache folders without a home, messages for refused resources, and a survey within narrow limits."""

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

from spectralzoom.flows.terminal.processes import format_refusal, place_caches, place_pages
from spectralzoom.pipeline.errors import SettingsError
from tests.flows.conftest import CommandLine, Ended
from tests.users.test_first_steps import small_files

SURVEY = ("survey", "--size=64x64", "--bands=20,120,220", "--effects=none", "--engine=plain")
NOWHERE = "/proc/nonexistent"  # not even root can write here


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder that is set as the folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_writable_home_or_cache_folder_is_kept(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A writable ~/.cache or XDG_CACHE_HOME leaves the environment unchanged and makes no other folder."""
    for environment in ({"HOME": str(tmp_path)}, {"HOME": NOWHERE, "XDG_CACHE_HOME": str(tmp_path / "a" / "b")}):
        monkeypatch.setattr(os, "environ", dict(environment))
        assert place_caches() is None
        assert os.environ == environment
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    "environment", [{"HOME": NOWHERE}, {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE}, {"HOME": "here"}]
)
def test_caches_without_a_home_are_in_a_temporary_folder(
    environment: dict[str, str], temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only this user may enter the folder; caches that have a folder of their own keep it."""
    monkeypatch.setattr(os, "environ", environment | {"MPLCONFIGDIR": "/elsewhere"})
    folder = place_caches()
    assert folder.parent == temporary
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert os.environ["XDG_CACHE_HOME"] == str(folder)
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder / "numba")
    assert os.environ["MPLCONFIGDIR"] == "/elsewhere"


def test_missing_home_is_replaced_or_reported(temporary: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a passwd entry HOME becomes /nonexistent; without a writable folder the error names XDG_CACHE_HOME."""
    monkeypatch.setattr(pwd, "getpwuid", lambda number: {}[number])
    monkeypatch.setattr(os, "environ", {})
    assert place_caches() is not None
    assert os.environ["HOME"] == "/nonexistent"
    monkeypatch.setattr(os, "environ", {"HOME": NOWHERE})
    monkeypatch.setattr(tempfile, "tempdir", NOWHERE)
    with pytest.raises(SettingsError, match=r"neither a home nor a temporary folder .* set XDG_CACHE_HOME to a folder"):
        place_caches()


def test_prefect_pages_are_unpacked_into_a_writable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They stay beside Prefect's code if that folder is writable, else go into the cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda *_: True)
    assert place_pages() == {}
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert place_pages() == {"server.ui.static_directory": str(tmp_path / "spectralzoom" / "prefect-pages")}


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
def test_refused_resources_get_a_message(error: Exception, words: str | None) -> None:
    """The message names the refused resource and a remedy; other errors get none."""
    found = format_refusal(error)
    assert found is None if words is None else words in str(found)


def test_survey_within_narrow_memory_fails_with_one_message(tmp_path: Path) -> None:
    """The limit is 0.4 GB of address space: exit code 1, and no report of a defect."""
    survey = f"{sys.executable} -m spectralzoom.flows.cli.main {' '.join(SURVEY)} --out {tmp_path / 'a'}"
    command = ["sh", "-c", f"ulimit -v 400000; exec {survey}"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    Ended(ended.returncode, ended.stdout, ended.stderr).refused(1, "^memory ran out: ")
    assert "defect" not in ended.stderr


def test_survey_with_small_files_fails_with_one_message(tmp_path: Path, command_line: CommandLine) -> None:
    """The limit is 50 kB a file: exit code 1, and no report of a defect."""
    with small_files(50_000):
        ended = command_line(*SURVEY, "--out", tmp_path / "a")
    ended.refused(1, "may not grow so large here: raise ulimit -f")
    assert "defect" not in ended.err
