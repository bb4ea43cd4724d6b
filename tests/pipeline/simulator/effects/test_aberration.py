"""Aberration: its moments, and the bound against real convolution."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulator.effects.blurs import ABERRATION
from pipeline.simulator.rig_model import Optics, Rig
from tests.pipeline.simulator.fine_image import FLAT, IMAGES, change, gaussian, probe_of


def rig_of(sigma_px: float) -> Rig:
    """A rig whose lens blurs by so much."""
    return Rig(optics=Optics(aberration_px=sigma_px))


def test_moments():
    """The square of the sd in all bands and both directions, no shift."""
    moments = ABERRATION.moments(rig_of(0.3), np.array([400.0, 900.0]), "gaussian")
    assert moments.variance == pytest.approx(np.full((2, 2), 0.09))
    assert not moments.shift.any()


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("sigma", [0.1, 0.35, 0.7])
def test_bound_holds(name: str, sigma: float):
    """Real convolution changes no image by more, and by no less than a sixth."""
    image = IMAGES[name]()
    bound = ABERRATION.bound(probe_of(image), rig_of(sigma)).value
    assert bound / 6 <= change(image, gaussian(sigma, sigma)) <= bound + 1e-9


def test_absent_or_unseen():
    """A perfect lens, a flat scene and the exact variant have a bound of 0."""
    probe = probe_of(IMAGES["edges"]())
    assert ABERRATION.bound(probe, rig_of(0.0)).value == 0
    assert ABERRATION.bound(probe, rig_of(0.3), "gaussian").value == 0
    assert ABERRATION.bound(probe_of(FLAT), rig_of(0.3)).value == pytest.approx(0, abs=1e-9)
