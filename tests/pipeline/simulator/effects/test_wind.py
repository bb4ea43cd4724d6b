"""Wind in the crop: sizes, aliasing, one wave for a survey, and the bound whichever way it blows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera
from pipeline.geometry.scan import Sweep, sweep_to_scene
from pipeline.simulator.effects.air import WIND, line_to_line_px, sway_px, within_exposure_px
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.probe import Probe
from pipeline.simulator.rig_model import Air, Rig

SWEEP = Sweep("strip", "fine", "x", 0.0, -100.0, 201)
BREEZE = Air(distance_m=30.0, wind_amplitude_m=0.02, wind_hz=1.0)
CAMERA = LineCamera()


def shown(air: Air, sweep: Sweep = SWEEP, lines: range = range(201), **options: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement of the points of some lines."""
    along, scan = sweep_to_scene(sweep, CAMERA)
    taken = slice(lines.start, lines.stop)
    block = SweepBlock(Rig(air=air), sweep, lines, np.ones(1), (201, 640), **options)  # type: ignore[arg-type]
    return WIND.displaced(block, along[taken], scan[taken], "exact")


def probe(slope: tuple[float, float], span: float = 1e9) -> Probe:
    """A scene of one band, known by its slope along the line and along the scan."""
    one, none, both = np.ones(1), np.zeros(1), np.array(slope)[:, None]
    return Probe(
        "sigma", (SWEEP,), 500 * one, None, one, one, span * one, both, both, none, none, 1e4, 0.0, 1.0, 201, 20.0
    )


def test_sizes():
    """2 cm at 30 m are 6.3 px; at 1 Hz and 100 ms a line a tenth of a sway, 3.9 px from line to line."""
    assert sway_px(Rig(air=BREEZE)) == pytest.approx(6.3, abs=0.01)
    assert line_to_line_px(Rig(air=BREEZE)) == pytest.approx(2 * 6.306 * math.sin(0.1 * math.pi), abs=0.01)
    size = np.hypot(*shown(BREEZE))
    assert size.max() == pytest.approx(6.306, rel=0.01)


@pytest.mark.parametrize(("exposure_ms", "share"), [(3.0, 0.0188), (100.0, 0.618), (2000.0, 2.0)])
def test_the_smear_that_is_not_modelled_is_told(exposure_ms: float, share: float):
    """Little of the sway in 3 ms, most of it in 100 ms, all of its way in 2 s; the reason gives the px."""
    rig = Rig(camera=LineCamera(exposure_ms=exposure_ms), air=BREEZE)
    assert within_exposure_px(rig) == pytest.approx(share * sway_px(rig), rel=5e-3)
    assert (
        f"up to {within_exposure_px(rig):.2g} px of smear within an exposure" in WIND.bound(probe((1.0, 1.0)), rig).why
    )


def test_lines_follow_the_wave_and_no_faster():
    """From line to line the crop moves by no more than stated, and by nearly that somewhere."""
    along, scan = shown(BREEZE)
    moved = np.hypot(np.diff(along[:, 320]), np.diff(scan[:, 320])).max()
    assert 0.9 * line_to_line_px(Rig(air=BREEZE)) < moved < 1.01 * line_to_line_px(Rig(air=BREEZE))


def test_fast_sways_are_aliased():
    """A sway of 11 Hz seen at 10 lines a second is one of 1 Hz; the reason says that lines cannot follow."""
    slow, fast = shown(BREEZE), shown(replace(BREEZE, wind_hz=11.0))
    phase = 2 * np.pi * 10 * CAMERA.exposure_ms / 2e3  # by the middle of the first exposure
    assert phase == pytest.approx(np.pi)
    np.testing.assert_allclose(fast, -np.asarray(slow), atol=1e-9)
    assert "too fast" in WIND.bound(probe((1.0, 1.0)), Rig(air=replace(BREEZE, wind_hz=11.0))).why
    assert "too fast" not in WIND.bound(probe((1.0, 1.0)), Rig(air=BREEZE)).why


def test_one_wave_for_all_sweeps():
    """Sweeps of other names and either axis see the same crop at the same place and time; another seed does not."""
    point = np.array([[40.0]]), np.array([[-25.0]])
    line = replace(SWEEP, lines=1)
    seen = WIND.displaced(SweepBlock(Rig(air=BREEZE), line, range(1), np.ones(1), (201, 640)), *point, "exact")
    across = replace(line, name="other", along="y")
    turned = WIND.displaced(
        SweepBlock(Rig(air=BREEZE), across, range(1), np.ones(1), (201, 640)), *point[::-1], "exact"
    )
    np.testing.assert_allclose(turned[::-1], seen)
    assert not np.allclose(shown(BREEZE, seed=3), shown(BREEZE))


@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_change_lines(size: int):
    """Lines are bit for bit the same in blocks of any size."""
    parts = [shown(BREEZE, lines=range(a, min(a + size, 201))) for a in range(0, 201, size)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), np.stack(shown(BREEZE)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("amplitude_m", [0.001, 0.1])
def test_bound_holds_and_is_tight(seed: int, amplitude_m: float):
    """The change of crossed waves is below the bound and at least a sixth of it, whichever way the wind blows."""
    air = replace(BREEZE, wind_amplitude_m=amplitude_m)
    along, scan = shown(air, seed=seed)
    x, y = sweep_to_scene(SWEEP, CAMERA)
    change = np.abs(np.sin((x + along) / 3) + np.sin((y + scan) / 4) - np.sin(x / 3) - np.sin(y / 4)).max()
    bound = WIND.bound(probe((1 / 3, 1 / 4), span=4.0), Rig(air=air)).value
    assert change <= bound <= 6 * change


@pytest.mark.parametrize(
    "air", [Air(), Air(distance_m=30.0), replace(BREEZE, distance_m=None), replace(BREEZE, distance_m=math.inf)]
)
def test_nothing_when_calm(air: Air):
    """Calm air, a scene without a distance or infinitely far: no motion and no bound."""
    assert WIND.bound(probe((5.0, 5.0)), Rig(air=air)).value == 0
    assert not np.any(shown(air))


def test_a_flat_scene_does_not_show_wind():
    """Without a slope nothing changes; a wind that stands leans the crop and stays finite."""
    assert WIND.bound(probe((0.0, 0.0)), Rig(air=BREEZE)).value == 0
    assert np.isfinite(shown(replace(BREEZE, wind_hz=0.0))).all()
