"""Surveys of a small scene through a chaotic line to the camera: what they gave, and what a rerun makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from pipeline.errors import RigError
from pipeline.rig.camera.camera_files import KeptInMemory
from pipeline.rig.camera.headwall_camera import HeadwallCamera
from pipeline.rig.capture.capture_runner import RigDevices
from pipeline.rig.capture.rig_source import RigSource
from pipeline.rig.device_settings import CameraAddress, ControlPatience, FileServer
from pipeline.rig.emulator.camera_device import CameraServer
from pipeline.source import Line, References
from tests.pipeline.rig.chaos_line import OFTEN, ChaosLine
from tests.pipeline.rig.in_process import ManualClock
from tests.pipeline.rig.small_rig import COARSE, FINE, SmallRig, assert_simulated, small_rig

SWEEPS = (COARSE, FINE)
QUICK = ControlPatience(0.3, 2, 0.01)


@dataclass
class Survey:
    """Frames and lines of one survey, as far as they were given, and what ended it."""

    references: dict[str, References] = field(default_factory=dict)
    lines: dict[str, list[Line]] = field(default_factory=dict)
    error: str = ""

    def go_on(self, source: RigSource) -> None:
        """Take what is missing, as a survey does: the frames of a sweep before its lines."""
        self.error = ""
        try:
            for sweep in SWEEPS:
                if sweep.name not in self.references:
                    self.references[sweep.name] = source.references(sweep)
                given = self.lines.setdefault(sweep.name, [])
                for line in source.lines(sweep, len(given)):
                    given.append(line)
        except RigError as error:
            self.error = str(error)

    @property
    def is_whole(self) -> bool:
        """Whether every line was given."""
        return all(len(self.lines.get(sweep.name, ())) == sweep.lines for sweep in SWEEPS)


@dataclass
class Chaos:
    """What came of surveys through a chaotic line."""

    surveys: int = 0
    told: int = 0  # that ended in a message
    strikes: int = 0
    wrong: list[str] = field(default_factory=list)
    messages: set[str] = field(default_factory=set)


def survey_in_chaos(seeds: range, *, every: tuple[float, float] = OFTEN) -> Chaos:
    """One survey a seed: bytes of the undisturbed one or one message, and the rerun without chaos gives them all."""
    found, truth = Chaos(), undisturbed()
    for seed in seeds:
        with small_rig() as rig, _through(rig, seed, every) as line:
            kept, survey = KeptInMemory(), Survey()
            survey.go_on(rig.source(kept))
            found.surveys, found.strikes = found.surveys + 1, found.strikes + line.strikes
            found.wrong += [f"{seed}: {one}" for one in differences(survey, truth)]
            if survey.error:
                found.told += 1
                found.messages.add(survey.error)
                found.wrong += [f"{seed}: no message: {survey.error!r}"] if not is_message(survey.error) else []
            elif not survey.is_whole:
                found.wrong.append(f"{seed}: lines are missing, and nothing was said")
            line.calm = True
            _let_end(rig)
            again = Survey()
            for one in (survey, again):  # the lines that were missing, and all of them from what is kept
                one.go_on(rig.source(kept))
                found.wrong += [f"{seed}, rerun: {wrong}" for wrong in differences(one, truth)]
                if one.error or not one.is_whole:
                    found.wrong.append(f"{seed}, rerun: not whole; {one.error}")
    return found


@cache
def undisturbed() -> Survey:
    """What the same rig gives without a line of chaos: the simulated source's lines."""
    with small_rig() as rig:
        survey = Survey()
        survey.go_on(rig.source())
    assert survey.is_whole, survey.error
    for sweep in SWEEPS:
        assert_simulated(survey.lines[sweep.name], sweep)
    return survey


def differences(survey: Survey, truth: Survey) -> list[str]:
    """Where numbers, positions or validity are others than without chaos."""
    wrong = []
    for name, found in survey.references.items():
        true = truth.references[name]
        if (
            not (np.array_equal(found.dark, true.dark) and np.array_equal(found.white, true.white))
            or found.bad is not None
        ):
            wrong.append(f"references of {name}")
    for name, lines in survey.lines.items():
        for number, line in enumerate(lines):
            other = truth.lines[name][number]
            alike = replace(line, data=other.data, time_s=other.time_s) == other
            if not (alike and np.array_equal(line.data, other.data)):
                wrong.append(f"line {number} of {name}")
    return wrong


def is_message(words: str) -> bool:
    """Whether this is one line that an operator can read."""
    return "\n" not in words and "Traceback" not in words and 20 < len(words) < 1200


@contextmanager
def _through(rig: SmallRig, seed: int, every: tuple[float, float]) -> Iterator[ChaosLine]:
    """Have a rig's camera behind a chaotic line."""
    server, connect = rig.line.server, rig.devices
    assert isinstance(server, CameraServer)
    assert isinstance(rig.line.clock, ManualClock)
    with ChaosLine(server.port, server.file_port, seed, every=every) as line:

        def devices() -> RigDevices:
            files = FileServer("127.0.0.1", line.file_port, stall_s=0.3, pause_s=0.0)
            address = CameraAddress("127.0.0.1", line.port)
            camera = HeadwallCamera.at(address, files, patience=QUICK, clock=rig.line.clock)
            return RigDevices(connect().steering, camera, rig.line.clock)

        rig.devices = devices  # type: ignore[method-assign]
        yield line


def _let_end(rig: SmallRig) -> None:
    """Let what was begun come to its end: a survey that was told of is begun again by a person, later."""
    assert isinstance(rig.line.clock, ManualClock)
    rig.emulated.camera.command("stopCapture")
    rig.line.clock.advance(60.0)
