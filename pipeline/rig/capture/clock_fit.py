"""Two clocks that saw the same events: time offset and drift by robust least squares, and which event is which.

The camera stamps its frames in whole microseconds of its own clock, the mirror's logger counts samples at 10 kHz of
its own. Where the logger also takes down the frames' edges (the vector index under an external trigger, or a pulse at
an input), each edge and its frame are one event.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import RigError, ShapeError

Floats = NDArray[Any]  # float64
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MOST_DRIFT_PPM = 1000.0  # of two quartz clocks, generously; more means that the wrong events were matched
LEAST_SCALE_S = 1e-6  # stamps are whole microseconds
_TUKEY = 4.685  # 95 % efficient where the errors are normal
_TO_SIGMA = 1.4826
_ROUNDS = 30
_NEAR = 64  # edges around a hint
_BLOCK = 256  # frames matched before the offset is looked at again


@dataclass(frozen=True)
class ClockFit:
    """The mirror's time of a camera stamp: offset at ``origin_us``, and how much faster the camera's seconds pass."""

    origin_us: int
    offset_s: float
    drift_ppm: float
    residual_us: float  # rms of the events that count
    worst_us: float  # of the events that count
    events: int
    rejected: int  # events too far off to count

    def mirror_s(self, stamp_us: Ints) -> Floats:
        """Mirror's time of camera stamps. [s]"""
        return self.offset_s + (1 + self.drift_ppm * 1e-6) * ((stamp_us - self.origin_us) * 1e-6)


def fit_clocks(stamp_us: Ints, mirror_s: Floats) -> ClockFit:
    """Fit offset and drift to events that both clocks saw.

    A line through medians, then least squares with Tukey's weights; one event gives an offset alone.

    Parameters
    ----------
    stamp_us
        (event,) camera stamps. [us]
    mirror_s
        (event,) times of the same events by the mirror's clock. [s]

    Raises
    ------
    ShapeError : there is no event, or the two are not of one length.
    RigError : the drift is above 1000 ppm, so these are not the same events.
    """
    if stamp_us.ndim != 1 or stamp_us.shape != mirror_s.shape or not len(stamp_us):
        raise ShapeError(f"expected as many stamps as times, at least one, got {stamp_us.shape} and {mirror_s.shape}")
    origin = int(np.sort(stamp_us)[len(stamp_us) // 2])
    camera = (stamp_us - origin) * 1e-6  # differences of whole numbers first: stamps may be larger than 2^53
    slope, offset = _median_line(camera, mirror_s - camera)
    weight = np.ones(len(camera))
    for _ in range(_ROUNDS):
        off = mirror_s - camera - (offset + slope * camera)
        before = weight
        weight = _tukey(off)
        slope, offset = _weighted_line(camera, mirror_s - camera, weight)
        if np.allclose(weight, before, rtol=0, atol=1e-9):
            break
    if abs(slope) * 1e6 > MOST_DRIFT_PPM:
        raise RigError(
            f"the camera's and the mirror's clocks would drift by {slope * 1e6:.0f} ppm, more than {MOST_DRIFT_PPM:g}: "
            f"the {len(camera)} events are not the same ones; look at the trigger's cable and its edge"
        )
    off = (mirror_s - camera - (offset + slope * camera)) * 1e6
    kept = off[weight > 0]
    freedom = max(len(kept) - min(len(kept) - 1, 2), 1)
    return ClockFit(
        origin_us=origin,
        offset_s=offset,
        drift_ppm=slope * 1e6,
        residual_us=float(np.sqrt(np.sum(kept**2) / freedom)),
        worst_us=float(np.abs(kept).max()),
        events=len(camera),
        rejected=len(camera) - len(kept),
    )


def match_edges(
    stamp_us: Ints, number: Ints, edge_s: Floats, *, log_s: tuple[float, float], period_s: float,
    first_near_s: float | None = None,
) -> Ints:  # fmt: skip
    """Say which edge each frame belongs to.

    Frames repeat at a steady rate, so one frame's edge must be known: the first edge is that of frame 0 where the log
    was quiet before, the last is the last frame's where it is quiet after; else ``first_near_s`` must say it.

    Parameters
    ----------
    stamp_us, number
        (frame,) stamps that never go back, and numbers from the start of the capture; numbers may have gaps.
    edge_s
        (edge,) in order, by the mirror's clock.
    log_s
        From when to when the log runs.
    period_s
        Frame period.
    first_near_s
        When frame 0 was, within less than half a period.

    Returns
    -------
    (frame,) number of the edge; -1 where there is none within half a period.

    Raises
    ------
    RigError : there is no edge, or nothing tells which frame one belongs to.
    """
    if not len(edge_s):
        raise RigError("the log holds no edge of a frame; is the trigger's cable in, and was the log on?")
    after = (stamp_us - stamp_us[0]) * 1e-6 + number[0] * period_s  # frame 0 would be at 0
    offset = _first_offset(after, edge_s, log_s, period_s, first_near_s)
    order = range(0, len(after), _BLOCK)
    backwards = offset < log_s[0] and after[-1] + offset <= log_s[1]  # the log has the end, so begin there
    found = np.full(len(after), -1, np.int64)
    for start in reversed(order) if backwards else order:
        block = slice(start, start + _BLOCK)
        found[block], near = _nearest(after[block] + offset, edge_s, period_s)
        if len(near):
            offset += float(np.median(near))
    return found


def _first_offset(
    after: Floats, edge_s: Floats, log_s: tuple[float, float], period_s: float, first_near_s: float | None
) -> float:
    """When frame 0 was, by the mirror's clock."""
    if edge_s[0] - log_s[0] > 1.5 * period_s:
        return float(edge_s[0])
    if log_s[1] - edge_s[-1] > 1.5 * period_s:
        return float(edge_s[-1] - after[-1])
    if first_near_s is None:
        raise RigError(
            f"the log ({log_s[1] - log_s[0]:.4g} s) begins after the first frame and ends before the last, so which of "
            "its edges is which frame is not known; start the log before the capture, or say when the first frame was"
        )
    begin = int(np.clip(np.searchsorted(edge_s, first_near_s) - _NEAR // 2, 0, max(len(edge_s) - _NEAR, 0)))
    near = edge_s[begin : begin + _NEAR]
    phase = float(np.median((near - first_near_s + period_s / 2) % period_s - period_s / 2))
    return first_near_s + phase


def _nearest(at_s: Floats, edge_s: Floats, period_s: float) -> tuple[Ints, Floats]:
    """Edge nearest to each time, -1 beyond half a period, and how far off those found are."""
    right = np.clip(np.searchsorted(edge_s, at_s), 1, max(len(edge_s) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(edge_s) - 1)
    edge = np.where(np.abs(edge_s[right] - at_s) < np.abs(edge_s[left] - at_s), right, left)
    off = edge_s[edge] - at_s
    near = np.abs(off) < period_s / 2
    return np.where(near, edge, -1), off[near]


def _median_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and offset by medians: slopes over half the events each, so that noise counts little."""
    half = len(x) // 2
    span = x[half:] - x[: len(x) - half] if half else np.zeros(0)
    rise = y[half:] - y[: len(y) - half] if half else np.zeros(0)
    apart = span != 0
    slope = float(np.median(rise[apart] / span[apart])) if apart.any() else 0.0
    return slope, float(np.median(y - slope * x))


def _tukey(off: Floats) -> Floats:
    scale = max(_TO_SIGMA * float(np.median(np.abs(off))), LEAST_SCALE_S)
    weight: Floats = np.clip(1 - (off / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return weight


def _weighted_line(x: Floats, y: Floats, weight: Floats) -> tuple[float, float]:
    total = weight.sum()
    x0, y0 = float(weight @ x / total), float(weight @ y / total)
    spread = float(weight @ (x - x0) ** 2)
    slope = float(weight @ ((x - x0) * (y - y0))) / spread if spread > 0 else 0.0
    return slope, y0 - slope * x0
