"""Killed with SIGKILL at random moments: what was published verifies, what was spooled is there, the rerun goes on."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from storage.archive.archive import Archive
from storage.arrays.spool import Spool
from storage.remote.opening import verify_archive

ROOT = Path(__file__).parents[2]
KILLS = 6

PUBLISH = """
import sys
from storage.archive.archive import Archive
archive = Archive.open(sys.argv[1])
made = 0
for number in range(10**6):
    def build(path):
        for name in range(4):
            (path / f"{name}.bin").write_bytes(bytes([number % 251]) * 20_000)
    made += archive.produce("stage", build, version=1, params={"number": number})[1]
    if made == 1:
        print("published one", flush=True)
"""

SPOOL = """
import sys
from pathlib import Path
import numpy as np
from pipeline.source import Line
from storage.arrays.spool import Spool
spool = Spool.open(Path(sys.argv[1]), 64, 30, header={"sweep": "a"})
print(spool.count, flush=True)
for number in range(spool.count, 10**6):
    spool.append(Line(number, np.full((64, 30), number % 65536, np.uint16), 0.0, 0.0, 0.1 * number, 100.0))
"""


def _run_and_kill(script: str, folder: Path, delay: float) -> str:
    """Start the script, wait for its first word, kill it ``delay`` s later; gives the word."""
    command = [sys.executable, "-c", script, str(folder)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        word = process.stdout.readline().strip()
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
    return word


def test_killed_while_publishing(tmp_path: Path) -> None:
    """Every store with a final name is whole, what is torn has none, and the next run makes the rest."""
    delays = random.Random(1)
    seen = 0
    for _ in range(KILLS):
        assert _run_and_kill(PUBLISH, tmp_path, delays.uniform(0.005, 0.06)) == "published one"
        archive = Archive.open(tmp_path, create=False)
        findings = verify_archive(archive)
        assert [finding.problem for finding in findings if finding.problem] == []
        assert len(findings) > seen
        seen = len(findings)
    archive.reclaim()
    assert not list(tmp_path.glob("stages/*/*.part"))


def test_killed_while_spooling(tmp_path: Path) -> None:
    """No line that an earlier run had counted is lost, and every line left is as captured."""
    delays = random.Random(2)
    before = 0
    for _ in range(KILLS):
        counted = int(_run_and_kill(SPOOL, tmp_path, delays.uniform(0.005, 0.06)))
        assert counted >= before
        with Spool.open(tmp_path, 64, 30, header={"sweep": "a"}) as spool:
            before = spool.count
            for block in spool.blocks():
                assert all((line.data == line.number % 65536).all() for line in block)
    assert before > 0
    assert (tmp_path / "lines.bil").stat().st_size == before * np.dtype("u2").itemsize * 64 * 30
