"""Laws of the farm's year: calendars, cover, stages, weeds, foliage and water in the soil."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulator.scenes.farm.seasons import (
    CROPS,
    canopy_cover,
    crop_height,
    days_since_turned,
    foliage,
    land_on,
    lodged_share,
    since,
    soil_moisture,
    stage_shares,
    weed_size,
)
from pipeline.simulator.scenes.farm.spectra import MATERIALS, STAGES, spectral_library, wet_share


@given(st.sampled_from(sorted(CROPS)), st.floats(-50, 350))
def test_stages_share_the_stand(use: str, age: float) -> None:
    """Shares of stages are non-negative, sum to 1, and at most two neighbours mix."""
    shares = stage_shares(CROPS[use], np.array([age]))
    assert 1 <= len(shares) <= 2
    assert sum(float(share[0]) for share in shares.values()) == pytest.approx(1, abs=1e-6)
    assert all(share[0] >= 0 and name in MATERIALS for name, share in shares.items())


@pytest.mark.parametrize("use", sorted(CROPS))
def test_cover_rises_from_nothing_to_its_end(use: str) -> None:
    """Cover is 0 before emergence, then never falls, has no jump after it and nears its end before harvest."""
    crop = CROPS[use]
    cover = canopy_cover(crop, np.arange(-20.0, 320.0, 0.25))
    assert cover[:80].max() == 0
    assert cover[80] == pytest.approx(crop.cover[0])
    steps = np.diff(cover[80:])
    assert steps.min() >= 0
    assert steps.max() < 0.02
    assert cover[-1] == pytest.approx(crop.cover[2], abs=0.05)


def test_cover_by_hand() -> None:
    """Maize 20 days old covers 0.005 exp(0.12 x 20); 60 days old 0.96 - 0.25 x 0.96^2 / 0.005 exp(-0.12 x 60)."""
    np.testing.assert_allclose(canopy_cover(CROPS["maize"], [20.0, 60.0]), [0.0551159, 0.9255975], rtol=1e-5)


@pytest.mark.parametrize(
    ("use", "day", "phase", "days"),
    [
        ("wheat_a", 213, "stubble", 0),
        ("wheat_a", 212, "crop", 281),
        ("wheat_a", 280, "soil", 16),
        ("wheat_a", 1, "crop", 70),
        ("maize", 127, "soil", 42),
        ("maize", 128, "crop", 0),
        ("maize", 20, "stubble", 116),
        ("sugar_beet", 289, "crop", 184),
        ("sugar_beet", 290, "soil", 0),
        ("grass", 150, "grass", 9),
        ("soil", 150, "soil", 2),
        ("stubble", 211, "stubble", 365),
        ("late_maize", 172, "crop", 20),
    ],
)
def test_calendars(use: str, day: int, phase: str, days: float) -> None:
    """Each field is what the calendar says, through the turn of the year."""
    assert land_on(use, day, 0.0) == (phase, days)


@given(st.sampled_from([*CROPS, "soil", "grass", "stubble"]), st.integers(1, 366), st.floats(-6, 6))
def test_a_late_field_is_the_calendar_shifted(use: str, day: int, late: float) -> None:
    """Being late by some days is looking at the calendar that much earlier."""
    land, shifted = land_on(use, day, late), land_on(use, day - late, 0.0)
    assert land.phase == shifted.phase
    assert land.days == pytest.approx(shifted.days, abs=1e-9)


def test_since_goes_round() -> None:
    """The day before an event is 365 days after the last one."""
    assert (since(5, 5), since(4, 5), since(366, 1), since(1, 366)) == (0, 365, 365, 1)


def test_plants_grow_tall() -> None:
    """Maize is 4 px high after 30 days, and 20 px from 75 days on."""
    assert crop_height(CROPS["maize"], 30) == 4
    assert crop_height(CROPS["maize"], 75) == crop_height(CROPS["maize"], 140) == 20


def test_lodging_only_spreads() -> None:
    """Nothing lies before ripening, everything that will lie does before harvest, and none stands up again."""
    shares = [lodged_share(day) for day in range(1, 366)]
    assert shares[150] == 0
    assert shares[210] == 1
    assert min(np.diff(shares)) >= 0


def test_weeds_grow_until_they_are_tilled() -> None:
    """A weed grows day by day, is gone after tillage and dies of age."""
    emergence = np.array([120.0])
    young, old = (weed_size(day, emergence, np.array([300.0]))[0] for day in (130, 160))
    assert 0 < young < old < 1
    assert weed_size(160, emergence, np.array([20.0]))[0] == 0
    assert weed_size(119, emergence, np.array([400.0]))[0] == 0
    assert weed_size(320, emergence, np.array([400.0]))[0] == 0


def test_sowing_kills_weeds() -> None:
    """Days since tillage count from sowing too; where nobody tills, a year has gone."""
    assert days_since_turned("maize", 172, 0.0) == 172 - (128 - 9)
    assert days_since_turned("soil", 172, 0.0) == 172 - 148
    assert days_since_turned("stubble", 172, 0.0) == 366


@pytest.mark.parametrize(("day", "leaves"), [(20, "twigs"), (172, "tree"), (298, "tree_autumn"), (340, "twigs")])
def test_trees_have_the_seasons_leaves(day: int, leaves: str) -> None:
    """Crowns are bare in winter, green in summer and turned in autumn; shares sum to 1."""
    shares = foliage(day)
    assert max(shares, key=lambda name: shares[name]) == leaves
    assert sum(shares.values()) == pytest.approx(1)


def test_winters_are_wetter() -> None:
    """Water in the topsoil stays within its bounds, differs from seed to seed, and is more in winter on average."""
    water = np.array([[soil_moisture(seed, day) for day in range(1, 367, 6)] for seed in range(12)])
    assert water.min() >= 0.05
    assert water.max() < 0.38
    assert water[:, :10].mean() > water[:, 28:38].mean() + 0.03
    assert np.ptp(water, axis=0).min() > 0


def test_wet_share_is_exponential_in_water() -> None:
    """Dry soil is dry, each tenth of water takes the same share of what dryness is left, and below 0 is dry."""
    share = wet_share([-0.1, 0.0, 0.1, 0.2])
    assert share[0] == share[1] == 0
    assert (1 - share[3]) == pytest.approx((1 - share[2]) ** 2, rel=1e-5)


def test_spectra_are_reflectances_and_tell_stages_apart() -> None:
    """All lie between 0 and 0.8; ripening takes the red edge, lodging brightens green wheat in the near infrared."""
    library = spectral_library(61)
    assert library.reflectance.min() > 0
    assert library.reflectance.max() < 0.8
    red, near = (int(np.abs(library.wavelength_nm - nm).argmin()) for nm in (670, 800))
    seen = dict(zip(MATERIALS, library.reflectance, strict=True))
    edge = {name: (seen[name][near] - seen[name][red]) / (seen[name][near] + seen[name][red]) for name in STAGES}
    assert edge["wheat_a_full"] > 0.85
    assert edge["wheat_a_full"] > edge["wheat_a_filling"] > edge["wheat_a_ripe"]
    assert edge["wheat_a_ripe"] < 0.45
    assert edge["maize_full"] > edge["maize_ripe"]
    assert seen["wheat_a_lodged"][near] > 1.1 * seen["wheat_a_filling"][near]
    assert seen["straw_grey"][near] < seen["straw"][near]
