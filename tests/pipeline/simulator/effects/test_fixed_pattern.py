"""Fixed patterns belong to one sensor, whatever it looks at, and their bound is what they do."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.simulator.effects.sensor import PRNU, STRIPING, response_gain, stripe_gain
from pipeline.simulator.rig_model import Detector, Rig
from tests.pipeline.simulator.spectral_light import block_of, probe_of, random_light, worst

RIG = Rig()


def test_gains_have_the_spread_that_is_stated() -> None:
    """1 % an element, 0.2 % a column; of mean 1; nothing shared between the two."""
    elements, columns = response_gain(RIG, 270), stripe_gain(RIG)
    assert elements.shape == (640, 270)
    assert elements.mean() == pytest.approx(1, abs=1e-4)
    assert elements.std() == pytest.approx(0.01, rel=0.02)
    assert columns.std() == pytest.approx(0.002, rel=0.1)
    assert abs(np.corrcoef(elements.mean(axis=1), columns[:, 0])[0, 1]) < 0.15


def test_gains_belong_to_the_unit() -> None:
    """Another sensor has others; another scene, seed, part of the samples or more bands have the same."""
    assert not np.array_equal(response_gain(RIG, 5), response_gain(Rig(detector=Detector(unit=1)), 5))
    np.testing.assert_array_equal(response_gain(RIG, 9)[:, :5], response_gain(RIG, 5))
    nm = np.linspace(400, 1000, 9)
    for effect in (PRNU, STRIPING):
        whole = effect.gain(block_of(RIG, nm), "exact")
        part = effect.gain(block_of(RIG, nm, seed=5, samples=range(30, 60, 2)), "exact")
        np.testing.assert_array_equal(part, whole[:, 30:60:2])


def test_gains_never_fall_below_0() -> None:
    """A spread of 50 % leaves elements without response, none with less."""
    gains = response_gain(Rig(detector=Detector(response_share=0.5)), 50)
    assert gains.min() == 0
    assert gains.max() > 2


def test_gains_cannot_be_overwritten() -> None:
    """They are kept for all blocks of a sensor."""
    with pytest.raises(ValueError, match="read-only"):
        response_gain(RIG, 5)[0] = 3


@pytest.mark.parametrize("effect", [PRNU, STRIPING], ids=["prnu", "striping"])
def test_bounds_hold_and_are_near(effect) -> None:
    """Over scenes in both units: never broken, at the median at most three times what is measured."""
    over = []
    for seed in range(20):
        nm, light = random_light(seed, samples=640)
        unit = ("sigma", "dn")[seed % 2]
        rig = Rig(detector=Detector(unit=seed))
        bound = effect.bound(probe_of(light, nm, unit), rig)
        changed = light * effect.gain(block_of(rig, nm), "exact")
        measured = worst(changed, light, unit)
        assert measured <= bound.value * (1 + 1e-5)
        assert "gains" in bound.why
        over.append(bound.value / measured)
    assert np.median(over) < 3


@pytest.mark.parametrize("effect", [PRNU, STRIPING], ids=["prnu", "striping"])
def test_an_even_sensor_has_none(effect) -> None:
    """Without spread the bound is 0 and so is the change; the exact variant has no error."""
    nm, light = random_light(0)
    even = Rig(detector=Detector(response_share=0.0, stripe_share=0.0))
    assert effect.bound(probe_of(light, nm), even).value == 0
    assert effect.bound(probe_of(light, nm), RIG, "exact").value == 0
    np.testing.assert_array_equal(effect.gain(block_of(even, nm), "exact"), 1)
