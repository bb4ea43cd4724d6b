"""Lines rendered in parallel: equal for every pool and block size, in order, few at a time, with errors in order."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from spectralzoom.flows.opening.open_field import make_source
from spectralzoom.flows.settings.settings import load_settings
from spectralzoom.flows.stages.capture import take_lines
from spectralzoom.pipeline.errors import RigError, SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator import render, simulated
from spectralzoom.pipeline.simulator.render import BY_NAME
from spectralzoom.pipeline.simulator.rig_model import Rig
from spectralzoom.pipeline.simulator.scenes.scene import raster_from_values
from spectralzoom.pipeline.simulator.simulated import SimulatedSource
from spectralzoom.pipeline.source import Line
from spectralzoom.storage.parallel.pool import WorkerPool
from tests.pipeline.capture.recordings import assert_same
from tests.pipeline.simulator.small_scenes import effects_on

CAMERA = LineCamera(samples=48)
SWEEP = Sweep("s", "fine", "x", swath_px=0.0, start_px=-35.0, lines=70)
TWO = WorkerPool("threads", 2)


def source_of(*effects: str) -> SimulatedSource:
    """Return a rig in front of a small scene of three bands, with these exact effects or with all effects."""
    values = np.random.default_rng(1).random((60, 90, 3))
    scene = raster_from_values(values, CAMERA, name="t", wavelength_nm=np.linspace(450, 850, 3))
    return SimulatedSource(scene, Rig(CAMERA), seed=5, chosen=effects_on(*(effects or BY_NAME)))


def taken(source: SimulatedSource, pool: WorkerPool, first: int = 0, at_once: int = 16) -> list[Line]:
    """Return all lines from the first on."""
    lines: list[Line] = []
    take_lines(source, SWEEP, lines.append, pool, first=first, at_once=at_once)
    return lines


@pytest.fixture(scope="module")
def expected() -> list[Line]:
    """Return the lines that the source gives without a pool."""
    return list(source_of().lines(SWEEP))


@pytest.mark.parametrize(
    ("scheduler", "workers", "size"),
    [  # pools without this process's memory, even with an absent scheduler, use threads here
        *(("threads", 1, 64), ("threads", 2, 1), ("threads", 2, 70), ("threads", 5, 7)),
        *(("processes", 2, 16), ("tcp://192.0.2.1:8786", 2, 16)),
    ],
)
def test_pool_and_block_size_change_no_value(
    expected: list[Line], monkeypatch: pytest.MonkeyPatch, scheduler: str, workers: int, size: int
) -> None:
    """Every effect is on, and the sampler's cache is empty."""
    monkeypatch.setattr(simulated, "BLOCK_LINES", size)
    render._sampler.cache_clear()
    assert_same(taken(source_of(), WorkerPool(scheduler, workers), at_once=size), expected)


@pytest.mark.parametrize("first", [23, 69, 70])
def test_a_capture_resumes_at_any_line(expected: list[Line], first: int) -> None:
    """The lines equal those of an unbroken capture; after the last line there is none."""
    assert_same(taken(source_of(), TWO, first), expected[first:])


def test_blocks_wait_for_earlier_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first block ends last: the others wait for it, and one block more than there are workers is begun."""
    real = SimulatedSource.lines_of
    others = threading.Semaphore(0)
    begun = []

    def unfair(self: SimulatedSource, sweep: Sweep, numbers: range) -> list[Line]:
        begun.append(numbers.start)
        if numbers.start:
            others.release()
        else:
            for _ in range(3):
                assert others.acquire(timeout=30)
            assert sorted(begun) == [0, 7, 14, 21]
        return real(self, sweep, numbers)

    monkeypatch.setattr(SimulatedSource, "lines_of", unfair)
    assert [line.number for line in taken(source_of("rotation"), WorkerPool("threads", 3), at_once=7)] == [*range(70)]


@pytest.mark.parametrize("workers", [2, 4])
def test_errors_are_raised_in_the_order_of_blocks(monkeypatch: pytest.MonkeyPatch, workers: int) -> None:
    """Lines before the first block that fails are taken; then the error of that block is raised."""
    real: Callable[..., list[Line]] = SimulatedSource.lines_of

    def failing(self: SimulatedSource, sweep: Sweep, numbers: range) -> list[Line]:
        if numbers[-1] >= 30:
            raise SceneError(f"line {numbers.start} and on")
        return real(self, sweep, numbers)

    monkeypatch.setattr(SimulatedSource, "lines_of", failing)
    lines: list[Line] = []
    with pytest.raises(SceneError, match="line 28 and on"):
        take_lines(source_of("rotation"), SWEEP, lines.append, WorkerPool("threads", workers), at_once=7)
    assert [line.number for line in lines] == list(range(28))


@pytest.mark.parametrize("error", [RigError("disk full"), KeyboardInterrupt()])
def test_rendering_stops_when_a_line_is_refused(error: BaseException) -> None:
    """A full disk or Ctrl-C at a line ends the capture there, and no thread is left."""
    lines = []
    before = threading.active_count()

    def take(line: Line) -> None:
        if line.number == 40:
            raise error
        lines.append(line.number)

    with pytest.raises(type(error)):
        take_lines(source_of("rotation"), SWEEP, take, TWO, at_once=7)
    assert lines == list(range(40))
    assert threading.active_count() == before


def test_every_visit_has_its_own_seed() -> None:
    """So have every day and hour of a farm, and pointing errors; the default day has the seed of the settings."""
    asked = ({}, {"visit": "a"}, {"visit": "b"}, {"day": "179"}, {"day": "179", "visit": "a"}, {"hour": "9"})
    given = {"scene": "farm", "seed": "7", "pointing_px": "2"}
    scene = source_of().scene
    sources = [make_source(scene, load_settings(None, given | one)) for one in (*asked, {"day": "172"})]
    seeds = [source.seed for source in sources]
    assert seeds[0] == seeds[-1] == 7
    assert len(set(seeds)) == len(asked)
    assert [source.pointing and source.pointing.seed for source in sources] == seeds
