"""The controller's own logger: measured positions at a steady rate, started, stopped and fetched."""

from __future__ import annotations

import logging

import numpy as np

from pipeline.errors import RigError
from pipeline.rig.device_errors import DeviceRefused
from pipeline.rig.mirror.mirror_requests import ProLink
from pipeline.rig.mirror.pro_mode import ErrorCode
from pipeline.rig.mirror.pro_payloads import CELL, VECTOR_CELLS, set_values
from pipeline.rig.mirror.registers import FEEDBACK_X, FEEDBACK_Y, LOG_RATE, LOG_RUN, VectorRegister, X, log_slot
from pipeline.rig.mirror.steering import MotionLog
from pipeline.rig.mirror.vector_upload import read_cells

LOG = logging.getLogger(__name__)
_KINDS = (">f4", ">f4", ">u4")  # of the slots' cells


class Logger:
    """The logger of one controller. It takes down X in slot 0, Y in slot 1 and the cell that X plays in slot 2."""

    def __init__(self, link: ProLink, most_samples: int) -> None:
        self._link = link
        self._most = most_samples
        self._rate_hz = 0.0
        self._with_index = False
        self._started: tuple[float, float] | None = None  # before the request and after its acknowledgement

    def start(self, rate_hz: float, *, with_index: bool = False) -> None:
        """Say what to log, positions and the path's index with them or not, and begin.

        Raises
        ------
        DeviceRefused, DeadlinePassed, DeviceGone
        """
        clock = self._link.wire.clock
        self._started = None
        self._link.tell(set_values({LOG_RUN: 0}), "stopping the log")
        slots = {log_slot(0): FEEDBACK_X, log_slot(1): FEEDBACK_Y}
        slots |= {log_slot(2): X.vector(VectorRegister.INDEX)} if with_index else {}
        self._link.tell(set_values({**slots, LOG_RATE: float(rate_hz)}), "setting up the log")
        self._with_index = with_index
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
        columns = [self._column(slot, wanted) for slot in range(2 + self._with_index)]
        held = min(map(len, columns)) // CELL
        x, y, *rest = (np.frombuffer(column, kind, held) for column, kind in zip(columns, _KINDS, strict=False))
        index = rest[0].astype(np.int64) if rest else None
        position = np.stack([x, y], axis=-1).astype(np.float32)
        return MotionLog(position, self._rate_hz, after, after - before, index)

    def _column(self, slot: int, samples: int) -> bytes:
        cells = b""
        for start in range(0, samples, VECTOR_CELLS):
            try:
                cells += read_cells(self._link, log_slot(slot), start, min(VECTOR_CELLS, samples - start))
            except DeviceRefused as error:
                if error.code != ErrorCode.VECTOR_INDEX:
                    raise
                LOG.warning("the log on %s ends at %d of %d samples", self._link.wire.port, start, samples)
                break
        return cells
