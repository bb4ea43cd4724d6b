"""A whole emulated rig: planned sweeps give the simulated source's lines, other paths what the mirror points at."""

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
        self.mirror = mirror
        self.camera = camera
        self.clock = clock
        camera.configure(CAMERA.exposure_ms, CAMERA.frame_ms)

    def play(self, sweep: Sweep, first: int = 0, *, edges: bool = True, told: Sweep | None = None) -> str:
        """Play a sweep from a line on during a capture announced as ``told``, and return the folder of its files."""
        held = sweep_positions(sweep, CAMERA)[first:].reshape(-1, 2)
        self.mirror.goto(*held[0])
        self.mirror.settle(2.0)
        self.mirror.load_path(np.concatenate([held[:1], held]) if edges else held)
        self.mirror.run(1000 * sweep.step / CAMERA.frame_ms, Trigger.RISING_EDGE if edges else Trigger.OFF)
        prefix = capture_prefix(sweep if told is None else told, first)
        folder = self.camera.capture(sweep.lines - first, prefix=prefix).folder
        wait_for(self.camera, MOST_S)
        return folder

    def lines(self, folder: str) -> np.ndarray[Any, Any]:
        """Return lines of a capture, (line, sample, band)."""
        return self.camera.fetch(folder, KeptInMemory()).values


@contextmanager
def connected(source: SimulatedSource | None = None, **rig: Any) -> Iterator[tuple[Pair, EmulatedRig]]:
    """Yield drivers of an emulated rig in this process."""
    whole = EmulatedRig(small_source() if source is None else source, ManualClock(), **rig)
    with InProcessRig(whole) as line:
        yield Pair(line.mirror(SurveyRig(with_crc=True)), line.camera(), line.clock), whole


def planned(sweep: Sweep, lines: range, source: SimulatedSource | None = None) -> np.ndarray[Any, Any]:
    """Return the simulated source's values of some lines, not binned."""
    return (small_source() if source is None else source).render(replace(sweep, binning=1), lines)


@pytest.mark.parametrize("sweep", [FINE, COARSE], ids=lambda sweep: str(sweep.name))
def test_a_path_on_its_own_clock_gives_the_planned_lines(sweep: Sweep) -> None:
    """The path starts within half a held position of the first exposure."""
    with connected(wired="none") as (pair, _):
        np.testing.assert_array_equal(pair.lines(pair.play(sweep, edges=False)), planned(sweep, range(sweep.lines)))


@pytest.mark.parametrize(("wired", "cells"), [("position", 40), ("frame", 10), ("none", 0)])
def test_pulses_follow_the_wiring(wired: Any, cells: int) -> None:
    """The mirror receives one pulse for each held position of 10 lines of 4, one for each frame, or none."""
    with connected(wired=wired) as (pair, _):
        pair.play(COARSE)
        assert pair.mirror.index() == cells


def test_lines_show_the_mirrors_actual_position() -> None:
    """Lines 2 px or 0.5 px away from the announced sweep equal a sweep there, to the rounding of DN."""
    with connected() as (pair, _):
        folder = pair.play(replace(FINE, start_px=FINE.start_px + 2, lines=FINE.lines - 2), told=FINE)
        np.testing.assert_array_equal(pair.lines(folder), planned(FINE, range(2, FINE.lines)))
    source = small_source(chosen=QUIET)
    beside = replace(FINE, swath_px=FINE.swath_px + 0.5)
    with connected(source) as (pair, _):
        found = pair.lines(pair.play(beside, told=FINE)).astype(int)
    assert np.abs(found - planned(beside, range(FINE.lines), source)).max() <= 1
    assert np.abs(found - planned(FINE, range(FINE.lines), source)).max() > 1


def test_a_capture_without_an_announcement_shows_the_mirrors_position() -> None:
    """Every frame is the line at rest."""
    with connected() as (pair, _):
        pair.mirror.goto(0.0, 0.0)
        folder = pair.camera.capture(2).folder
        wait_for(pair.camera, MOST_S)
        at_rest = planned(AT_REST, range(1))
        np.testing.assert_array_equal(pair.lines(folder), np.concatenate([at_rest, at_rest]))


def test_frames_that_wait_for_rendering_keep_the_camera_busy() -> None:
    """Behind ports a thread renders frames. Until it ends, the capture runs and has no whole files."""
    with connected() as (pair, rig):
        rig.camera.aside = True
        folder = pair.camera.capture(20, prefix=capture_prefix(FINE)).folder
        pair.clock.sleep(30.0)
        assert pair.camera.is_capturing()
        assert not [name for name in rig.camera.files() if "raw_" in name]
        assert [rig.camera.keep_looking() for _ in range(4)] == [True, True, True, False]
        assert not pair.camera.is_capturing()
        assert len(pair.lines(folder)) == 20


def test_the_source_clock_determines_the_start_of_a_sweep() -> None:
    """Drift is that of the survey if the source knows the sweep's start, at whatever time it is played."""
    source = small_source(clock={FINE.name: 12.0})
    with connected(source) as (pair, rig):
        pair.clock.sleep(100.0)
        np.testing.assert_array_equal(pair.lines(pair.play(FINE)), planned(FINE, range(FINE.lines), source))
        assert rig.camera.view.source.started_s(FINE) == 12.0


def test_state_describes_both_devices() -> None:
    """The text has the mirror's position and the camera's activity."""
    with connected() as (pair, rig):
        pair.mirror.goto(0.25, 0.0)
        pair.mirror.settle(2.0)
        pair.camera.capture(2)
        assert rig.state == "mirror +0.2500; +0.0000, pro, requests checked | camera capturing, 1 captures"
