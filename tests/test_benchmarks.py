"""The benchmark runner: one table, a list of missed goals; a crash is named and does not stop other benchmarks."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).parent / "benchmarks"
GOOD = """
from measure import Row

def rows():
    missed = Row("fast | enough", "1.5 s", "<= 1 s", False, "peer: 3 s")
    return [missed, Row("right", "0 px", "< 1 px", True), Row("aside", "7")]
"""


def run_copy(folder: Path, *arguments: str, crash: bool = False) -> subprocess.CompletedProcess[str]:
    """Run the table on made-up benchmarks in a separate folder."""
    place = folder / "tests" / "benchmarks"
    place.mkdir(parents=True, exist_ok=True)
    for name in ("__main__.py", "measure.py"):
        shutil.copy(SOURCE / name, place / name)
    (place / "bench_good.py").write_text(GOOD)
    if crash:
        (place / "bench_bad.py").write_text("def rows():\n    raise RuntimeError('no such peer')\n")
    command = [sys.executable, str(place), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)


def test_a_missed_goal_is_printed_and_the_exit_code_is_0(tmp_path: Path) -> None:
    """The table has all rows, and Markdown the same; missed goals follow; an unknown benchmark is refused."""
    done = run_copy(tmp_path, "--markdown", "table.md")
    assert done.returncode == 0, done.stderr
    assert "1 of 2 goals met; missed: fast | enough" in done.stdout
    assert ["aside", "7", "-", "-", "-"] in [line.split() for line in done.stdout.splitlines()]
    table = (tmp_path / "table.md").read_text().splitlines()
    assert table[0] == "| what | figure | goal | met | peers |"
    assert table[2] == r"| fast \| enough | 1.5 s | <= 1 s | NO | peer: 3 s |"
    assert "no benchmark speed; there are: good" in run_copy(tmp_path, "speed").stderr


def test_a_crash_is_named_and_other_benchmarks_run(tmp_path: Path) -> None:
    """The crashed benchmark comes first, the good one's table follows, and the exit code is 1."""
    done = run_copy(tmp_path, crash=True)
    assert done.returncode == 1
    assert "bad: crashed; the others go on" in done.stdout
    assert "RuntimeError: no such peer" in done.stderr
    assert "crashed: bad" in done.stdout.splitlines()[-1]
    assert "right" in done.stdout
