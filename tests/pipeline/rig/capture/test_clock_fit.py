"""Offset and drift of two clocks come out of events that both saw, some of them wrong."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import RigError, ShapeError
from pipeline.rig.capture.line_positions import fit_clocks, match_edges

ORIGIN = 1_700_000_000_000_000


def stamps(count: int, period_us: int = 10_000) -> np.ndarray:
    """Steady stamps of a camera."""
    return ORIGIN + period_us * np.arange(count)


def mirror(stamp_us: np.ndarray, drift_ppm: float = 100.0, offset_s: float = 3.25) -> np.ndarray:
    """The same moments by a clock that drifts."""
    return offset_s + (1 + drift_ppm * 1e-6) * (stamp_us - ORIGIN) * 1e-6


@pytest.mark.parametrize("drift", [-500.0, 0.0, 100.0])
def test_exact(drift: float) -> None:
    """Without noise both numbers come out to rounding, however large the stamps are."""
    fit = fit_clocks(stamps(1000), mirror(stamps(1000), drift))
    assert fit.drift_ppm == pytest.approx(drift, abs=1e-6)
    np.testing.assert_allclose(fit.mirror_s(stamps(1000)), mirror(stamps(1000), drift), atol=1e-12, rtol=0)
    assert fit.residual_us < 1e-4
    assert fit.rejected == 0


def test_quantised_by_the_log() -> None:
    """Edges known to 0.1 ms give an offset 20 times finer, and the residual says the 0.1 ms / sqrt 12."""
    rng = np.random.default_rng(0)
    true = mirror(stamps(2000)) + rng.uniform(0, 1e-4)
    fit = fit_clocks(stamps(2000), np.round(true * 1e4) / 1e4)
    assert np.abs(fit.mirror_s(stamps(2000)) - true).max() < 5e-6
    assert fit.residual_us == pytest.approx(28.9, rel=0.1)


def test_a_third_is_wrong() -> None:
    """Events off by milliseconds do not count and are counted."""
    rng = np.random.default_rng(1)
    seen = mirror(stamps(900)) + rng.normal(0, 2e-5, 900)
    wrong = rng.permutation(900)[:300]
    seen[wrong] += rng.uniform(1e-3, 4e-3, 300) * rng.choice([-1, 1], 300)
    fit = fit_clocks(stamps(900), seen)
    assert fit.drift_ppm == pytest.approx(100, abs=2)
    assert fit.rejected >= 300
    assert fit.residual_us < 25


def test_one_and_two_events() -> None:
    """One event gives an offset and no drift, two give both."""
    one = fit_clocks(stamps(1), mirror(stamps(1)))
    assert (one.drift_ppm, one.offset_s, one.residual_us) == (0.0, 3.25, 0.0)
    assert fit_clocks(stamps(2), mirror(stamps(2))).drift_ppm == pytest.approx(100, abs=1e-3)


def test_other_events() -> None:
    """A drift that no quartz has means that the events are not the same."""
    with pytest.raises(RigError, match="would drift by 20000 ppm"):
        fit_clocks(stamps(10), mirror(stamps(10), 20_000))
    with pytest.raises(ShapeError, match="at least one"):
        fit_clocks(stamps(0), mirror(stamps(0)))


@pytest.mark.parametrize(
    ("quiet_before", "quiet_after", "near"), [(1.0, 0.0, None), (0.0, 1.0, None), (0.0, 0.0, 3.252)]
)
def test_matching(quiet_before: float, quiet_after: float, near: float | None) -> None:
    """Edges find their frames over a long drift, from the log's start, its end, or a hint; the rest have none."""
    frames = np.setdiff1d(np.arange(6000), [5, 6, 900])
    edges = mirror(stamps(6000), 400)
    first, last = (0 if quiet_before else 100), (6000 if quiet_after else 5500)
    log = (edges[first] - max(quiet_before, 0.004), edges[last - 1] + max(quiet_after, 0.004))
    found = match_edges(stamps(6000)[frames], frames, edges[first:last], log_s=log, period_s=0.01, first_near_s=near)
    expected = np.where((frames >= first) & (frames < last), frames - first, -1)
    if near is not None:  # from frame 0 on the drift is followed only where there are edges
        assert np.count_nonzero(found != expected) == 0
    np.testing.assert_array_equal(found, expected)


def test_matching_without_a_start() -> None:
    """A log within the capture cannot tell which frame is which."""
    edges = mirror(stamps(100))[20:80]
    with pytest.raises(RigError, match="begins after the first frame and ends before the last"):
        match_edges(stamps(100), np.arange(100), edges, log_s=(edges[0], edges[-1]), period_s=0.01)
    with pytest.raises(RigError, match="no edge of a frame"):
        match_edges(stamps(100), np.arange(100), edges[:0], log_s=(0, 1), period_s=0.01)
