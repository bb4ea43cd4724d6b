"""Time from the last coarse line of an emulated rig to the first requested position of the fine pass."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from measure import Row, alone

if TYPE_CHECKING:
    from flows.settings.survey_settings import Settings

PX = 2560
MOST_S = 5.0


@dataclass
class Moments:
    """Times of events on the wall clock."""

    last_exposure: float = 0.0
    last_line: float = 0.0
    first_request: float = 0.0
    coarse_s: float = 0.0

    @property
    def waited_s(self) -> float:
        """Return the time from the last coarse line in the spool to the first position that is sent for a fine line."""
        return self.first_request - self.last_line


def rows() -> list[Row]:
    found = alone(measure, PX)
    what = f"rig, {PX} x {PX} x 270: last coarse line to first patch request"
    read_s = found.last_line - found.last_exposure
    fraction = f"{found.waited_s / found.coarse_s:.1%} of the coarse pass's {found.coarse_s:.0f} s"
    return [
        Row(what, f"{found.waited_s:.2f} s ({fraction})", f"<= {MOST_S:g} s", found.waited_s <= MOST_S),
        Row("the same: last exposure to last coarse line (files over FTP, this machine)", f"{read_s:.2f} s"),
    ]


def measure(px: int) -> Moments:
    """Survey a farm through an emulated rig until the first fine position."""
    from flows.settings.load import load_settings

    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        told = {
            **{"size": f"{px}x{px}", "source": "rig", "visit": "first", "out": name, "engine": "plain"},
            **{"rig.white_reference": 0.99, "rig.pulses": "position"},
        }
        moments = Moments()
        stack.enter_context(_watched(moments))
        _survey(stack, load_settings(None, told), moments)
        return moments


class _AskedError(Exception):
    """Raised at the first fine path: the rest of the survey is not measured."""


@contextmanager
def _watched(moments: Moments) -> Iterator[None]:
    """Record the times of exposures, lines and the first path of a fine sweep."""
    from pipeline.rig.capture_runner import CaptureRunner
    from storage.arrays.spool import Spool

    append, take = Spool.append, CaptureRunner.take

    def appended(spool: Spool, line: Any) -> None:
        append(spool, line)
        moments.last_line = time.perf_counter()

    def taken(runner: CaptureRunner, path: Any) -> Any:
        if path.sweep.kind == "fine":
            moments.first_request = time.perf_counter()
            raise _AskedError
        done = take(runner, path)
        moments.last_exposure = time.perf_counter()
        return done

    with patch.object(Spool, "append", appended), patch.object(CaptureRunner, "take", taken):
        yield


def _survey(stack: ExitStack, settings: Settings, moments: Moments) -> None:
    from flows.survey import draw_class_map
    from flows.tasks.open_survey import OpenSurvey
    from flows.tasks.run import make_source, open_run
    from flows.tasks.stages.effects import chosen_effects
    from pipeline.rig.emulator.emulated_rig import EmulatedRig
    from tests.pipeline.rig.in_process import InProcessRig, ManualClock

    run = open_run(settings)
    moments.coarse_s = run.plan.coarse_s
    survey = OpenSurvey(run)
    effects = survey("choose_effects")
    source = make_source(run.scene, settings)
    rig = EmulatedRig(replace(source, chosen=chosen_effects(effects)), ManualClock(10.0))
    line = stack.enter_context(InProcessRig(rig))
    stack.enter_context(patch("flows.tasks.rig_field.open_devices", line.devices_of))
    try:
        draw_class_map(survey)
    except _AskedError:
        return
