"""Slit and pixel: boxes of each variant, what the probe measured, and a slit of no width."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.camera import LineCamera, footprint_kernel
from pipeline.scan import Sweep
from pipeline.simulator.block import Block
from pipeline.simulator.effects.slit import MARGIN, SLIT, box_of, box_parts
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Rig
from pipeline.simulator.scene import raster_from_values
from pipeline.simulator.survey_probe import probe_scene

RIG = Rig(camera=LineCamera(samples=64))
SWEEP = Sweep("s", "fine", "x", strip_px=0.0, start_px=-14.5, lines=30)


def test_boxes_of_every_variant() -> None:
    """The exact variant has 27 boxes, off is one without any width."""
    assert [box_parts(variant) for variant in SLIT.variants] == [(9, 3), (4, 2), (3, 1), (2, 1), (1, 1)]
    assert (box_parts("off"), box_of("off", RIG)) == ((1, 1), (0.0, 0.0))
    assert set(SLIT.cost_ns) == set(SLIT.variants)


@pytest.mark.parametrize("variant", SLIT.variants)
def test_point_is_spread_by_the_closed_form_of_the_box(variant: str) -> None:
    """Of a bright pixel, lines at pixel centres show the box over Catmull-Rom along either axis, in closed form."""
    values = np.zeros((40, 64, 1))
    values[20, 30] = 1.0
    scene = raster_from_values(values, RIG.camera, name="p", wavelength_nm=np.array([550.0]))
    block = Block(RIG, replace(SWEEP, start_px=-15.5), range(30), scene.wavelength_nm, scene.shape)
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
    scene = raster_from_values(np.random.default_rng(3).uniform(0, 1, (50, 80, 1)), RIG.camera, name="t",
                               wavelength_nm=np.array([550.0]))  # fmt: skip
    probe = probe_scene(scene, narrow, [SWEEP])
    assert np.isfinite(list(probe.slit_errors.values())).all()
    assert np.isfinite(probe.slope).all()
    block = Block(narrow, SWEEP, range(30), scene.wavelength_nm, scene.shape)
    lights = [expected_light(scene, block, {SLIT: variant}) for variant in SLIT.variants]
    np.testing.assert_allclose(lights, [lights[0]] * len(lights), atol=1e-3 * np.ptp(lights[0]))
