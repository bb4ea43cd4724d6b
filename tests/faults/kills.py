"""Kill a survey at random moments, run it again, and see what the archive says: ``python tests/faults/kills.py 100``.

After every kill each published store must verify and none published before may be gone; what a run that ends leaves
must be what an undisturbed one leaves, byte by byte. A run that ended is followed by one in a new archive.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.faults.small_survey import problems, stored

BANDS = ",".join(str(band) for band in range(4, 268, 8)[:32])
SURVEY = (
    "--scene",
    "farm",
    "--size",
    "256x256",
    "--bands",
    BANDS,
    "--seed",
    "5",
    "--budget",
    "0.8",
    "--engine",
    "plain",
    "--no-controls",
)
START_S = 0.3  # of importing, in which nothing can go wrong


def start(archive: Path) -> subprocess.Popen[bytes]:
    """Begin the survey in a process of its own."""
    command = [sys.executable, "-m", "flows.cli.main", "survey", *SURVEY, "--out", str(archive)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def main(kills: int, seed: int = 0) -> int:
    with tempfile.TemporaryDirectory(prefix="kills-") as name:
        return kill_surveys(Path(name), kills, random.Random(seed))


def kill_surveys(folder: Path, kills: int, rng: random.Random) -> int:
    """Kill surveys in a folder, print the table; 1 where anything was lost or wrong."""
    began = time.monotonic()
    assert start(folder / "undisturbed").wait() == 0, "the undisturbed survey failed"
    whole_s = time.monotonic() - began
    truth, lost, wrong, damaged, ended, number = stored(folder / "undisturbed"), 0, 0, 0, 0, 0
    archive, before = folder / "0", {}
    for kill in range(kills):
        process = start(archive)
        time.sleep(rng.uniform(START_S, 1.05 * whole_s))
        process.send_signal(signal.SIGKILL)
        finished = process.wait() == 0
        if (archive / "stages").is_dir():
            now = stored(archive)
            damaged += len(problems(archive))
            lost += len(set(before) - set(now))
            wrong += sum(truth.get(uri) != files for uri, files in now.items())
            before = now
        if finished or kill == kills - 1:
            assert start(archive).wait() == 0, "the survey does not go on"
            last = stored(archive)
            wrong += sum(truth.get(uri) != files for uri, files in last.items()) + len(set(truth) - set(last))
            ended, number, before = ended + 1, number + 1, {}
            archive = folder / str(number)
    print(f"{kills} kills in {time.monotonic() - began:.0f} s, {ended} archives brought to an end")
    print(f"published stores lost {lost}, not as published {damaged}, other than undisturbed {wrong}")
    return int(bool(lost or wrong or damaged))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 100))
