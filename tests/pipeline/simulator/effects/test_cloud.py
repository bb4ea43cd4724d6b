"""Cloud shadow: its edge, its way over the scene, its bound, and blocks and sweeps that do not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulator.effects.lighting import CLOUD, EDGE_SHARE, shadow
from tests.pipeline.simulator.outdoors import SWEEP, block_of, measured, probe_of, rig_with

SIZE = 300.0
RIG = rig_with(cloud_share=0.6, cloud_size_px=SIZE)


def test_a_shadow_by_hand() -> None:
    """Full in the middle, none between two, a half in the middle of an edge."""
    np.testing.assert_allclose(shadow(np.array([0, 150, 300, 450, 600.0]), SIZE), [1, 0.5, 0, 0.5, 1], atol=1e-12)


@given(way=st.floats(-1e6, 1e6), size=st.floats(1, 1e5))
def test_shadows_are_soft_and_come_again(way: float, size: float) -> None:
    """Between 0 and 1, even about the middle, with a period of two sizes and a slope of at most 1.5 over the edge."""
    step = 1e-3 * size
    here, there = shadow(np.array([way, way + step]), size)
    assert 0 <= here <= 1
    assert abs(there - here) <= 1.5 / EDGE_SHARE * 1e-3 + 1e-6
    assert shadow(np.array([-way]), size)[0] == pytest.approx(here, abs=1e-6)
    assert shadow(np.array([way + 2 * size]), size)[0] == pytest.approx(here, abs=1e-6)


def test_clear_sky() -> None:
    """A cloud that takes no light is none."""
    rig = rig_with(cloud_size_px=SIZE)
    assert CLOUD.bound(probe_of(rig), rig).value == 0
    assert (CLOUD.gain(block_of(rig), "shadow") == 1).all()


def test_bound_holds_and_is_near() -> None:
    """Wherever the shadow is, the change is within the bound; under its middle it is the bound."""
    bound = CLOUD.bound(probe_of(RIG), RIG).value
    looks = [measured(CLOUD, RIG, seed=seed) for seed in range(4)]
    assert max(looks) == pytest.approx(bound, rel=1e-6)
    assert CLOUD.bound(probe_of(RIG), RIG, "shadow").value == 0


def test_shadow_moves_at_its_speed() -> None:
    """Where a shadow is, it has come by its speed: a later line sees what another place saw before."""
    still, quick = (rig_with(cloud_share=0.6, cloud_size_px=SIZE, cloud_px_per_s=speed) for speed in (0.0, 50.0))
    now, later = (CLOUD.gain(block_of(quick, range(1), started_s=start), "shadow") for start in (0.0, 12.0))
    np.testing.assert_allclose(now, later, atol=1e-5)  # 12 s at 50 px/s are one period
    assert np.abs(now - CLOUD.gain(block_of(quick, range(1), started_s=3.0), "shadow")).max() > 0.1
    first, last = (CLOUD.gain(block_of(still, range(1), started_s=start), "shadow") for start in (0.0, 12.3))
    np.testing.assert_array_equal(first, last)


def test_crossing_sweeps_see_the_same_shadow() -> None:
    """Two sweeps of any name that cross see the same light where and when they do."""
    along_x = replace(SWEEP, name="a", strip_px=0.0, start_px=0.0)
    along_y = replace(SWEEP, name="b", along="y", strip_px=0.0, start_px=0.0)
    seen = [
        CLOUD.gain(block_of(RIG, range(1), sweep=sweep), "shadow")[0, 319:321].mean() for sweep in (along_x, along_y)
    ]
    assert seen[0] == pytest.approx(seen[1], abs=1e-6)


def test_the_seed_decides() -> None:
    """Other seeds, other clouds; the same seed, the same."""
    one, same, other = (CLOUD.gain(block_of(RIG, seed=seed), "shadow") for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.1


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_matter(size: int) -> None:
    """Lines and samples have the same light in blocks of any size."""
    whole = CLOUD.gain(block_of(RIG), "shadow")
    parts = [CLOUD.gain(block_of(RIG, range(start, min(start + size, 60))), "shadow") for start in range(0, 60, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_array_equal(CLOUD.gain(block_of(RIG, samples=range(100, 107)), "shadow"), whole[:, 100:107])
