"""Words for what a machine refuses a process, and a survey within narrow limits."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from flows.terminal.processes import format_refusal

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
        (OSError(errno.ENOENT, "No such file"), None),
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
    [
        ("ulimit -v 1000000", "error: memory ran out: "),
        ("ulimit -f 100", "may not grow so large here: raise ulimit -f"),
    ],
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
