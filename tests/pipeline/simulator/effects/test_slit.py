"""Slit and pixel: boxes of each variant, what the probe measured, and a slit of no width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.camera import LineCamera, footprint_kernel
from pipeline.geometry.scan import Sweep
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import MARGIN, SLIT, box_of, box_parts
from pipeline.simulator.optics.tap_sums import fewest_parts, misplaced
from pipeline.simulator.render import expected_light, views_all_over
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scenes.image_scene import raster_from_values
from pipeline.simulator.selection.survey_probe import probe_scene

RIG = Rig(camera=LineCamera(samples=64))
SWEEP = Sweep("s", "fine", "x", strip_px=0.0, start_px=-14.5, lines=30)


def boxes(variant: str, strip: float, rig: Rig = RIG) -> tuple[int, int]:
    """Those that a variant takes for a sweep of a survey of 2560 px."""
    sweep = replace(SWEEP, strip_px=strip, start_px=-1280.0, lines=2560)
    return box_parts(variant, rig, views_all_over(rig, sweep, exact=True))


def test_counted_variants_have_their_boxes_anywhere() -> None:
    """The exact variant has 27 boxes, off is one without any width."""
    for strip in (0.0, 960.0):
        assert [boxes(variant, strip) for variant in ("9x3", "3x1", "1x1", "off")] == [(9, 3), (3, 1), (1, 1), (1, 1)]
    assert box_of("off", RIG) == (0.0, 0.0)
    assert set(SLIT.cost_ns) == set(SLIT.variants)


def test_stated_variants_take_more_boxes_the_more_lines_are_turned() -> None:
    """One in the middle, few at the outer strips, and never fewer for the smaller error."""
    strips = (0.0, 60.0, 160.0, 320.0, 640.0, 960.0)
    found = {variant: [np.prod(boxes(variant, strip)) for strip in strips] for variant in ("1-percent", "3-percent")}
    for counts in found.values():
        assert counts[0] == 1
        assert counts[-1] > 1
        assert counts == sorted(counts)
    assert (np.array(found["1-percent"]) >= found["3-percent"]).all()


def test_straight_lines_need_one_box() -> None:
    """Where rotation is off nothing is turned."""
    sweep = replace(SWEEP, strip_px=960.0)
    assert box_parts("1-percent", RIG, views_all_over(RIG, sweep, exact=False)) == (1, 1)


@pytest.mark.parametrize("width", [1.0, 2.7, 4.0])
@pytest.mark.parametrize("strip", [60.0, 320.0, 960.0])
def test_stated_share_is_kept(width: float, strip: float) -> None:
    """What the boxes misplace, worked out in closed form, is no more than the variant says."""
    views = views_all_over(RIG, replace(SWEEP, strip_px=strip, start_px=-1280.0, lines=2560), exact=True)
    for share in (0.003, 0.01, 0.03):
        parts = fewest_parts(share, (width, 1.0), views)
        shapes = zip(views.along_run, views.scan_run, views.along_turn, views.scan_turn, strict=True)
        worst = max(misplaced(parts, (width, 1.0), shape) for shape in list(shapes)[::16])
        assert worst <= 1.1 * share


@pytest.mark.parametrize("variant", SLIT.variants)
def test_point_is_spread_by_the_closed_form_of_the_box(variant: str) -> None:
    """Of a bright pixel, lines at pixel centres show the box over linear interpolation, in closed form."""
    values = np.zeros((40, 64, 1))
    values[20, 30] = 1.0
    scene = raster_from_values(values, RIG.camera, name="p", wavelength_nm=np.array([550.0]))
    block = SweepBlock(RIG, replace(SWEEP, start_px=-15.5), range(30), scene.wavelength_nm, scene.shape)
    light = expected_light(scene, block, {SLIT: variant})[..., 0] / scene.electrons[0]
    slit, pixel = footprint_kernel(RIG.camera.slit_px), footprint_kernel(1.0)
    wanted = np.outer(slit, pixel)
    down, across = len(slit) // 2, len(pixel) // 2
    got = light[16 - down : 17 + down, 30 - across : 31 + across]
    np.testing.assert_allclose(got, wanted, atol=3e-5)


def test_bound_is_what_the_probe_measured_with_a_margin() -> None:
    """Where lines are not turned one box is enough; bounds are the margin times what was measured."""
    values = np.random.default_rng(3).uniform(0, 1, (50, 80, 2))
    scene = raster_from_values(values, RIG.camera, name="t", wavelength_nm=np.array([550.0, 700.0]))
    probe = probe_scene(scene, RIG, [SWEEP])
    bounds = [SLIT.bound(probe, RIG, variant).value for variant in (*SLIT.variants, "off")]
    assert bounds[0] == 0
    assert max(bounds[1:-1]) < bounds[-1] / 10
    assert bounds[-1] == pytest.approx(MARGIN * probe.slit_errors["off"])
    assert np.isfinite(SLIT.bound(replace(probe, slit_errors={}), RIG).value)


def test_slit_of_no_width_sees_what_a_pixel_sees() -> None:
    """A zero-width slit is a line of light, its probe finite and its variants alike."""
    narrow = replace(RIG, camera=replace(RIG.camera, slit_um=0.0))
    scene = raster_from_values(
        np.random.default_rng(3).uniform(0, 1, (50, 80, 1)), RIG.camera, name="t", wavelength_nm=np.array([550.0])
    )
    probe = probe_scene(scene, narrow, [SWEEP])
    assert np.isfinite(list(probe.slit_errors.values())).all()
    assert np.isfinite(probe.slope).all()
    block = SweepBlock(narrow, SWEEP, range(30), scene.wavelength_nm, scene.shape)
    lights = [expected_light(scene, block, {SLIT: variant}) for variant in SLIT.variants]
    np.testing.assert_allclose(lights, [lights[0]] * len(lights), atol=1e-3 * np.ptp(lights[0]))
