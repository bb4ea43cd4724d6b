"""Compiled loops: kept for the next process, and compiled anew where nothing can be kept or what was kept is spoilt."""

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

from pipeline.compiled import DOUBLES, compiled

ROOT = Path(__file__).parents[2]
LOOP = """
from pipeline.compiled import DOUBLES, compiled, rows_of


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
    """What the loop of a module makes of 0, 1, 2; the array that it reads cannot be written to."""
    some, made = np.arange(3.0), np.empty(3)
    some.setflags(write=False)
    module.double(some, made)
    return list(made)


def opened(file: Path) -> ModuleType:
    """The module of a file, imported anew."""
    spec = importlib.util.spec_from_file_location("doubling", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with one loop, beside which its code is kept."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    found = tmp_path / "doubling.py"
    found.write_text(LOOP)
    return found


def test_code_is_kept_beside_its_file(file: Path) -> None:
    """The first import compiles and keeps, the next one finds."""
    assert doubled(opened(file)) == [0, 2, 4]
    kept = {one: one.stat().st_mtime_ns for one in file.parent.rglob("*.nb?")}
    assert {one.suffix for one in kept} == {".nbi", ".nbc"}
    assert doubled(opened(file)) == [0, 2, 4]
    assert {one: one.stat().st_mtime_ns for one in file.parent.rglob("*.nb?")} == kept


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("rest", [b"", b"\x80no pickle"])
def test_spoilt_code_is_compiled_anew(file: Path, suffix: str, rest: bytes) -> None:
    """Files that a full disk or a cut wire left empty or torn refuse nobody."""
    opened(file)
    (spoilt,) = file.parent.rglob(f"*.{suffix}")
    spoilt.write_bytes(rest)
    assert doubled(opened(file)) == [0, 2, 4]


def test_where_nothing_can_be_kept_loops_run_all_the_same() -> None:
    """Code of no file, as that of a folder that cannot be written, is compiled for this process alone."""
    module = ModuleType("doubling")
    exec(compile(LOOP, "<nowhere>", "exec"), module.__dict__)
    assert doubled(module) == [0, 2, 4]


def test_two_processes_compile_at_once(file: Path) -> None:
    """Both come to their end over one cold folder, and leave it whole."""
    command, environment = [sys.executable, "-c", ASK, str(file.parent)], {**os.environ, "PYTHONPATH": str(ROOT)}
    both = [subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    assert [one.communicate()[1] for one in both] == ["", ""]
    assert doubled(opened(file)) == [0, 2, 4]


def test_other_types_are_refused() -> None:
    """One signature is compiled, and nothing else behind the caller's back."""
    module = ModuleType("doubling")
    exec(compile(LOOP, "<nowhere>", "exec"), module.__dict__)
    with pytest.raises(TypeError, match="No matching definition"):
        module.double(np.arange(3, dtype=np.float32), np.empty(3))


def test_an_error_of_the_loop_is_told() -> None:
    """What cannot be compiled is not taken for a cache that cannot be written."""
    with pytest.raises(numba.TypingError):
        compiled(DOUBLES)(lambda one: one.nothing_like_it)
