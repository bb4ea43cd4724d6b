"""Defocus: discs by hand, the limits of distance, and the bound against real convolution."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulator.effects.blurs import DEFOCUS, defocus_px
from pipeline.simulator.rig_model import Air, Optics, Rig
from tests.pipeline.simulator.fine_image import IMAGES, change, disc, gaussian, probe_of

NM = np.array([700.0])


def rig_at(distance_m: float | None, focus_m: float = math.inf, **air: float) -> Rig:
    """A rig that looks at a distance and is focused at another."""
    return Rig(optics=Optics(focus_m=focus_m), air=Air(distance_m, **air))


def test_disc_at_30_m():
    """Focused at infinity, 10.6 mm of pupil make 3.3 px along the scan, and 15 mm make 4.7 px along the line."""
    assert defocus_px(rig_at(30.0), 30.0) == pytest.approx([4.73, 3.34], abs=0.005)
    variance = DEFOCUS.moments(rig_at(30.0), NM, "disc").variance[:, 0]
    assert variance == pytest.approx(np.array([4.73, 3.344]) ** 2 / 16, rel=1e-3)


def test_disc_at_grazing_incidence():
    """At 70 deg of incidence the disc is 0.34 as wide along the scan as along the line."""
    normal = np.array([np.sin(np.deg2rad(70)), 0, -np.cos(np.deg2rad(70))])
    along, scan = np.sqrt(DEFOCUS.moments(rig_at(30.0), NM, "disc", normal).variance[:, 0] * 16)
    assert [along, scan] == pytest.approx([4.73, 4.73 * np.cos(np.deg2rad(70))], abs=0.005)


@given(st.floats(0.5, 1e6), st.floats(0.5, 1e6))
def test_nearer_and_farther_blur_alike(distance: float, focus: float):
    """The disc depends on |1/d - 1/d_f| alone: distance and focus may change places."""
    there, back = defocus_px(rig_at(distance, focus), distance), defocus_px(rig_at(focus, distance), focus)
    assert there == pytest.approx(back)


@pytest.mark.parametrize(("distance", "focus"), [(None, 30.0), (30.0, 30.0), (math.inf, math.inf)])
def test_in_focus_or_without_distance(distance: float | None, focus: float):
    """No blur and a bound of 0, no NaN from infinity less infinity."""
    rig = rig_at(distance, focus)
    assert not DEFOCUS.moments(rig, NM, "disc").variance.any()
    assert DEFOCUS.bound(probe_of(IMAGES["edges"]()), rig).value == 0


def test_far_away_is_in_focus():
    """1/d goes to 0 without a jump."""
    sizes = [defocus_px(rig_at(d), d)[1] for d in (1e3, 1e6, 1e12, 1e300, math.inf)]
    assert sizes[0] == pytest.approx(0.1, abs=0.001)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 0


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("distance", [60.0, 150.0])
def test_bound_holds_for_disc_and_fold(name: str, distance: float):
    """Neither the real disc nor the Gaussian of its variance changes an image by more; both come within 6x of it."""
    image, rig = IMAGES[name](), rig_at(distance)
    bound = DEFOCUS.bound(probe_of(image), rig).value
    axes = defocus_px(rig, distance)
    measured = [change(image, disc(*axes)), change(image, gaussian(*axes / 4))]
    assert max(measured) <= bound + 1e-9
    assert min(measured) >= bound / 6


def test_bound_is_that_of_the_one_distance_that_is_computed():
    """A nearest part at 100 m does not count: switched on, the blur would not be that of 100 m there."""
    probe = probe_of(IMAGES["texture"]())
    plain, deep = (DEFOCUS.bound(probe, rig).value for rig in (rig_at(200.0), rig_at(200.0, nearest_m=100.0)))
    assert deep == plain


def test_the_sentence_tells_distance_and_size():
    """Why: from where to where, and the blur in px."""
    why = DEFOCUS.bound(probe_of(IMAGES["edges"]()), rig_at(30.0)).why
    assert why.startswith("defocus at 30 m, focused at inf m: 1.2 px (sd) along the line, 0.84 px along the scan")
