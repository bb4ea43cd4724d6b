"""The farm's year, its sun and its spectra: calendars, cover, shadows, and what remote sensing knows of materials."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.camera import LineCamera, digitise
from pipeline.simulator.scenes.farm.farm_scene import crown_shadows
from pipeline.simulator.scenes.farm.seasons import (
    CROPS,
    LATITUDE_DEG,
    Sun,
    canopy_cover,
    crop_height,
    days_since_turned,
    foliage,
    land_on,
    lodged_share,
    since,
    soil_moisture,
    stage_shares,
    sun_over_farm,
    weed_size,
)
from pipeline.simulator.scenes.farm.spectra import (
    FWHM_NM,
    MATERIALS,
    OTHERS,
    STAGES,
    band_response,
    spectral_library,
    wet_share,
)


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


SHAPE = (161, 161)


def test_the_sun_agrees_with_the_surveys() -> None:
    """Place by the survey's algorithm for the same true solar time differs by less than 0.7 degrees."""
    from pvlib.spa import solar_position

    at_ground = {"elev": 0.0, "pressure": 1013.25, "temp": 12.0, "delta_t": 69.0, "atmos_refract": 0.5667}
    start = np.datetime64("2025-01-01T00:00:00").astype(np.int64)
    for day in (20, 110, 172, 250, 340):
        moments = start + (day - 1) * 86400.0 + np.arange(8 * 3600, 15 * 3600, 600.0)
        found = solar_position(moments, LATITUDE_DEG, 0.0, **at_ground)
        noon = np.interp(180.0, found[4], moments)  # azimuth rises through the day
        hours = 12 + (moments - noon) / 3600
        for hour, elevation, azimuth in list(zip(hours, found[3], found[4], strict=True))[::7]:
            if elevation > 8:
                ours = sun_over_farm(day, float(hour))
                assert ours.elevation_deg == pytest.approx(elevation, abs=0.7)
                assert ours.azimuth_deg == pytest.approx(azimuth, abs=0.7)


@pytest.mark.parametrize("azimuth", [90.0, 135.0, 180.0, 240.0])
def test_shadows_point_away_and_lengthen(azimuth: float) -> None:
    """The shadow's centre lies opposite the sun, further off and longer the lower the sun."""
    lengths = []
    for elevation in (60.0, 35.0, 20.0):
        shadow = crown_shadows(np.zeros((1, 2)), np.array([8.0]), Sun(azimuth, elevation), SHAPE)
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] - 80.0
        centre = np.array([(shadow * y).sum(), (shadow * x).sum()]) / shadow.sum()
        to_sun = np.array([-np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth))])
        assert centre @ to_sun == pytest.approx(-9.6 / np.tan(np.deg2rad(elevation)), abs=0.1)
        assert centre[0] * to_sun[1] - centre[1] * to_sun[0] == pytest.approx(0, abs=0.05)
        assert shadow.sum() == pytest.approx(np.pi * 8 * np.hypot(8, 7.2 / np.tan(np.deg2rad(elevation))), rel=0.02)
        lengths.append(shadow.sum())
    assert lengths == sorted(lengths)


def test_shadows_at_the_edge_and_beyond() -> None:
    """Shadows that leave the scene are cut, trees outside may throw theirs into it, and no tree throws none."""
    sun = Sun(180.0, 30.0)
    inside = crown_shadows(np.array([[0.0, 0.0]]), np.array([9.0]), sun, (300, 300))
    cut = crown_shadows(np.array([[0.0, 0.0]]), np.array([9.0]), sun, (20, 14))
    np.testing.assert_allclose(cut, inside[140:160, 143:157], atol=1e-6)
    far = np.array([[500.0, 0.0], [0.0, -500.0], [-500.0, 0.0], [0.0, 500.0]])
    assert crown_shadows(far, np.full(4, 9.0), sun, (20, 14)).max() == 0
    assert crown_shadows(np.zeros((0, 2)), np.zeros(0), sun, (3, 4)).shape == (3, 4)
    assert crown_shadows(np.array([[16.0, 0.0]]), np.array([6.0]), sun, (16, 16)).max() > 0.9


LEAFY = [name for name in (*OTHERS, *STAGES) if not name.endswith(("dry", "ripe", "autumn", "old"))]


def at(name: str, nm: float) -> float:
    """Reflectance of a material in the band nearest a wavelength."""
    library = spectral_library(270)
    return float(library.reflectance[MATERIALS.index(name), np.abs(library.wavelength_nm - nm).argmin()])


@pytest.mark.parametrize("name", LEAFY)
def test_canopies_show_a_red_edge(name: str) -> None:
    """Green plants have an NDVI above 0.6 and a green peak."""
    near, red = at(name, 800), at(name, 670)
    assert (near - red) / (near + red) > 0.6
    assert at(name, 552) > max(at(name, 480), red)


def test_water_and_shade_are_dark() -> None:
    """Water and shade reflect less than 6 % anywhere, and water next to nothing in the near infrared."""
    dark = spectral_library(270).reflectance[[MATERIALS.index("water"), MATERIALS.index("shade")]]
    assert dark.max() < 0.06
    assert at("water", 900) < 0.02


def test_wet_soil_is_darker_than_dry() -> None:
    """Moisture darkens soil in every band."""
    reflectance = spectral_library(270).reflectance
    wet, dry = reflectance[MATERIALS.index("soil_wet")], reflectance[MATERIALS.index("soil_dry")]
    assert (wet < 0.7 * dry).all()


@pytest.mark.parametrize("stand", ["young", "full", "filling", "lodged"])
def test_twins_differ_at_the_red_edge_alone(stand: str) -> None:
    """The two wheats differ by more than 5 % about 715 nm, and by less than 0.1 % outside 680-750 nm."""
    library = spectral_library(270)
    ratio = (
        library.reflectance[MATERIALS.index(f"wheat_b_{stand}")]
        / library.reflectance[MATERIALS.index(f"wheat_a_{stand}")]
    )
    off = np.abs(library.wavelength_nm - 715)
    assert (ratio[off < 8] > 1.05).all()
    assert np.abs(ratio[off > 35] - 1).max() < 1e-3


@pytest.mark.parametrize("bands", [2, 4, 15, 200, 270, 939])
def test_any_number_of_bands(bands: int) -> None:
    """Band counts from 2 to 939 span 400 to 1000 nm, with the brightest band of a white at 1."""
    library = spectral_library(bands)
    assert library.wavelength_nm[[0, -1]].tolist() == [400.0, 1000.0]
    assert library.reflectance.shape == (len(MATERIALS), bands)
    assert library.light.max() == 1
    assert library.light.min() > 0


def test_band_response_keeps_a_line_in_place() -> None:
    """Bands weigh a straight line to its value at their centre and have the stated width at half maximum."""
    centre, grid = np.array([500.0, 700.0]), np.arange(400.0, 1031.0)
    weight = band_response(centre, np.full(2, FWHM_NM))
    np.testing.assert_allclose(weight @ grid, centre, rtol=1e-9)
    np.testing.assert_allclose(weight[0, 103] / weight[0, 100], 0.5, rtol=1e-9)


def test_sunlight_shows_oxygen() -> None:
    """The light has the O2-A dip near 760 nm that any spectrometer sees under the sun."""
    library = spectral_library(270)
    light = np.interp([748.0, 762.0, 778.0], library.wavelength_nm, library.light)
    assert light[1] < 0.9 * min(light[0], light[2])


def test_white_panel_never_saturates() -> None:
    """The panel stays six standard deviations of shot and read noise below the full well, and so in DN."""
    camera = LineCamera()
    panel = spectral_library(270).panel_electrons(camera)
    assert (panel + 6 * np.sqrt(panel + camera.read_noise_e**2)).max() < camera.full_well_e
    assert digitise(panel, camera, np.random.default_rng(0)).max() < camera.full_scale_dn


def test_panel_and_materials_share_one_light() -> None:
    """Electrons over the panel's, times its reflectance, give back every material."""
    camera, library = LineCamera(), spectral_library(32)
    back = library.electrons(camera) / library.panel_electrons(camera) * 0.99
    np.testing.assert_allclose(back, library.reflectance, rtol=1e-5)


def test_library_cannot_be_changed() -> None:
    """The cached spectra are read-only: one scene cannot spoil another's."""
    library = spectral_library(4)
    assert library is spectral_library(4)
    with pytest.raises(ValueError, match="read-only"):
        library.reflectance[0, 0] = 1
