"""Compiled loops: stored for the next process, and compiled again if the cache is missing or damaged."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest

from spectralzoom.pipeline.compiled import DOUBLES, compiled
from tests.source_paths import PYTHON_PATH

ROOT = Path(__file__).parents[2]
LOOP = """
from spectralzoom.pipeline.compiled import DOUBLES, compiled, rows_of


@compiled(rows_of(DOUBLES, 1, read_only=True), rows_of(DOUBLES, 1))
def double(some, made):
    for n in range(len(some)):
        made[n] = 2 * some[n]
"""
ASK = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy, doubling
made = numpy.empty(3)
doubling.double(numpy.arange(3.0), made)
assert made.tolist() == [0.0, 2.0, 4.0]
"""


def doubled(module: ModuleType) -> list[float]:
    """Return the module's result for 0, 1, 2; the input array is read-only."""
    some = np.arange(3.0)
    made = np.empty(3)
    some.setflags(write=False)
    module.double(some, made)
    return list(made)


def opened(file: Path) -> ModuleType:
    """Return the module of a file, imported again."""
    spec = importlib.util.spec_from_file_location("doubling", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a file with one loop, whose compiled code will be stored next to it."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    found = tmp_path / "doubling.py"
    found.write_text(LOOP)
    return found


def test_compiled_code_is_stored_next_to_its_file(file: Path) -> None:
    """The first import compiles and stores the code, the next one reads it."""
    assert doubled(opened(file)) == [0, 2, 4]
    kept = {one: one.stat().st_mtime_ns for one in file.parent.rglob("*.nb?")}
    assert {one.suffix for one in kept} == {".nbi", ".nbc"}
    assert doubled(opened(file)) == [0, 2, 4]
    assert {one: one.stat().st_mtime_ns for one in file.parent.rglob("*.nb?")} == kept


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("rest", [b"", b"\x80no pickle"])
def test_damaged_code_is_compiled_again(file: Path, suffix: str, rest: bytes) -> None:
    """A full disk or an interrupted transfer may leave such files empty or torn."""
    opened(file)
    (spoilt,) = file.parent.rglob(f"*.{suffix}")
    spoilt.write_bytes(rest)
    assert doubled(opened(file)) == [0, 2, 4]


def test_loops_run_without_a_cache() -> None:
    """Code without a file, like that in a folder that is not writable, is compiled for this process only."""
    module = ModuleType("doubling")
    exec(compile(LOOP, "<nowhere>", "exec"), module.__dict__)
    assert doubled(module) == [0, 2, 4]


def test_two_processes_may_compile_at_once(file: Path) -> None:
    """Two processes finish without errors in one empty cache folder, and leave it intact."""
    command = [sys.executable, "-c", ASK, str(file.parent)]
    environment = {**os.environ, "PYTHONPATH": PYTHON_PATH}
    both = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    assert [one.communicate()[1] for one in both] == ["", ""]
    assert doubled(opened(file)) == [0, 2, 4]


def test_a_compilation_error_is_reported() -> None:
    """Code that cannot be compiled is not mistaken for a cache that cannot be written."""
    with pytest.raises(numba.TypingError):
        compiled(DOUBLES)(lambda one: one.nothing_like_it)
