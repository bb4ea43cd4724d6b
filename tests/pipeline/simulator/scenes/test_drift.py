"""Illumination drift: when it counts, its variants and bounds, and blocks that do not matter."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest

from pipeline.lazy import Once
from pipeline.simulator.effects.lighting import DRIFT
from pipeline.simulator.render import expected_light
from pipeline.simulator.scenes.scene import RasterScene, SceneLight, SceneRaster
from tests.pipeline.simulator.outdoors import (
    BANDS,
    MORNING,
    NIGHT,
    NOON,
    SHAPE,
    block_of,
    measured,
    probe_of,
    rig_with,
    white_e,
)

FOUR_HOURS = 4 * 3600.0


def test_a_sweep_at_noon_needs_no_drift() -> None:
    """One sweep of 6 s at noon changes by less than 0.1 sigma, and by less even an hour later."""
    assert 1.2 * DRIFT.bound(probe_of(rig_with(started=NOON)), rig_with(started=NOON)).value < 0.1


def test_four_hours_from_a_low_sun_need_it() -> None:
    """From 20 deg over 4 h the light triples; no variant but the exact one will do."""
    rig = rig_with(started=MORNING)
    bound = DRIFT.bound(probe_of(rig, seconds=FOUR_HOURS), rig)
    assert bound.value > 50
    assert "the sun from 20" in bound.why
    for variant in DRIFT.variants[1:]:
        assert DRIFT.bound(probe_of(rig, seconds=FOUR_HOURS), rig, variant).value > 1


def test_no_time_no_drift() -> None:
    """A sky without a time of day has light that stays."""
    rig = rig_with()
    assert DRIFT.bound(probe_of(rig), rig).value == 0
    assert (DRIFT.gain(block_of(rig), "spectral") == 1).all()
    assert (DRIFT.gain_range(probe_of(rig), rig).greatest == 1).all()


@pytest.mark.parametrize("started", [NOON, MORNING, NIGHT])
@pytest.mark.parametrize("variant", ["off", "scalar", "linear"])
def test_bound_holds_and_is_near(started: datetime, variant: str) -> None:
    """What is left out is within the bound, and near it: the end of the survey is among what is measured."""
    rig = rig_with(started=started)
    seconds = FOUR_HOURS + 5.9
    bound = DRIFT.bound(probe_of(rig, seconds=seconds), rig, variant).value
    looks = [measured(DRIFT, rig, variant, started_s=start, samples=range(1)) for start in (0, 7200, 10800, 14400)]
    assert max(looks) <= 1.0001 * bound
    assert max(looks) > bound / 6


def test_the_exact_variant_is_exact() -> None:
    """Its bound is 0."""
    rig = rig_with(started=MORNING)
    assert DRIFT.bound(probe_of(rig, seconds=FOUR_HOURS), rig, "spectral").value == 0


@pytest.mark.parametrize("variant", DRIFT.variants)
def test_night_is_dark(variant: str) -> None:
    """With the sun down all the time no light is left but what a straight line from the start keeps."""
    rig = rig_with(started=NIGHT)
    gain = DRIFT.gain(block_of(rig), variant)
    assert np.isfinite(gain).all()
    assert gain.max() == (1 if variant == "linear" else 0)


@pytest.mark.parametrize("variant", DRIFT.variants)
@pytest.mark.parametrize("size", [1, 7])
def test_blocks_do_not_matter(size: int, variant: str) -> None:
    """Lines have the same light in blocks of any size, across the hour too."""
    rig = rig_with(started=MORNING)
    more = {"started_s": 26 * 60.0 - 3}  # the hour is full in the middle of the sweep
    parts = [
        DRIFT.gain(block_of(rig, range(start, min(start + size, 60)), **more), variant) for start in range(0, 60, size)
    ]
    np.testing.assert_array_equal(np.concatenate(parts), DRIFT.gain(block_of(rig, **more), variant))


def test_rendered() -> None:
    """Through the chain a flat scene is as bright as the gain says."""
    spectra = white_e().astype(np.float32)
    scene = RasterScene(
        "flat",
        "flat",
        SceneRaster.of(np.ones((*SHAPE, 1), np.float32)),
        Once.of(SceneLight(spectra[None], spectra)),
        np.ones(BANDS, np.float32),
        block_of(rig_with()).wavelength_nm,
    )
    block = block_of(rig_with(started=MORNING), range(0, 60, 30), started_s=600.0, samples=range(4))
    light = expected_light(scene, block, {DRIFT: "spectral"})
    np.testing.assert_allclose(light, DRIFT.gain(block, "spectral") * spectra + 0 * light, rtol=1e-6)
