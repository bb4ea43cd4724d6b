"""Turbulence: sizes by hand, statistics and independence of its draws, and how often its bound holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.simulator.block import Block
from pipeline.simulator.effects.turbulence import TURBULENCE, turbulence_px
from pipeline.simulator.rig_model import Air, Rig
from tests.pipeline.simulator.fine_image import IMAGES, SWEEP, change, probe_of, shifted

LONG = replace(SWEEP, lines=3000, start_px=-1500.0)


def rig_at(distance_m: float | None, **air: float) -> Rig:
    """A rig that looks through so much air."""
    return Rig(air=Air(distance_m, **air))


def drawn(lines: range, seed: int = 0, rig: Rig | None = None) -> np.ndarray:
    """Jitter of lines of the long sweep, (line, 2) [px]."""
    block = Block(rig or rig_at(300.0), LONG, lines, np.array([700.0]), (10, 10), seed=seed)
    jitter = TURBULENCE.aim(block, "jitter")
    assert jitter.shape == (len(lines), 1, 2)
    return jitter[:, 0]


@pytest.mark.parametrize(("distance", "px"), [(30.0, 0.06), (300.0, 0.19)])
def test_size(distance: float, px: float):
    """0.06 px at 30 m and 0.19 px at 300 m for Cn2 = 1e-13."""
    assert turbulence_px(rig_at(distance)) == pytest.approx(px, abs=0.005)


def test_no_air():
    """Without a distance or in calm air lines stay where they are, and the bound is 0."""
    probe = probe_of(IMAGES["edges"]())
    for rig in (rig_at(None), rig_at(300.0, turbulence_cn2=0.0)):
        assert not drawn(range(5), rig=rig).any()
        assert TURBULENCE.bound(probe, rig).value == 0


def test_statistics():
    """Zero mean, the stated deviation in both directions, and no link between them or between lines."""
    jitter = drawn(range(3000)) / turbulence_px(rig_at(300.0))
    assert jitter.mean(axis=0) == pytest.approx([0, 0], abs=0.06)
    assert jitter.std(axis=0) == pytest.approx([1, 1], abs=0.05)
    both = np.column_stack([jitter[:-1], jitter[1:]])
    assert np.abs(np.corrcoef(both.T) - np.eye(4)).max() < 0.06


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_draw_the_same(size: int):
    """A line's jitter does not depend on its block; another seed gives another."""
    whole = drawn(range(40))
    parts = [drawn(range(start, min(start + size, 40))) for start in range(0, 40, size)]
    assert np.array_equal(np.concatenate(parts), whole)
    assert not np.array_equal(drawn(range(40), seed=1), whole)


def test_bound_holds_and_is_near():
    """The line that strays farthest in each of 20 surveys changes no number by more than the bound, nor far less."""
    image, rig = IMAGES["both"](), rig_at(300.0)
    bound = TURBULENCE.bound(probe_of(image, lines=100), rig).value
    surveys = [drawn(range(100), seed) for seed in range(20)]
    worst = [jitter[np.argmax(np.hypot(*jitter.T))] for jitter in surveys]
    measured = [change(image, shifted(*way)) for way in worst]
    assert max(measured) <= bound
    assert bound / 6 < np.median(measured)


def test_risk_of_the_bound():
    """Of 20,000 surveys of 50 lines, about 20 have a line beyond the way that the bound allows."""
    rng = np.random.default_rng(3)
    ways = np.hypot(*rng.standard_normal((2, 20_000, 50))).max(axis=1)
    ramp = replace(probe_of(IMAGES["edges"](), lines=50), slope=np.array([[0.0], [1.0]]), span=np.array([np.inf]))
    allowed = TURBULENCE.bound(ramp, rig_at(300.0)).value / turbulence_px(rig_at(300.0))
    assert 8 <= np.count_nonzero(ways > allowed) <= 34
