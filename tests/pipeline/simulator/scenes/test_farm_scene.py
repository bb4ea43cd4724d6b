"""The farm through the year: one land for all days of a seed, mixtures that are shares, and what the days change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.errors import SceneError, SettingsError, WavelengthError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.scenes.farm.farm_plan import CLASS_COLOURS, CLASSES, FarmPlan, farm_plan
from pipeline.simulator.scenes.farm.farm_scene import FARM_LAW, farm_scene, law_of_key, refuse_removed
from pipeline.simulator.scenes.farm.land import parcel_pixels
from pipeline.simulator.scenes.farm.spectra import MATERIALS
from pipeline.simulator.scenes.scene import RasterScene

SIZE, LONG, WIDE = (420, 520), (400, 1000), (720, 1000)


def labels_of(scene: RasterScene) -> NDArray[np.uint8]:
    """The labels, which every farm has."""
    assert scene.labels is not None
    return scene.labels


def share_of(scene: RasterScene, label: str, where: NDArray[np.intp] | slice = slice(None)) -> float:
    """Share of pixels with a label."""
    return float((labels_of(scene).ravel()[where] == CLASSES.index(label)).mean())


def inner_pixels(plan: FarmPlan, number: int) -> NDArray[np.intp]:
    """Flat pixel numbers of a field, 20 px and more from its borders."""
    field = plan.fields[number]
    index, _, centres = parcel_pixels(field.parcel, plan.shape)
    inside = np.ones(index.size, bool)
    for ny, nx, offset in field.parcel.cuts:
        inside &= centres @ np.array([ny, nx]) - offset > 20
    kept: NDArray[np.intp] = index[inside]
    return kept


def plane(scene: RasterScene, plan: FarmPlan, name: str) -> NDArray[np.float32]:
    """Abundance of a material, (pixel,); 0 where the day has none of it."""
    if name not in plan.materials:
        return np.zeros(scene.shape[0] * scene.shape[1], np.float32)
    found: NDArray[np.float32] = scene.planes[..., plan.materials.index(name)].ravel()
    return found


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**40), st.integers(1, 70), st.integers(1, 70), st.integers(1, 366))
def test_abundances_are_shares(seed: int, height: int, width: int, day: int) -> None:
    """Abundances of any seed, size and day are non-negative and sum to 1, and every pixel has a known class."""
    scene = farm_scene(seed, (height, width), bands=2, day=day)
    assert scene.planes.dtype == np.float32
    assert scene.planes.shape[2] <= 40
    assert scene.planes.min() >= 0
    np.testing.assert_allclose(scene.planes.sum(axis=-1), 1, atol=2e-6)
    assert labels_of(scene).max() < len(CLASSES)


def test_values_are_reflectance() -> None:
    """Scene values lie between 0 and 1 in every band; the panel is nearly white."""
    scene = farm_scene(2, (120, 160), bands=31, day=205)
    assert scene.values().min() > 0
    assert scene.values().max() < 0.85
    assert scene.panel.tolist() == [np.float32(0.99)] * 31
    assert scene.class_names == CLASSES
    np.testing.assert_array_equal(scene.class_colours, CLASS_COLOURS)


def test_equal_arguments_give_equal_farms() -> None:
    """One seed and day give one scene, bit for bit; the global generator plays no part."""
    first = farm_scene(11, (120, 150), bands=5, day=190)
    np.random.seed(1)  # noqa: NPY002 - the point of the test
    second = farm_scene(11, (120, 150), bands=5, day=190)
    assert first.key == second.key
    np.testing.assert_array_equal(first.planes, second.planes)
    np.testing.assert_array_equal(first.labels, second.labels)


def test_key_tells_the_law_and_the_day() -> None:
    """The key names law, seed, day, shape, hour, bands and what the camera changes."""
    key = farm_scene(42, (20, 30), bands=7, day=99).key
    assert key.startswith(f"{FARM_LAW}/seed=42/day=99/shape=20x30")
    others = [
        farm_scene(42, (20, 30), bands=7, day=100),
        farm_scene(42, (20, 30), bands=7, day=99, hour=9.5),
        farm_scene(42, (20, 30), bands=7, camera=LineCamera(electrons_per_dn=3.0), day=99),
    ]
    assert len({key, *(scene.key for scene in others)}) == 4


def test_another_day_is_the_same_land() -> None:
    """Fields, rows, borders and trees stay where they are; roads, ponds and crowns are labelled alike."""
    june, april = farm_plan(4, SIZE, day=172), farm_plan(4, SIZE, day=110)
    for one, other in zip(june.fields, april.fields, strict=True):
        np.testing.assert_array_equal(one.parcel.corners, other.parcel.corners)
        assert (one.use, one.row_angle_deg, one.row_period_px) == (other.use, other.row_angle_deg, other.row_period_px)
    assert [kind for _, kind in june.borders] == [kind for _, kind in april.borders]
    scenes = [labels_of(farm_scene(4, SIZE, bands=2, day=day)) for day in (110, 172)]
    for label in ("tree", "water"):
        masks = [scene == CLASSES.index(label) for scene in scenes]
        assert (masks[0] & masks[1]).sum() > 0.75 * (masks[0] | masks[1]).sum()


def test_the_hour_moves_only_shadows() -> None:
    """Labels do not depend on the hour, the picture does."""
    morning, noon = (farm_scene(4, (200, 200), bands=2, hour=hour) for hour in (8.0, 12.0))
    np.testing.assert_array_equal(morning.labels, noon.labels)
    assert np.abs(morning.planes - noon.planes).max() > 0.3


def test_green_cover_grows_up_to_its_peak() -> None:
    """From emergence to full cover, no field of maize or beet loses leaves from one survey to the next."""
    before: dict[int, float] = {}
    for day in (120, 150, 165, 180, 195):
        plan, scene = farm_plan(3, SIZE, day=day), farm_scene(3, SIZE, bands=2, day=day)
        for number, field in enumerate(plan.fields):
            crop, where = field.crop, inner_pixels(plan, number)
            if crop is None or field.use.startswith("wheat") or where.size < 2000:
                continue
            leaves = [name for name in plan.materials if name.split("_")[0] in ("maize", "beet")]
            green = float(sum(plane(scene, plan, name)[where].mean() for name in leaves))
            assert green >= before.get(number, 0.0) - 0.01  # weeds and their shade grow too
            before[number] = green
    assert sum(green > 0.6 for green in before.values()) >= 2


def test_harvested_cereals_are_stubble() -> None:
    """Wheat before harvest is wheat, stubble of fresh straw after it, and bare soil after tillage."""
    for day, label in ((172, "wheat"), (230, "stubble"), (277, "soil")):
        plan, scene = farm_plan(1, SIZE, day=day), farm_scene(1, SIZE, bands=2, day=day)
        fields = [number for number, field in enumerate(plan.fields) if field.use.startswith("wheat")]
        sizes = {number: inner_pixels(plan, number) for number in fields}
        number = max(fields, key=lambda one: sizes[one].size)
        wanted = plan.fields[number].use if label == "wheat" else label
        assert share_of(scene, wanted, sizes[number]) > 0.8
        if label == "stubble":
            assert plane(scene, plan, "straw")[sizes[number]].mean() > 0.3


def test_more_weeds_where_the_plan_has_more() -> None:
    """Fields rank by their share of weed pixels as by the plan's density of weeds."""
    found, planned = [], []
    for seed in range(2):
        plan, scene = farm_plan(seed, WIDE, day=172), farm_scene(seed, WIDE, bands=2, day=172)
        for number, field in enumerate(plan.fields):
            where = inner_pixels(plan, number)
            if field.use in ("maize", "sugar_beet", "wheat_a", "wheat_b") and where.size > 8_000:
                found.append(share_of(scene, "weed", where))
                planned.append(field.weeds)
    ranks = [np.argsort(np.argsort(values)) for values in (found, planned)]
    assert len(found) > 8
    assert np.corrcoef(*ranks)[0, 1] > 0.8


def test_bare_soil_lies_on_a_line() -> None:
    """Near infrared against red of bare soil, wet or dry, lit or among clods, is a line to 0.006 of reflectance."""
    red, near = [], []
    for day in (100, 172, 290):
        plan, scene = farm_plan(6, SIZE, day=day), farm_scene(6, SIZE, bands=61, day=day)
        soil = sum(plane(scene, plan, name) for name in ("soil_dry", "soil_wet", "shade"))
        bare = np.flatnonzero(np.asarray(soil) > 0.999)[::7]
        bands = [int(np.abs(scene.wavelength_nm - nm).argmin()) for nm in (670, 800)]
        pair = scene.planes.reshape(-1, scene.planes.shape[2])[bare] @ np.ascontiguousarray(scene.spectra()[:, bands])
        red.append(pair[:, 0])
        near.append(pair[:, 1])
    x, y = np.concatenate(red), np.concatenate(near)
    line = np.polyfit(x, y, 1)
    assert np.ptp(x) > 0.1
    assert np.abs(np.polyval(line, x) - y).max() < 0.006
    assert 1.0 < line[0] < 1.6


def test_wet_days_have_darker_soil() -> None:
    """Soil is darker on a farm's wettest day than on its driest."""
    moisture = {day: farm_plan(0, (8, 8), day=day).moisture for day in range(60, 300, 5)}
    days = sorted(moisture, key=lambda day: moisture[day])
    shares = []
    for day in (days[0], days[-1]):
        plan, scene = farm_plan(0, SIZE, day=day), farm_scene(0, SIZE, bands=2, day=day)
        wet, dry = plane(scene, plan, "soil_wet"), plane(scene, plan, "soil_dry")
        shares.append(wet.sum() / (wet + dry).sum())
    assert moisture[days[-1]] > moisture[days[0]] + 0.1
    assert shares[1] > shares[0] + 0.1


def test_lodged_patches_grow_in_ripening_wheat() -> None:
    """No wheat lies in May; what lies in June lies in July too, and it is still wheat."""
    parts = []
    assert not any("lodged" in name for name in farm_plan(0, LONG, day=140).materials)
    for day in (180, 200):
        plan, scene = farm_plan(0, LONG, day=day), farm_scene(0, LONG, bands=2, day=day)
        lodged = [name for name in plan.materials if "lodged" in name]
        parts.append(np.sum([plane(scene, plan, name) for name in lodged], axis=0))
        lies = np.flatnonzero(parts[-1] > 0.6)
        wheat = np.isin(labels_of(scene).ravel()[lies], [CLASSES.index("wheat_a"), CLASSES.index("wheat_b")])
        assert wheat.all()
    first, last = (part > 0.5 for part in parts)
    assert 0 < first.sum() < last.sum()
    assert (first & (parts[1] > 0.3)).sum() > 0.9 * first.sum()


def test_edges_are_mixed_pixels() -> None:
    """Water's pixels at the shore hold a part of it, not all or nothing."""
    plan, scene = farm_plan(0, SIZE), farm_scene(0, SIZE, bands=2)
    water = plane(scene, plan, "water")
    part = (water > 0.15) & (water < 0.75)
    assert 0.1 < part.sum() / (water > 0.15).sum() < 0.8


def test_planes_are_the_plans_materials() -> None:
    """A day's scene mixes only what the day can show, in the order of the whole list."""
    plan = farm_plan(0, day=225)
    assert len(plan.materials) < len(MATERIALS)
    assert list(plan.materials) == sorted(plan.materials, key=MATERIALS.index)
    assert not any(name.startswith("wheat") for name in plan.materials)
    assert farm_scene(0, bands=3, day=225).electrons.shape == (len(plan.materials), 3)


def test_a_key_tells_its_law() -> None:
    """That of the removed farm too, for archives hold it; a file's tells none."""
    assert law_of_key(farm_scene(0, (8, 8)).key) == FARM_LAW == "farm@2"
    assert law_of_key("farm@1/seed=4/shape=20x30/bands=270/full_well=20155") == "farm@1"
    assert law_of_key("3f2a") is None


def test_the_removed_farm_is_refused() -> None:
    """By its name alone, with what to take and what its archives are still good for."""
    refuse_removed("farm")
    with pytest.raises(SettingsError, match=r"farm@1 was removed: take farm \(farm@2\).*can still be listed, verified"):
        refuse_removed("farm@1")


@pytest.mark.parametrize(
    ("what", "error", "words"),
    [
        *(({"day": day}, SceneError, rf"day is 1 to 366, counted from 1 January, got {day}") for day in (0, 367, -5)),
        *(
            ({"day": day, "hour": hour}, SceneError, "the sun stands at .* degrees.*take an hour nearer to 12")
            for day, hour in ((172, 1.0), (355, 16.0), (172, float("nan")))
        ),
        ({"seed": -1}, SceneError, "got seed -1, shape"),
        ({"shape": (0, 8)}, SceneError, "got seed 0, shape"),
        ({"bands": 1}, WavelengthError, "at least 2 bands"),
    ],
)
def test_impossible_farms_are_refused(what: dict[str, Any], error: type[Exception], words: str) -> None:
    """A day of no year, a farm without sun, a negative seed, an empty shape or one band, each with what came."""
    with pytest.raises(error, match=words):
        farm_scene(**{"seed": 0, "shape": (8, 8), **what})
