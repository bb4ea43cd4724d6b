"""Turbulence: sizes by hand, statistics and independence of its draws, and how often its bound holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j0

from pipeline.simulator.effects.air import TURBULENCE, rytov_variance, turbulence_px
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.rig_model import Air, Optics, Rig
from tests.pipeline.simulator.fine_image import IMAGES, SWEEP, change, probe_of, shifted

LONG = replace(SWEEP, lines=3000, start_px=-1500.0)


def rig_at(distance_m: float | None, **air: float) -> Rig:
    """A rig that looks through so much air."""
    return Rig(air=Air(distance_m, **air))


def drawn(lines: range, seed: int = 0, rig: Rig | None = None) -> np.ndarray:
    """Jitter of lines of the long sweep, (line, 2) [px]."""
    block = SweepBlock(rig or rig_at(300.0), LONG, lines, np.array([700.0]), (10, 10), seed=seed)
    jitter = TURBULENCE.aim(block, "jitter")
    assert jitter.shape == (len(lines), 1, 2)
    return jitter[:, 0]


@pytest.mark.parametrize(("distance", "px"), [(30.0, 0.0365), (300.0, 0.1154)])
def test_size_by_hand(distance: float, px: float):
    """sqrt(1.09 1e-13 d 4.551) / 105.7 urad, where 10.6 mm to the power -1/3 are 4.551: 3.86 urad at 30 m."""
    assert turbulence_px(rig_at(distance)) == pytest.approx(px, abs=1e-4)


def test_size_by_the_structure_function():
    """Its square is the phase's structure function at D over (k D)^2, summed along the way by the spectrum itself.

    8 pi^2 k^2 dz Phi (1 - J0(kappa D z / d)) kappa dkappa, Phi = 0.033 Cn2 kappa^(-11/3): spherical waves from z = 0.
    """
    kappa = np.geomspace(1e-4, 1e7, 40_000)  # 1/m
    place = (np.arange(64) + 0.5) / 64
    d, cn2, aperture = 120.0, 1e-14, 0.015 * np.sqrt(0.5)
    spectrum = 0.033 * cn2 * kappa ** (-8 / 3) * (1 - j0(kappa * aperture * place[:, None]))
    variance = 8 * np.pi**2 * d * np.trapezoid(spectrum, kappa, axis=1).mean() / aperture**2
    rig = rig_at(d, turbulence_cn2=cn2)
    assert (turbulence_px(rig) * rig.camera.ifov_rad) ** 2 == pytest.approx(variance, rel=5e-3)


def test_size_by_frieds_parameter():
    """6.88 (D / r0)^(5/3) / (k D)^2, with r0 of spherical waves (8/3)^(3/5) times (0.423 k^2 Cn2 d)^(-3/5)."""
    d, cn2, aperture, k = 250.0, 3e-14, 0.015 * np.sqrt(0.5), 2 * np.pi / 600e-9
    r0 = (8 / 3) ** (3 / 5) * (0.423 * k**2 * cn2 * d) ** (-3 / 5)
    rig = rig_at(d, turbulence_cn2=cn2)
    radians = np.sqrt(6.88 * (aperture / r0) ** (5 / 3)) / (k * aperture)
    assert turbulence_px(rig) * rig.camera.ifov_rad == pytest.approx(radians, rel=2e-3)


@given(st.floats(1.0, 1e4), st.floats(1e-17, 1e-12), st.floats(1.1, 10.0))
def test_how_it_grows(distance: float, cn2: float, times: float):
    """As the root of the way and of Cn2, and it shrinks as the sixth root of the aperture."""
    one = turbulence_px(rig_at(distance, turbulence_cn2=cn2))
    assert turbulence_px(rig_at(distance * times, turbulence_cn2=cn2)) == pytest.approx(one * times**0.5)
    assert turbulence_px(rig_at(distance, turbulence_cn2=cn2 * times)) == pytest.approx(one * times**0.5)
    wide = replace(rig_at(distance, turbulence_cn2=cn2), optics=Optics(aperture_mm=15.0 * times))
    assert turbulence_px(wide) == pytest.approx(one * times ** (-1 / 6))


def test_strong_turbulence_is_said():
    """The law is of weak turbulence: where it is strong the manifest calls it a guess. 0.5 1e-12 k^(7/6) 300^(11/6)."""
    probe, strong = probe_of(IMAGES["edges"]()), rig_at(300.0, turbulence_cn2=1e-12)
    k = 2 * np.pi / 550e-9
    assert rytov_variance(strong, 550.0) == pytest.approx(0.5e-12 * k ** (7 / 6) * 300 ** (11 / 6))
    assert "beyond weak turbulence (Rytov variance" in TURBULENCE.bound(probe, strong).why
    assert "Rytov" not in TURBULENCE.bound(probe, rig_at(100.0)).why


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
