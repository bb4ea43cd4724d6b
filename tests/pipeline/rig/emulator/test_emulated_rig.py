"""A whole emulated rig: planned sweeps give the simulated source's lines, and everything else what the mirror does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.scan import Sweep, sweep_positions
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture_paths import capture_prefix
from pipeline.rig.device_settings import SurveyRig
from pipeline.rig.emulator.emulated_rig import EmulatedRig
from pipeline.rig.mirror_controller import MirrorController
from pipeline.rig.pro_mode import Trigger
from pipeline.rig.transports import Clock
from pipeline.simulator.render import QUIET
from pipeline.simulator.simulated import SimulatedSource
from pipeline.source import AT_REST
from tests.pipeline.rig.camera.camera_line import wait_for
from tests.pipeline.rig.in_process import InProcessRig, ManualClock
from tests.pipeline.rig.small_rig import CAMERA, COARSE, FINE, small_source

MOST_S = 60.0


class Pair:
    """Drivers of both devices."""

    def __init__(self, mirror: MirrorController, camera: HeadwallCamera, clock: Clock) -> None:
        self.mirror, self.camera, self.clock = mirror, camera, clock
        camera.configure(CAMERA.exposure_ms, CAMERA.frame_ms)

    def play(self, sweep: Sweep, first: int = 0, *, edges: bool = True, told: Sweep | None = None) -> str:
        """Play a sweep from a line on during a capture, announced as ``told``; give the folder of what was seen."""
        held = sweep_positions(sweep, CAMERA)[first:].reshape(-1, 2)
        cells = np.concatenate([held[:1], held]) if edges else held
        self.mirror.goto(*held[0])
        self.mirror.settle(2.0)
        self.mirror.load_path(cells)
        self.mirror.run(1000 * sweep.step / CAMERA.frame_ms, Trigger.RISING_EDGE if edges else Trigger.OFF)
        prefix = capture_prefix(sweep if told is None else told, first)
        folder = self.camera.capture(sweep.lines - first, prefix=prefix).folder
        wait_for(self.camera, MOST_S)
        return folder

    def lines(self, folder: str) -> np.ndarray[Any, Any]:
        """Lines of a capture, (line, sample, band)."""
        return self.camera.fetch(folder, KeptInMemory()).values


@contextmanager
def connected(source: SimulatedSource | None = None, **rig: Any) -> Iterator[tuple[Pair, EmulatedRig]]:
    """Drivers of an emulated rig in this process."""
    whole = EmulatedRig(small_source() if source is None else source, ManualClock(), **rig)
    with InProcessRig(whole) as line:
        yield Pair(line.mirror(SurveyRig(with_crc=True)), line.camera(), line.clock), whole


def planned(sweep: Sweep, lines: range, source: SimulatedSource | None = None) -> np.ndarray[Any, Any]:
    """What the simulated source gives of some lines, not binned."""
    return (small_source() if source is None else source).render(replace(sweep, binning=1), lines)


@pytest.mark.parametrize("sweep", [FINE, COARSE], ids=lambda sweep: str(sweep.name))
def test_path_on_its_own_clock_gives_them_too(sweep: Sweep) -> None:
    """Where it begins within half a held position of the first exposure."""
    with connected(wired="none") as (pair, _):
        folder = pair.play(sweep, edges=False)
        np.testing.assert_array_equal(pair.lines(folder), planned(sweep, range(sweep.lines)))


@pytest.mark.parametrize(("wired", "cells"), [("position", 40), ("frame", 10), ("none", 0)])
def test_pulses_are_as_the_cable_has_them(wired: Any, cells: int) -> None:
    """One for each held position of 10 lines of 4, one for each frame, or none."""
    with connected(wired=wired) as (pair, _):
        pair.play(COARSE)
        assert pair.mirror.index() == cells


def test_lines_are_those_where_the_mirror_is() -> None:
    """Two lines on or half a px beside what was announced: what the sweep there gives, but for the rounding of DN."""
    with connected() as (pair, _):
        folder = pair.play(replace(FINE, start_px=FINE.start_px + 2, lines=FINE.lines - 2), told=FINE)
        np.testing.assert_array_equal(pair.lines(folder), planned(FINE, range(2, FINE.lines)))
    source, beside = small_source(chosen=QUIET), replace(FINE, swath_px=FINE.swath_px + 0.5)
    with connected(source) as (pair, _):
        found = pair.lines(pair.play(beside, told=FINE)).astype(int)
    assert np.abs(found - planned(beside, range(FINE.lines), source)).max() <= 1
    assert np.abs(found - planned(FINE, range(FINE.lines), source)).max() > 1


def test_a_capture_that_announces_nothing_is_seen_at_its_place() -> None:
    """Every frame is the line where the mirror is."""
    with connected() as (pair, _):
        pair.mirror.goto(0.0, 0.0)
        folder = pair.camera.capture(2).folder
        wait_for(pair.camera, MOST_S)
        at_rest = planned(AT_REST, range(1))
        np.testing.assert_array_equal(pair.lines(folder), np.concatenate([at_rest, at_rest]))


def test_frames_that_wait_to_be_looked_at_keep_the_camera_busy() -> None:
    """Behind ports a thread looks; until it has, the capture is not over and its files are not whole."""
    with connected() as (pair, rig):
        rig.camera.aside = True
        folder = pair.camera.capture(20, prefix=capture_prefix(FINE)).folder
        pair.clock.sleep(30.0)
        assert pair.camera.is_capturing()
        assert not [name for name in rig.camera.files() if "raw_" in name]
        assert [rig.camera.keep_looking() for _ in range(4)] == [True, True, True, False]
        assert not pair.camera.is_capturing()
        assert len(pair.lines(folder)) == 20


def test_clock_of_the_source_says_when_a_sweep_began() -> None:
    """What drifts is as in the survey where the source knows the sweep's start, whenever it is played."""
    source = small_source(clock={FINE.name: 12.0})
    with connected(source) as (pair, rig):
        pair.clock.sleep(100.0)
        folder = pair.play(FINE)
        np.testing.assert_array_equal(pair.lines(folder), planned(FINE, range(FINE.lines), source))
        assert rig.camera.view.source.started_s(FINE) == 12.0


def test_state_in_words() -> None:
    """What both devices do now."""
    with connected() as (pair, rig):
        pair.mirror.goto(0.25, 0.0)
        pair.mirror.settle(2.0)
        pair.camera.capture(2)
        assert rig.state == "mirror +0.2500; +0.0000, pro, requests checked | camera capturing, 1 captures"
