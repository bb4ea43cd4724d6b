"""What steers the mirror: the protocol that device and simulated backends share, and what passes through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import ShapeError
from pipeline.geometry.mirror import STRAIGHT, Mounting, check_reach
from pipeline.rig.mirror.registers import Status, Trigger

ReadBack = Literal["none", "sampled", "all"]
Progress = Callable[[int, int], None]  # cells done, cells in all


@dataclass(frozen=True)
class Identity:
    """What a controller says it is; a field is empty where it does not know the request."""

    device: str
    version: str
    serial: str

    @property
    def words(self) -> str:
        """All of it, for people."""
        return f"{self.device or 'no id'}, version {self.version or 'unknown'}, serial {self.serial or 'unknown'}"


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

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(sample,) since the start was acknowledged. [s]"""
        return np.arange(len(self.position), dtype=np.float64) / self.rate_hz


class Steering(Protocol):
    """A mirror that can be sent somewhere, or along a path.

    Positions are X and Y of a mirror mounted straight, in the closed unit disk: a driver knows how its own is mounted.
    """

    def identity(self) -> Identity:
        """What steers it."""

    def status(self) -> Status:
        """Status bits, now."""

    def temperature(self) -> float:
        """Temperature of the mirror. [deg C]"""

    def goto(self, x: float, y: float) -> None:
        """Send the mirror to a position and hold it there; comes back once that is acknowledged."""

    def settle(self, within_s: float) -> None:
        """Wait until the mirror is at rest."""

    def load_path(
        self, positions: ArrayLike, read_back: ReadBack | None = None, progress: Progress | None = None
    ) -> None:
        """Put positions (position, 2) into the vector memory; nothing moves."""

    def run(self, first: int, stop: int, rate_hz: float, cycles: int = 1, trigger: Trigger = Trigger.OFF) -> None:
        """Play the loaded positions ``first`` to ``stop``, half open."""

    def halt(self) -> None:
        """Stop playing; the mirror stays where it is."""

    def index(self) -> int:
        """Position of the loaded path that plays now."""

    def start_log(self, rate_hz: float | None = None, *, with_index: bool = False) -> None:
        """Begin to log measured positions, and the cells that are played."""

    def read_log(self, samples: int | None = None) -> MotionLog:
        """End the log and fetch it."""

    def park(self) -> None:
        """Send the mirror to 0; 0."""

    def close(self) -> None:
        """Let go of the mirror."""


def wire_positions(positions: ArrayLike, mounting: Mounting = STRAIGHT) -> NDArray[np.float32]:
    """Give positions (position, 2) at the precision of the wire, float32, where rounding carries none beyond the rim.

    They are those of the device that is mounted so, for what a straight one gets by the wire.

    Raises
    ------
    ShapeError : not of that shape, or none.
    PoseError : a position is not finite or beyond the rim; the message names the first.
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


def as_cells(positions: NDArray[Any]) -> bytes:
    """Give the cells of a path as the vector memory holds it: X of all positions, then Y of all, big-endian."""
    return positions.T.astype(">f4").tobytes()
