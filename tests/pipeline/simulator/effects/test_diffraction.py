"""Diffraction: widths, contrast, the kernels that model it, and the reference that sums all waves of a pupil."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0, j1

from spectralzoom.pipeline.geometry.scan import Sweep
from spectralzoom.pipeline.simulator.effects.blurs import ABERRATION, DIFFRACTION, KEYSTONE
from spectralzoom.pipeline.simulator.effects.effect import SweepBlock
from spectralzoom.pipeline.simulator.effects.line import SLIT
from spectralzoom.pipeline.simulator.optics.kernel_fit import Moments, fold
from spectralzoom.pipeline.simulator.optics.rays import pupil_contrast
from spectralzoom.pipeline.simulator.render import expected_light
from spectralzoom.pipeline.simulator.rig_model import Optics, Rig
from tests.pipeline.simulator.made_up_effects import SWEEP, steep_probe
from tests.pipeline.simulator.pupil_reference import distances, random_tile
from tests.pipeline.simulator.small_scenes import made_scene

RIG = Rig()
NM = np.array([400.0, 700.0, 1000.0])
RADIAN_PX = NM * 1e-9 / 15e-3 / RIG.camera.ifov_rad  # lambda / D


def test_airy_widths_at_rest_match_hand_calculation():
    """With 10.6 mm along the scan, widths are 0.37 px at 400 nm and 0.92 px at 1000; along the line 0.71 of it."""
    waves = DIFFRACTION.moments(RIG, NM, "airy").waves
    along, scan = 1.029 * waves  # full widths at half maximum of the pattern, of the wavelength over the pupil's widths
    assert scan[[0, 2]] == pytest.approx([0.37, 0.92], abs=0.005)
    assert along == pytest.approx(scan * np.sqrt(0.5))


@pytest.mark.parametrize("u", [0.02, 0.1, 0.3, 0.6, 0.95])
def test_contrast_of_the_pupil_is_the_transform_of_its_pattern(u: float):
    """The closed form is Hankel's transform of the Airy pattern, summed out to 600 rings."""
    v = np.arange(1, 400_000) * 0.005
    pattern = 2 * j1(v) ** 2 / v
    assert pupil_contrast(np.array(u)) == pytest.approx((pattern * j0(2 * u * v)).sum() * 0.005, abs=3e-4)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("cycles", [0.02, 0.1, 0.15, 0.2, 0.35])
def test_rendered_waves_have_the_contrast_of_the_pupil(axis: int, cycles: float):
    """Every sample shows the wave that pupil, slit, pixel and linear interpolation leave, to 0.0015.

    Interpolation adds fainter waves of whole cycles per px more and less; each passes the pupil as well.
    """
    wave = 1 + np.cos(2 * np.pi * cycles * (np.arange(900) - 449.5))
    planes = np.ones((900, 900, 1), np.float32) * (wave[:, None, None] if axis == 0 else wave[None, :, None])
    scene = made_scene(planes, np.ones((1, 3)), NM)
    sweep = Sweep("s", "fine", "x", swath_px=0.0, start_px=-20.0, lines=40)
    block = SweepBlock(RIG, sweep, range(40), NM, scene.shape)
    found = expected_light(scene, block, {SLIT: "1x1", DIFFRACTION: "airy"})[:, 300:340]
    place = (np.arange(-20.0, 20.0) if axis == 0 else block.slopes[300:340] / RIG.camera.ifov_rad)[:, None]
    box, width = (RIG.camera.slit_px, np.sqrt(2)) if axis == 0 else (1.0, 1.0)
    wanted = np.ones((40, 3))
    for more in range(-4, 5):
        f = cycles + more
        left = np.sinc(f) ** 2 * np.sinc(f * box) * pupil_contrast(np.abs(f) * RADIAN_PX * width)
        # pixels lie half a px off the middle, where the wave has its crest
        wanted += left * np.cos(2 * np.pi * (cycles * place + more * (place + 0.5)))
    np.testing.assert_allclose(found.mean(axis=1 - axis), wanted, atol=1.5e-3)


@pytest.mark.parametrize("aperture_mm", [12.0, 15.0, 25.0])
@pytest.mark.parametrize("keystone_px", [0.0, 0.15])
def test_few_kernels_have_the_contrast_of_the_pupil(aperture_mm: float, keystone_px: float):
    """In 60 bands no wave errs by more than 0.002, 0.0017 from 0.1 to 0.2 cycles per px, and 0.0008 below 0.03."""
    rig = Rig(optics=Optics(aperture_mm=aperture_mm, keystone_px=keystone_px))
    nm = np.linspace(400, 1000, 60)
    each = [blur.moments(rig, nm, blur.variants[0]) for blur in (DIFFRACTION, ABERRATION, KEYSTONE)]
    blurs = Moments.together(each, len(nm))
    found = fold((rig.camera.slit_px, 1.0), (1, 1), 1, blurs)
    rng = np.random.default_rng(0)
    frequency, turn = rng.uniform(0.0, 0.8, 200), rng.uniform(0, np.pi, 200)
    frequency[:60], frequency[60:90] = rng.uniform(0.1, 0.2, 60), rng.uniform(0.002, 0.03, 30)
    along, scan = (frequency * way(turn) for way in (np.cos, np.sin))
    own = np.sinc(along) * np.sinc(scan * rig.camera.slit_px)
    wanted = (own * (np.sinc(along) * np.sinc(scan)) ** 2)[:, None] * _left(along, scan, blurs.shift, blurs.variance)
    wanted = wanted * pupil_contrast(np.hypot(np.outer(along, blurs.waves[0]), np.outer(scan, blurs.waves[1])))
    kernels = np.zeros((len(along), found.kernels), np.complex128)
    for level, which in found.windows():
        part = found.part(level, which)
        seen = (np.sinc(level * along) * np.sinc(level * scan)) ** 2
        for step in (2**power for power in range(int(np.log2(level)))):
            seen = seen * (np.cos(np.pi * step * along) * np.cos(np.pi * step * scan)) ** 8
        left = _left(level * along, level * scan, part.shift, part.variance)
        kernels[:, which] = (own * seen)[:, None] * left
    error = np.abs(kernels @ (found.fractions @ found.between) - wanted)
    assert (found.fractions @ found.between).min() >= 0
    assert error.max() < 2e-3
    assert error[:60].max() < 1.7e-3
    assert error[60:90].max() < 8e-4


def _left(along: np.ndarray, scan: np.ndarray, shift: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the contrast that Gaussians leave of waves, (wave, kernel)."""
    turned = np.outer(along, shift[0]) + np.outer(scan, shift[1])
    spread = np.outer(along**2, variance[0]) + np.outer(scan**2, variance[1])
    return np.exp(-2j * np.pi * turned - 2 * np.pi**2 * spread)


def test_bound_covers_every_tilt_of_the_sweeps():
    """A sweep towards grazing incidence raises the bound; one away from it leaves the bound of the rest position."""
    probe = steep_probe((1.0, 1.0), curvature=(1.0, 1.0))
    rest = DIFFRACTION.bound(probe, RIG).value
    steep, flat = (replace(SWEEP, start_px=start) for start in (4000.0, -5000.0))
    assert DIFFRACTION.bound(replace(probe, sweeps=(steep,)), RIG).value > rest
    assert DIFFRACTION.bound(replace(probe, sweeps=(flat,)), RIG).value == pytest.approx(rest, rel=2e-3)


@pytest.mark.parametrize(("number", "focus_m"), [(23, None), (32, math.inf)], ids=["sharp", "out of focus"])
def test_rendered_light_matches_the_integral_over_the_pupil(number: int, focus_m: float | None) -> None:
    """Light beside a wide bright field is within 0.1 sigma of the integral.

    So is noise that is out of focus, 40 m away with the focus at infinity.
    """
    tile = random_tile(number, focus_m)
    one = replace(tile, samples=tile.samples[:1])  # the integral over all waves takes seconds each
    assert distances(one).max() < 0.1
