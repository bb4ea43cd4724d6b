"""The controller's own logger: measured positions at a steady rate, started, stopped and fetched."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError
from pipeline.rig.links import ProLink
from pipeline.rig.pro_mode import ErrorCode
from pipeline.rig.pro_payloads import VECTOR_CELLS, set_values
from pipeline.rig.refusals import DeviceRefused
from pipeline.rig.registers import FEEDBACK_X, FEEDBACK_Y, LOG_RATE, LOG_RUN, log_slot
from pipeline.rig.steering import MotionLog
from pipeline.rig.vector_upload import read_cells

LOG = logging.getLogger(__name__)


class Logger:
    """The logger of one controller. It takes down X in slot 0 and Y in slot 1."""

    def __init__(self, link: ProLink, most_samples: int) -> None:
        self._link = link
        self._most = most_samples
        self._rate_hz = 0.0
        self._started: tuple[float, float] | None = None  # before the request and after its acknowledgement

    def start(self, rate_hz: float) -> None:
        """Say what to log, and begin.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone
        """
        clock = self._link.wire.clock
        self._started = None
        self._link.tell(set_values({LOG_RUN: 0}), "stopping the log")
        self._link.tell(
            set_values({log_slot(0): FEEDBACK_X, log_slot(1): FEEDBACK_Y, LOG_RATE: float(rate_hz)}),
            "setting up the log",
        )
        before = clock.now()
        self._link.tell(set_values({LOG_RUN: 1}), "starting the log")
        self._rate_hz, self._started = float(rate_hz), (before, clock.now())

    def read(self, samples: int | None = None) -> MotionLog:
        """End the log and fetch ``samples`` of it, or as many as the time since the start has.

        Never more than the logger holds. Where it holds fewer than expected, the device says so and the log ends there.

        Raises
        ------
        RigError : no log was started. DeviceRefused, DeadlinePassed, DeviceGone
        """
        if self._started is None:
            raise RigError(f"no log was started on {self._link.wire.port}; start one before the path runs")
        before, after = self._started
        elapsed = self._link.wire.clock.now() - after
        self._link.tell(set_values({LOG_RUN: 0}), "stopping the log")
        self._started = None
        wanted = min(int(elapsed * self._rate_hz) if samples is None else samples, self._most)
        columns = [self._column(slot, wanted) for slot in (0, 1)]
        held = min(map(len, columns))
        return MotionLog(np.stack([column[:held] for column in columns], axis=-1), self._rate_hz, after, after - before)

    def _column(self, slot: int, samples: int) -> NDArray[np.float32]:
        cells = b""
        for start in range(0, samples, VECTOR_CELLS):
            try:
                cells += read_cells(self._link, log_slot(slot), start, min(VECTOR_CELLS, samples - start))
            except DeviceRefused as error:
                if error.code != ErrorCode.VECTOR_INDEX:
                    raise
                LOG.warning("the log on %s ends at %d of %d samples", self._link.wire.port, start, samples)
                break
        return np.frombuffer(cells, ">f4").astype(np.float32)
