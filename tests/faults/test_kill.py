"""Killed with SIGKILL at random moments: what was published verifies, what was spooled is there, the rerun goes on."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from storage.archive.archive import Archive
from storage.arrays.class_maps import load_class_map
from storage.arrays.spool import Spool
from tests.faults.nursery import Nursery
from tests.faults.small_survey import problems

KILLS = 6
MOMENTS = [(number + random.Random(number).random()) / KILLS for number in range(KILLS)]  # of the time it takes
LIVES = (0.5, 0.35, 0.35, 0.35) * 3  # of it too: what was not published begins anew

Runner = Callable[[Path, float | None], tuple[int, float]]
ROOT = Path(__file__).parents[2]
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


@dataclass(frozen=True)
class Whole:
    """A survey that nothing disturbed."""

    seconds: float
    classes: np.ndarray


@pytest.fixture(scope="module")
def run(scene_files: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runner]:
    """Survey into a folder and kill it after some seconds (None: never); gives exit code and seconds."""
    words = [
        "survey",
        "--scene",
        str(scene_files / "scene.png"),
        "--labels",
        str(scene_files / "labels.png"),
        "--weights",
        str(weights),
        "--engine",
        "plain",
        "--budget",
        "0.8",
    ]
    with Nursery(tmp_path_factory.mktemp("nursery")) as nursery:

        def survey(out: Path, delay: float | None) -> tuple[int, float]:
            child = nursery.start([*words, "--out", str(out)])
            if delay is not None:
                time.sleep(delay)
                child.kill()
            ended = child.wait()
            return ended.code, ended.seconds

        yield survey


@pytest.fixture(scope="module")
def whole(run: Runner, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The same survey, left alone."""
    assert run(tmp_path_factory.mktemp("first"), None)[0] == 0  # which works out the effects for all that follow
    out = tmp_path_factory.mktemp("whole")
    code, seconds = run(out, None)
    assert code == 0
    return Whole(seconds, class_map(out))


def class_map(out: Path) -> np.ndarray:
    """The one class map of an archive."""
    (ref,) = Archive.open(out).refs("segment")
    return load_class_map(ref.path / "class_map.zarr").classes


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_survey_goes_on(moment: float, run: Runner, whole: Whole, tmp_path: Path) -> None:
    """Killed at any moment: every store verifies; the same command ends well, with the map of an undisturbed run."""
    code, _ = run(tmp_path, moment * whole.seconds)
    assert code in (-signal.SIGKILL, 0)  # a faster run than the first may have ended before
    before = {ref.uri for ref in Archive.open(tmp_path).refs()}
    assert problems(tmp_path) == []
    assert run(tmp_path, None)[0] == 0
    archive = Archive.open(tmp_path)
    assert problems(tmp_path) == []
    assert before <= {ref.uri for ref in archive.refs()}
    np.testing.assert_array_equal(class_map(tmp_path), whole.classes)
    archive.reclaim()
    assert not [*tmp_path.rglob("*.part"), *tmp_path.glob("spool/*")]


def test_killed_again_and_again(run: Runner, whole: Whole, tmp_path: Path) -> None:
    """Runs that all die early still get somewhere: each goes on from what the one before it had published."""
    published = [0]
    for life in LIVES:
        code, _ = run(tmp_path, life * whole.seconds)
        assert problems(tmp_path) == []
        published.append(len(Archive.open(tmp_path).refs()))
        if code == 0:
            break
    assert published == sorted(published)
    assert published[-1] > 0
    assert run(tmp_path, None)[0] == 0
    np.testing.assert_array_equal(class_map(tmp_path), whole.classes)


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
        findings = archive.verify_all()
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
