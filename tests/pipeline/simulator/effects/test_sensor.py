"""Light on the detector: stray light against a Gaussian convolved outright, fixed patterns of one sensor, bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pipeline.simulator.effects.spectrometer import PRNU, STRAY_LIGHT, STRIPING
from pipeline.simulator.rig_model import Detector, Rig
from tests.pipeline.simulator.spectral_light import block_of, random_light, rig_with


def scattered(light, variant="halo", **optics):
    """Light after scattering; the optics' numbers start with stray_."""
    rig = rig_with(light.shape[1], **{f"stray_{name}": value for name, value in optics.items()})
    wavelength = np.linspace(400, 1000, light.shape[2])
    return STRAY_LIGHT.change(light.copy(), block_of(rig, wavelength, range(len(light))), variant)


@pytest.mark.parametrize("variant", STRAY_LIGHT.variants)
@pytest.mark.parametrize("halo_px", [3.0, 64.0, 1e4])
def test_all_light_is_kept_in_each_line(variant, halo_px):
    """What leaves a sample lands on the same line's detector, also at its edges, and no light falls below 0."""
    light = random_light(0)[1]
    light[:, :3] = 0
    light[:, :, -1] *= 20
    made = scattered(light, variant, fraction=0.3, halo_px=halo_px)
    np.testing.assert_allclose(made.sum(axis=(1, 2)), light.sum(axis=(1, 2)), rtol=1e-5)
    assert made.min() > -1e-3


def test_halo_is_a_gaussian_reflected_at_the_edges():
    """The product with few cosines is the plain convolution, sample by sample and band by band, to 1e-5."""
    light = random_light(1)[1]
    made = scattered(light, fraction=0.2, even=0.25, halo_px=6.0)
    for line, before in zip(made, light.astype(np.float64), strict=True):
        halo = gaussian_filter(before, 6.0, mode="reflect", truncate=8)
        np.testing.assert_allclose(line, 0.8 * before + 0.2 * (0.25 * before.mean() + 0.75 * halo), rtol=2e-5)


def test_even_fraction_by_hand():
    """One line of one sample and bands 0 and 100, a tenth scattered evenly: 5 and 95."""
    light = np.array([[[0, 100]]], np.float32)
    np.testing.assert_allclose(scattered(light, fraction=0.1, even=1.0), [[[5, 95]]], rtol=1e-6)
    alone = np.array([[[70]]], np.float32)
    np.testing.assert_allclose(scattered(alone, fraction=0.1), alone, rtol=1e-6)


RIG = Rig()


def test_gains_have_the_spread_that_is_stated() -> None:
    """1 % an element, 0.2 % a column; of mean 1; nothing shared between the two."""
    elements, columns = PRNU.gains(RIG, 270), STRIPING.gains(RIG, 1)
    assert elements.shape == (640, 270)
    assert elements.mean() == pytest.approx(1, abs=1e-4)
    assert elements.std() == pytest.approx(0.01, rel=0.02)
    assert columns.std() == pytest.approx(0.002, rel=0.1)
    assert abs(np.corrcoef(elements.mean(axis=1), columns[:, 0])[0, 1]) < 0.15


def test_gains_belong_to_the_unit() -> None:
    """Another sensor has others; more bands have the same."""
    assert not np.array_equal(PRNU.gains(RIG, 5), PRNU.gains(Rig(detector=Detector(unit=1)), 5))
    np.testing.assert_array_equal(PRNU.gains(RIG, 9)[:, :5], PRNU.gains(RIG, 5))


def test_gains_never_fall_below_0() -> None:
    """A spread of 50 % leaves elements without response, none with less."""
    gains = PRNU.gains(Rig(detector=Detector(prnu_std=0.5)), 50)
    assert gains.min() == 0
    assert gains.max() > 2
