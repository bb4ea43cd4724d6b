"""The scouted field: one crop with patches of interest, the same land on all days, with the farm's classes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from spectralzoom.pipeline.errors import SceneError
from spectralzoom.pipeline.simulator.scenes.built_in import (
    SCOUTED,
    built_in_scene,
    patches_of,
    scouting_plan,
    scouting_scene,
)
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASS_COLOURS, CLASSES

SIZE = (320, 400)
SEEDS = (0, 1, 2, 3, 33)


def test_equal_arguments_give_equal_fields() -> None:
    """One seed and day give one scene, bit for bit, by name and by law."""
    first, second = (scouting_scene(7, SIZE, 5, day=165) for _ in range(2))
    named = built_in_scene("scouting", 7, SIZE, 5, day=165)
    assert first.key == second.key == named.key
    for other in (second, named):
        np.testing.assert_array_equal(first.planes, other.planes)
        np.testing.assert_array_equal(first.labels, other.labels)


def test_land_is_the_same_on_another_day() -> None:
    """Wheel marks and patches stay in place, and ground that is bare in June is bare in May and July."""
    plans = [scouting_plan(5, SIZE, day=day, hour=11.0) for day in (140, 172)]
    assert plans[0].fields[0].tramlines == plans[1].fields[0].tramlines
    patches = [patches_of(plan) for plan in plans]
    for name, cover in patches[0].items():
        np.testing.assert_array_equal(cover, patches[1][name])
    for day in (140, 172, 190):
        bare = scouting_scene(5, SIZE, 2, day=day).labels[patches[0]["bare"] > 0.9]
        assert (bare == CLASSES.index("soil")).mean() > 0.97


@pytest.mark.parametrize("seed", SEEDS[::2])
@pytest.mark.parametrize("interest", [None, 1 / 4])
def test_patches_cover_the_requested_fraction(seed: int, interest: float | None) -> None:
    """The pixels that differ from a field without patches cover the requested fraction, 2 to 10 % by default."""
    day = 185  # every kind is visible
    scene, plain = (scouting_scene(seed, SIZE, 2, day=day, interest=share) for share in (interest, 0.0))
    changed = float((np.abs(scene.planes - plain.planes).sum(axis=2) > 0.2).mean())
    patches = patches_of(scouting_plan(seed, SIZE, day=day, hour=11.0), interest)
    cover = sum(float(one.mean()) for one in patches.values())
    if interest is None:
        assert 0.015 < cover < 0.105
    else:
        assert cover == pytest.approx(interest, rel=0.05)
    assert changed == pytest.approx(cover, rel=0.25)


@pytest.mark.parametrize("seed", SEEDS[::2])
def test_patches_are_clustered(seed: int) -> None:
    """Patches on 1/16 of the field are at most 15; their 5 to 95 % range of rows and columns is below a third."""
    interest = sum(patches_of(scouting_plan(seed, (512, 640), day=172, hour=11.0), 1 / 16).values()) > 0.5
    assert ndimage.label(interest)[1] <= 15
    y, x = (np.percentile(place, [5, 95]) for place in np.nonzero(interest))
    assert np.ptp(y) * np.ptp(x) < 512 * 640 / 3


def test_classes_are_those_of_the_farm() -> None:
    """Names, colours and order agree; the seed's crop fills the field, with weeds, bare ground and wheel marks."""
    uses = set()
    for seed in SEEDS:
        scene = scouting_scene(seed, SIZE, 2)
        assert scene.class_names == CLASSES
        np.testing.assert_array_equal(scene.class_colours, CLASS_COLOURS)
        shares = {name: float((scene.labels == number).mean()) for number, name in enumerate(CLASSES)}
        crop = scouting_plan(seed, SIZE, day=172, hour=11.0).fields[0].use
        uses.add(crop)
        assert shares[crop] > 0.8
        assert 0.02 < shares["track"] < 0.06
        assert sum(shares[name] for name in (crop, "soil", "weed", "track")) == pytest.approx(1)
    assert uses == set(SCOUTED)


def test_key_contains_interest_and_light() -> None:
    """Each is written only if it is not the default, after law, seed and day."""
    scene = scouting_scene(3, (20, 30), 7)
    assert scene.key == "scouting@1/seed=3/day=172/shape=20x30/hour=11/bands=7/full_well=20155"
    assert scouting_scene(3, (20, 30), 7, interest=0.25).key == scene.key.replace("/bands", "/interest=0.25/bands")
    assert scene.in_light(0.125).key == f"{scene.key}/light=0.125"


@pytest.mark.parametrize("interest", [-0.1, 1.5, float("nan")])
def test_interest_outside_0_to_1_is_refused(interest: float) -> None:
    """The message names the fraction, NaN included."""
    with pytest.raises(SceneError, match=f"from 0 to 1, got {interest:g}"):
        scouting_scene(0, (8, 8), interest=interest)


def test_less_light_scales_scene_and_white_reference_alike() -> None:
    """Electrons of both fall by the fraction and scene values stay; repeated fractions multiply."""
    scene = scouting_scene(2, (24, 32), 9)
    dim = scene.in_light(0.5).in_light(0.25)
    np.testing.assert_array_equal(dim.electrons, scene.electrons * np.float32(0.125))
    np.testing.assert_array_equal(dim.white_reference_electrons, scene.white_reference_electrons * np.float32(0.125))
    np.testing.assert_array_equal(dim.values(), scene.values())
    assert (dim.light_fraction, dim.key, dim.clear_key) == (0.125, f"{scene.key}/light=0.125", scene.key)
    assert scene.in_light(1.0) is scene
