"""Farms by name: each law gives the scene that its own module gives, and only one of them knows days."""

from __future__ import annotations

import pytest

from pipeline.errors import SceneError
from pipeline.geometry.camera import LineCamera
from pipeline.simulator.farm import farm_scene
from pipeline.simulator.farm_laws import (
    BUILT_IN_SCENE,
    FARM_LAW,
    FARM_NAMES,
    SEASON_LAW,
    built_in_farm,
    farm_law,
    has_days,
    law_of_key,
)
from pipeline.simulator.farm_on_day import farm_on_day

SHAPE = (20, 30)


def test_a_name_gives_the_scene_of_its_law() -> None:
    """Key by key; ``farm`` is the present one of them."""
    camera = LineCamera(electrons_per_dn=3.0)
    assert built_in_farm(FARM_LAW, 4, SHAPE, camera=camera).key == farm_scene(4, SHAPE, camera=camera).key
    later = built_in_farm(SEASON_LAW, 4, SHAPE, camera=camera, day=99, hour=13.5)
    assert later.key == farm_on_day(4, SHAPE, camera=camera, day=99, hour=13.5).key
    assert built_in_farm(SEASON_LAW, 4, SHAPE).key == farm_on_day(4, SHAPE).key
    assert built_in_farm("farm", 4, SHAPE).key == built_in_farm(BUILT_IN_SCENE, 4, SHAPE).key
    assert farm_law("farm") == BUILT_IN_SCENE


def test_the_first_law_keeps_its_key() -> None:
    """What archives of surveys of it are keyed by."""
    assert built_in_farm(FARM_LAW, 4, SHAPE).key == "farm@1/seed=4/shape=20x30/bands=270/full_well=20155"


@pytest.mark.parametrize("name", FARM_NAMES)
def test_a_key_tells_its_law(name: str) -> None:
    """That of a file, or of a law that is drawn no more, tells none."""
    assert law_of_key(built_in_farm(name, 0, SHAPE).key) == farm_law(name)
    assert law_of_key("farm@0/seed=1") is None
    assert law_of_key("3f2a") is None


def test_only_the_second_law_has_days() -> None:
    """A day or an hour for the first is refused with what to take instead."""
    assert [has_days(name) for name in (FARM_LAW, SEASON_LAW, "field.png")] == [False, True, False]
    with pytest.raises(SceneError, match="farm@1 is of one day and hour; take farm@2"):
        built_in_farm(FARM_LAW, 0, SHAPE, hour=12.0)


def test_unknown_farms_are_refused() -> None:
    """With those that there are."""
    with pytest.raises(SceneError, match="called 'farm@3'; there are farm, farm@1, farm@2"):
        built_in_farm("farm@3", 0, SHAPE)
