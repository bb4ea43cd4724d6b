"""Blurs: moments by hand, contrast through the renderer, and bounds against real convolution."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import SettingsError
from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DEFOCUS, DIFFRACTION, defocus_px, keystone_shift
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import SLIT
from spectralzoom.pipeline.simulator.optics.kernel_fit import disc_contrast
from spectralzoom.pipeline.simulator.optics.rays import pupil_contrast
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Air, Optics, Rig
from tests.pipeline.simulator.made_up_effects import steep_probe
from tests.pipeline.simulator.small_scenes import made_scene


def test_blur_bounds_are_reached_on_a_ridge():
    """At the top of a ridge a blur takes slope times mean displacement of the light: no bound may be smaller."""
    ridge = steep_probe((3.0, 0.0), curvature=(1e9, 0.0))
    x = np.linspace(-1, 1, 200_001)
    gauss, half_disc = np.exp(-((8 * x) ** 2) / 2), np.sqrt(1 - x**2)
    by_lens = 3.0 * 0.4 * np.average(np.abs(8 * x), weights=gauss)
    assert ABERRATION.bound(ridge, Rig(optics=Optics(aberration_px=0.4))).value == pytest.approx(by_lens, rel=1e-4)
    radius = defocus_px(rig_at(30.0), 30.0)[0] / 2
    by_disc = 3.0 * radius * np.average(np.abs(x), weights=half_disc)
    assert DEFOCUS.bound(ridge, rig_at(30.0)).value == pytest.approx(by_disc, rel=1e-3)


NM = np.array([700.0])


def rig_at(distance_m: float | None, focus_m: float = math.inf, **air: float) -> Rig:
    """Return a rig with the scene at one distance and the focus at another."""
    return Rig(optics=Optics(focus_m=focus_m), air=Air(distance_m, **air))


def test_defocus_at_30_m_matches_hand_calculation():
    """Focused at infinity, 10.6 mm of pupil make 3.3 px along the scan, and 15 mm make 4.7 px along the line."""
    assert defocus_px(rig_at(30.0), 30.0) == pytest.approx([4.73, 3.34], abs=0.005)
    variance = DEFOCUS.moments(rig_at(30.0), NM, "disc").spread[:, 0]
    assert variance == pytest.approx(np.array([4.73, 3.344]) ** 2 / 16, rel=1e-3)


def test_scene_far_out_of_focus_is_refused():
    """A disc of thousands of pixels would take terabytes; at most 256 px are allowed."""
    with pytest.raises(
        SettingsError, match=r"0.001 m, with the focus at inf m, is blurred over 1\d{5} px; at most 256"
    ):
        defocus_px(rig_at(1e-3), 1e-3)


def test_defocus_disc_narrows_at_grazing_incidence():
    """At 70 deg of incidence the disc is 0.34 as wide along the scan as along the line."""
    normal = np.array([np.sin(np.deg2rad(70)), 0, -np.cos(np.deg2rad(70))])
    disc = DEFOCUS.moments(rig_at(30.0), NM, "disc", normal).disc
    assert disc == pytest.approx([4.73, 4.73 * np.cos(np.deg2rad(70))], abs=0.005)


@pytest.mark.parametrize(("distance", "focus"), [(None, 30.0), (30.0, 30.0), (math.inf, math.inf)])
def test_scene_in_focus_or_without_distance_has_no_defocus(distance: float | None, focus: float):
    """Blur and bound are 0; infinity minus infinity gives no NaN."""
    rig = rig_at(distance, focus)
    assert not DEFOCUS.moments(rig, NM, "disc").spread.any()
    assert DEFOCUS.bound(steep_probe((1.0, 1.0)), rig).value == 0


@given(st.floats(0, 3), st.floats(400, 1000))
def test_keystone_shift_is_linear_over_wavelength(keystone: float, nm: float):
    """The shift is -k/2 at 400 nm, 0 at 700 and k/2 at 1000; a band's shift does not depend on other bands."""
    rig = Rig(optics=Optics(keystone_px=keystone))
    shift = keystone_shift(rig, np.array([400.0, 700.0, 1000.0, nm]))
    assert shift[:3] == pytest.approx([-keystone / 2, 0, keystone / 2])
    assert shift[3] == pytest.approx(keystone * (nm - 700) / 600, abs=1e-12)
    assert keystone_shift(rig, np.array([nm])) == pytest.approx(shift[3])


def test_keystone_shift_is_constant_beyond_the_spectrograph():
    """Bands of other sensors, outside of 400 to 1000 nm, are shifted like the first or last band."""
    rig = Rig(optics=Optics(keystone_px=0.4))
    assert keystone_shift(rig, np.array([300.0, 2500.0])) == pytest.approx([-0.2, 0.2])


RENDERED_BLURS_NM = np.array([400.0, 600.0, 1000.0])
RIG = Rig(optics=Optics(aberration_px=0.3, keystone_px=0.4), air=Air(distance_m=120.0))
WAVES_SWEEP = Sweep("fine", "fine", "x", swath_px=0.0, start_px=-20.0, lines=40)


@pytest.mark.parametrize("blur", [DIFFRACTION, DEFOCUS, ABERRATION], ids=lambda blur: blur.name)
def test_rendered_contrast_matches_that_of_the_blur(blur: Any):
    """A wave of 16 px along the scan keeps the contrast of the blur's Gaussian, disc or pupil.

    The Gaussian keeps exp(-2 pi^2 s^2 / 16^2) of the contrast that the footprint leaves.
    """
    wave = 1 + np.cos(2 * np.pi * (np.arange(120) - 59.5) / 16)
    electrons = np.full((1, 3), 1000.0, np.float32)
    scene = made_scene(np.repeat(wave[:, None, None], 60, axis=1).astype(np.float32), electrons, RENDERED_BLURS_NM)
    block = SweepBlock(RIG, WAVES_SWEEP, range(40), RENDERED_BLURS_NM, scene.shape)
    ways: list[dict[Any, str]] = [{SLIT: "3x1"}, {SLIT: "3x1", blur: blur.variants[0]}]
    before, after = (expected_light(scene, block, chosen)[:, 310:330] for chosen in ways)
    moments = blur.moments(RIG, RENDERED_BLURS_NM, blur.variants[0])
    passed = np.exp(-2 * np.pi**2 * moments.variance[1] / 16**2)
    passed = passed * disc_contrast(np.zeros(1), np.full(1, 1 / 16), moments.disc)
    if moments.waves is not None:
        passed = passed * pupil_contrast(moments.waves[1] / 16)
    assert np.ptp(after, axis=(0, 1)) / np.ptp(before, axis=(0, 1)) == pytest.approx(passed, abs=1.5e-3)
