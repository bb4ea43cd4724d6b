"""From expected electrons to DN: noise by level, well and amplifier, limits of the range, and reproducible draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.counting import (
    DARK_CURRENT,
    DEFECTS,
    QUANTISATION,
    READ_NOISE,
    SATURATION,
    SHOT,
    dead_elements,
    hot_electrons,
)
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.readout import dark_frame, read_out
from spectralzoom.pipeline.simulator.rig_model import Detector, Rig

SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-32.0, lines=64)
BANDS = 20
# Read noise is 0 and wells have no limit unless a test sets them; 1 e- is 1 DN, so that DN are counts.
COUNTING = LineCamera(electrons_per_dn=1.0, bits=16, dark_dn=0.0, read_noise_e=0.0)
ALL_EXACT: dict[Any, str] = dict.fromkeys((DARK_CURRENT, DEFECTS, SHOT, READ_NOISE, SATURATION, QUANTISATION), "exact")
EVERYTHING = ALL_EXACT | {SHOT: "gaussian"}


def block_of(rig: Rig, lines: range = range(16), seed: int = 0, bands: int = BANDS) -> SweepBlock:
    """Return some lines of the sweep as a block."""
    return SweepBlock(rig, SWEEP, lines, np.linspace(400, 1000, bands), (640, 640), seed=seed)


def even(level: float, lines: int = 16, bands: int = BANDS) -> NDArray[np.float32]:
    """Return light that is the same everywhere."""
    return np.full((lines, 640, bands), level, np.float32)


def test_read_noise_alone_is_normal() -> None:
    """Without shot noise numbers are normal around the light, also below zero light."""
    camera = LineCamera(electrons_per_dn=1.0, dark_dn=500.0)
    raw = read_out(even(0), block_of(Rig(camera=camera)), {READ_NOISE: "exact"}).astype(np.float64) - 500
    unrounded = raw.ravel()[:20_000] + np.random.default_rng(0).uniform(-0.5, 0.5, 20_000)
    assert stats.kstest(unrounded, "norm", (0, 20)).pvalue > 1e-3
    assert raw.min() < -60


def test_without_effects_light_is_rounded() -> None:
    """Rounding is half to even, from the dark level upwards; negative light counts as 0."""
    light = even(0, 1)
    light[0, :6, 0] = [-50, 0, 2.5, 7.5, 12.5, 100]
    assert read_out(light, block_of(Rig(), range(1)), {})[0, :6, 0].tolist() == [64, 64, 64, 66, 66, 84]


@pytest.mark.parametrize("chosen", [{}, {SHOT: "exact"}, EVERYTHING], ids=["none", "shot", "everything"])
def test_extreme_light_gives_full_scale(chosen: dict[Any, str]) -> None:
    """Light of 1e9 e- and of 1e20 e- saturates everywhere, with saturation chosen or not."""
    for level in (1e9, 1e20):
        assert (read_out(even(level, 2), block_of(Rig(), range(2)), chosen) == 4095).all()


def test_dark_current_has_shot_noise() -> None:
    """1360 e-/s become 1360 e- in 1 s, with a variance of 1360."""
    rig = Rig(camera=replace(COUNTING, exposure_ms=1000.0), detector=Detector(dark_e_per_s=1360.0))
    counts = read_out(even(0), block_of(rig), {DARK_CURRENT: "exact", SHOT: "exact"}).astype(np.float64)
    assert counts.mean() == pytest.approx(1360, rel=1e-3)
    assert counts.var() == pytest.approx(1360, rel=0.01)


def test_dead_and_hot_elements_have_their_levels() -> None:
    """Dead ones show dark current alone, hot ones 5,000 e- more in 100 ms; the others are unchanged."""
    rig = Rig(detector=Detector(dead_fraction=0.01, hot_fraction=0.01))
    raw = read_out(even(5000, 1), block_of(rig, range(1)), {DARK_CURRENT: "exact", DEFECTS: "exact"})[0]
    dead, hot = dead_elements(rig, BANDS), hot_electrons(rig, BANDS) > 0
    assert 0.005 < dead.mean() < 0.015
    assert 0.005 < hot.mean() < 0.015
    np.testing.assert_array_equal(raw, 64 + 4 + 1000 * ~dead + 1000 * hot)


@pytest.mark.parametrize(("dark_dn", "exposure_ms"), [(64.0, 500.0), (0.0, 500.0), (2.0, 20.0)])
def test_mean_dark_frame_matches_that_of_many_lines(dark_dn: float, exposure_ms: float) -> None:
    """A capped lens shows dark level, dark current and hot elements up to full scale, and nothing below 0."""
    camera = LineCamera(exposure_ms=exposure_ms, dark_dn=dark_dn)
    rig = Rig(camera=camera, detector=Detector(hot_fraction=0.01, dead_fraction=0.01))
    block = block_of(rig, range(64))
    mean = read_out(np.zeros((64, 640, BANDS), np.float32), block, ALL_EXACT).mean(axis=0)
    expected = dark_frame(block, ALL_EXACT)
    assert (expected.max() == 4095) == (exposure_ms == 500)
    fine = expected < 4000
    sd = np.sqrt((expected - dark_dn) * 5 + 400) / 5 / 8
    assert np.abs((mean - expected) / sd)[fine].max() < 5.5
    assert abs((mean - expected)[fine].mean()) < 0.05


def test_noiseless_sensor_has_no_noise() -> None:
    """Shot noise, read noise and dark current are absent even if chosen: numbers are those without effects."""
    rig = Rig(detector=Detector(noiseless=True))
    light = np.random.default_rng(0).uniform(-100, 25_000, (4, 640, BANDS)).astype(np.float32)
    block = block_of(rig, range(4))
    np.testing.assert_array_equal(read_out(light, block, EVERYTHING), read_out(light, block, {}))


def test_other_effects_do_not_change_the_draws() -> None:
    """With read noise or dark current off, the shot noise of every element is still that of the same photons."""
    block = block_of(Rig(), range(4))
    light = even(10_000, 4)
    noise = {
        name: read_out(light, block, chosen).astype(np.float64).ravel()
        for name, chosen in {
            "both": {SHOT: "gaussian", READ_NOISE: "exact"},
            "shot": {SHOT: "gaussian"},
            "exact": {SHOT: "exact"},
            "dark": {SHOT: "gaussian", READ_NOISE: "exact", DARK_CURRENT: "exact"},
        }.items()
    }
    for name in ("shot", "exact", "dark"):
        assert np.corrcoef(noise["both"], noise[name])[0, 1] > 0.999
    assert np.abs(noise["shot"] - noise["exact"]).max() <= 1
    assert np.abs(noise["both"] - noise["shot"]).max() <= 3
    ways = ({READ_NOISE: "exact"} | others for others in ({}, {DEFECTS: "exact"}, {SATURATION: "exact"}))
    assert len({read_out(light, block, chosen).tobytes() for chosen in ways}) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_light_is_refused(value: float) -> None:
    """The message names sweep, line, sample and band of the first such value."""
    light = even(100, 4)
    light[2, 40, 3] = value
    with pytest.raises(SceneError, match=rf"sweep fine: line 12, sample 40, band 3 expects {value} electrons"):
        read_out(light, block_of(Rig(), range(10, 14)), EVERYTHING)
