"""Keystone: its line over the wavelengths, its sign through the renderer, and the bound."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.lazy import Once
from pipeline.simulator.effects.blurs import KEYSTONE, keystone_shift
from pipeline.simulator.effects.effect import SweepBlock
from pipeline.simulator.effects.line import SLIT
from pipeline.simulator.render import expected_light
from pipeline.simulator.rig_model import Optics, Rig
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster
from tests.pipeline.simulator.fine_image import FLAT, IMAGES, SWEEP, change, probe_of, shifted

NM = np.array([400.0, 700.0, 1000.0])


def rig_of(keystone_px: float) -> Rig:
    """A rig with so much keystone."""
    return Rig(optics=Optics(keystone_px=keystone_px))


@given(st.floats(0, 3), st.floats(400, 1000))
def test_line_over_the_wavelengths(keystone: float, nm: float):
    """From -k/2 at 400 nm through 0 at 700 to k/2 at 1000; a band's shift does not depend on other bands."""
    shift = keystone_shift(rig_of(keystone), np.array([400.0, 700.0, 1000.0, nm]))
    assert shift[:3] == pytest.approx([-keystone / 2, 0, keystone / 2])
    assert shift[3] == pytest.approx(keystone * (nm - 700) / 600, abs=1e-12)
    assert keystone_shift(rig_of(keystone), np.array([nm])) == pytest.approx(shift[3])


def test_beyond_the_spectrograph_the_shift_stays():
    """Bands that the spectrograph has not, of a scene from elsewhere, are shifted as its first or last."""
    assert keystone_shift(rig_of(0.4), np.array([300.0, 2500.0])) == pytest.approx([-0.2, 0.2])


def test_moments_shift_along_the_line_only():
    """No shift along the scan and no blur."""
    moments = KEYSTONE.moments(rig_of(0.4), NM, "linear")
    assert moments.shift == pytest.approx(np.array([[-0.2, 0, 0.2], [0, 0, 0]]))
    assert not moments.variance.any()


def test_long_wavelengths_see_further_along_the_line():
    """On a ramp of 100 e- per px along the line 0.5 px of keystone add 25 e- at 1000 nm and take 25 at 400."""
    planes = np.repeat(np.arange(80, dtype=np.float32)[None, :, None], 30, axis=0)
    electrons = np.full((1, 3), 100.0, np.float32)
    scene = RasterScene(
        "ramp", "ramp", SceneRaster.of(planes), Once.of(SceneLight(electrons, electrons[0])), np.ones(3, np.float32), NM
    )
    block = SweepBlock(rig_of(0.5), SWEEP, range(10, 13), NM, scene.shape, samples=range(300, 340))
    plain = {SLIT: "3x1"}
    beside = expected_light(scene, block, {KEYSTONE: "linear", **plain}) - expected_light(scene, block, plain)
    assert beside[..., 0] == pytest.approx(-25, abs=0.05)
    assert beside[..., 1] == pytest.approx(0, abs=0.05)
    assert beside[..., 2] == pytest.approx(25, abs=0.05)


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("keystone", [0.15, 1.0, 4.0])
def test_bound_holds(name: str, keystone: float):
    """A real shift changes no band by more, and the worst by no less than a sixth."""
    image = IMAGES[name]()
    bound = KEYSTONE.bound(probe_of(image, NM), rig_of(keystone)).value
    measured = max(change(image, shifted(shift, 0)) for shift in keystone_shift(rig_of(keystone), NM))
    assert bound / 6 <= measured <= bound * 1.001  # slopes are read on a grid of 1/16 px


def test_absent_or_unseen():
    """No keystone, a band in the middle, a flat scene and the exact variant have a bound of 0."""
    probe = probe_of(IMAGES["edges"](), NM)
    assert KEYSTONE.bound(probe, rig_of(0.0)).value == 0
    assert KEYSTONE.bound(probe, rig_of(0.3), "linear").value == 0
    assert KEYSTONE.bound(probe_of(IMAGES["edges"](), NM[1:2]), rig_of(0.3)).value == 0
    assert KEYSTONE.bound(probe_of(FLAT, NM), rig_of(0.3)).value == pytest.approx(0, abs=1e-9)
