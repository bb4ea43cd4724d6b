"""A survey killed with SIGKILL at random moments: what was published verifies, the same command ends well."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from storage.archive.archive import Archive
from storage.arrays.class_maps import load_class_map
from tests.faults.nursery import Nursery
from tests.faults.small_survey import problems

KILLS = 6
MOMENTS = [(number + random.Random(number).random()) / KILLS for number in range(KILLS)]  # of the time it takes
LIVES = (0.5, 0.35, 0.35, 0.35) * 3  # of it too: what was not published begins anew

Runner = Callable[[Path, float | None], tuple[int, float]]


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
