"""Paths in the controller's vector memory: positions for the wire, sent and read back, played; and its motion's log."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import RigError, SettingsError, ShapeError
from pipeline.geometry.mirror import STRAIGHT, Mounting, check_reach
from pipeline.rig.device_settings import ReadBack
from pipeline.rig.devices import DeviceRefused
from pipeline.rig.mirror.mirror_requests import ProLink
from pipeline.rig.mirror.pro_mode import (
    CELL,
    VECTOR_CELLS,
    ErrorCode,
    Value,
    cell_float,
    get_vector,
    set_values,
    set_vector,
    split_cells,
)
from pipeline.rig.mirror.registers import (
    FEEDBACK_X,
    FEEDBACK_Y,
    LOG_RATE,
    LOG_RUN,
    VECTOR_MEMORY,
    VectorRegister,
    X,
    Y,
    log_slot,
)

LOG = logging.getLogger(__name__)
SAMPLED_EVERY = 10  # frames: the share that "sampled" reads back, besides the ends of both channels
_KINDS = (">f4", ">f4", ">u4")  # of the cells in the log's slots
Progress = Callable[[int, int], None]  # cells done, cells in all


def wire_positions(positions: ArrayLike, mounting: Mounting = STRAIGHT) -> NDArray[np.float32]:
    """Give positions (position, 2) at the precision of the wire, float32, where rounding carries none beyond the rim.

    They are those of the device that is mounted so, for what a straight one gets by the wire.

    Raises ShapeError where they are not of that shape, or none, and PoseError where one is not finite or beyond the
    rim; the message names the first.
    """
    given = np.asarray(positions)
    if given.ndim != 2 or given.shape[1:] != (2,) or not len(given):
        raise ShapeError(f"a path needs positions as (position, 2), at least one, got shape {given.shape}")
    exact = check_reach(given).astype(np.float64)
    exact /= np.maximum(np.hypot(exact[:, :1], exact[:, 1:]), 1)  # what the rim's slack let pass
    rounded: NDArray[np.float32] = exact.astype(np.float32)
    beyond = np.hypot(*rounded.astype(np.float64).T) > 1
    rounded[beyond] = np.nextafter(rounded[beyond], np.float32(0))
    return rounded if mounting == STRAIGHT else wire_positions(mounting.to_device(rounded))


def upload(link: ProLink, cells: bytes, read_back: ReadBack, progress: Progress | None = None) -> None:
    """Write cells, X of all positions and then Y of all, to the vector memory, and compare what it holds then.

    ``read_back`` is "none", "sampled" (every tenth frame and the ends of both channels) or "all"; ``progress`` gets
    cells done and cells in all, those read back included. RigError names a cell that holds something else.
    """
    frames = [cells[at : at + VECTOR_CELLS * CELL] for at in range(0, len(cells), VECTOR_CELLS * CELL)]
    checked = frames_to_check(len(frames), read_back)
    total = (len(cells) + sum(len(frames[number]) for number in checked)) // CELL
    done = 0

    def tell(sent: bytes) -> None:
        nonlocal done
        done += len(sent) // CELL
        if progress is not None:
            progress(done, total)

    for number, sent in enumerate(frames):
        start = number * VECTOR_CELLS
        link.tell(set_vector(VECTOR_MEMORY, start, sent), f"writing cells {start} to {start + len(sent) // CELL}")
        tell(sent)
    for number in checked:
        sent, start = frames[number], number * VECTOR_CELLS
        held = read_cells(link, VECTOR_MEMORY, start, len(sent) // CELL)
        for cell, (one, other) in enumerate(zip(split_cells(sent), split_cells(held), strict=True), start):
            if one != other:
                pairs = len(cells) // CELL // 2
                axis, position = ("X", cell) if cell < pairs else ("Y", cell - pairs)
                raise RigError(
                    f"cell {cell} of the vector memory on {link.wire.port} ({axis} of position {position}) holds "
                    f"{cell_float(other):.9g}, {cell_float(one):.9g} was sent; nothing was moved: load the path again"
                )
        tell(sent)


def frames_to_check(frames: int, read_back: ReadBack) -> list[int]:
    """Give the numbers of the frames that are read back."""
    if read_back == "none":
        return []
    if read_back == "all":
        return list(range(frames))
    half = frames // 2  # X ends and Y begins here
    ends = (0, half - 1, half, frames - 1)
    return sorted({number for number in chain(range(0, frames, SAMPLED_EVERY), ends) if 0 <= number < frames})


def read_cells(link: ProLink, register: int, start: int, count: int) -> bytes:
    """Read cells of a vector, at most as many as one frame takes."""

    def parse(payload: bytes) -> bytes:
        if len(payload) != count * CELL:
            raise ShapeError(f"expected {count} cells, got {len(payload)} bytes")
        return payload

    return link.ask(get_vector(register, start, count), f"reading cells {start} to {start + count}", parse)


def check_play(first: int, stop: int, rate_hz: float, cycles: int, loaded: int) -> None:
    """Refuse a range that is not within the ``loaded`` positions, and a rate or cycles that mean nothing."""
    if not (0 <= first < stop <= loaded):
        raise SettingsError(f"{first}:{stop} is no range of the {loaded} positions loaded; load them first")
    if not (0 < rate_hz < float("inf")) or cycles == 0 or not -1 <= cycles < 2**31:
        raise SettingsError(
            f"expected a rate above 0 Hz, and cycles of 1 or more, or -1 for no end, got {rate_hz} Hz and {cycles} "
            "cycles"
        )


def run_values() -> dict[int, Value]:
    """Registers that make both channels play, in one frame so that they begin together."""
    follow = {**X.followed(X.vector_system), **Y.followed(Y.vector_system)}
    return {**follow, X.vector(VectorRegister.RUN): 1, Y.vector(VectorRegister.RUN): 1}


def hold_values(x: float, y: float) -> dict[int, Value]:
    """Registers that send both channels to a position, hold it and end any path, in one frame, which they fill."""
    follow = {**X.followed(X.static_system), **Y.followed(Y.static_system)}
    halt = {X.vector(VectorRegister.RUN): 0, Y.vector(VectorRegister.RUN): 0}
    return {X.static_xy: float(x), Y.static_xy: float(y), **follow, **halt}


@dataclass(frozen=True)
class MotionLog:
    """Positions that the controller measured at a steady rate.

    ``started_s`` is when the start was acknowledged, by the driver's clock, and ``start_error_s`` how much earlier it
    may have been: the time of the request itself. Offset and drift against frame times are for whoever ties lines to
    positions.
    """

    position: NDArray[np.float32]  # (sample, 2) X and Y
    rate_hz: float
    started_s: float
    start_error_s: float
    index: NDArray[np.int64] | None = None  # (sample,) cell of the path that X played, where it was asked for


class Logger:
    """The logger of one controller. It takes down X in slot 0, Y in slot 1 and the cell that X plays in slot 2."""

    def __init__(self, link: ProLink, most_samples: int) -> None:
        self._link = link
        self._most = most_samples
        self._rate_hz = 0.0
        self._with_index = False
        self._started: tuple[float, float] | None = None  # before the request and after its acknowledgement

    def start(self, rate_hz: float, *, with_index: bool = False) -> None:
        """Say what to log, positions and the path's index with them or not, and begin."""
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
        RigError where no log was started.
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
