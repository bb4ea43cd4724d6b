"""The farm through the year: one land for all days of a seed, mixtures as fractions, and changes between days."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spectralzoom.pipeline.errors import SceneError, WavelengthError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.simulator.scenes.farm.farm_plan import CLASSES, farm_plan
from spectralzoom.pipeline.simulator.scenes.farm.farm_scene import farm_scene
from spectralzoom.pipeline.simulator.scenes.farm.spectra import MATERIALS
from spectralzoom.pipeline.simulator.scenes.laws import FARM_LAW

SIZE, LONG, WIDE = (420, 520), (400, 1000), (720, 1000)


@pytest.mark.parametrize(
    ("seed", "when", "labels", "mixed", "lit"),
    [
        (0, {}, "75b01f2e26544f2a", 1.437027, -17072.630),
        (3, {"day": 130}, "10d5439643e6121f", -23.194811, -301.181),
        (7, {"day": 250, "hour": 16.0}, "c639cef3070fccce", -0.158003, -995.926),
    ],
)
def test_law_gives_the_same_farms(seed: int, when: dict[str, Any], labels: str, mixed: float, lit: float) -> None:
    """Land, days, hours and spectra of law farm@2 match stored values: labels by their hash, the rest by sums."""
    scene = farm_scene(seed, (160, 200), bands=5, **when)
    assert hashlib.sha256(scene.labels.tobytes()).hexdigest().startswith(labels)
    sums = [float(one.ravel() @ np.cos(np.arange(one.size))) for one in (scene.planes, scene.electrons)]
    assert sums == pytest.approx([mixed, lit], abs=2e-3)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**40), st.integers(1, 70), st.integers(1, 70), st.integers(1, 366))
def test_abundances_are_fractions(seed: int, height: int, width: int, day: int) -> None:
    """Abundances of any seed, size and day are non-negative and sum to 1, and every pixel has a known class."""
    scene = farm_scene(seed, (height, width), bands=2, day=day)
    assert scene.planes.dtype == np.float32
    assert scene.planes.shape[2] <= 40
    assert scene.planes.min() >= 0
    np.testing.assert_allclose(scene.planes.sum(axis=-1), 1, atol=2e-6)
    assert scene.labels.max() < len(CLASSES)


def test_key_contains_law_and_day() -> None:
    """The key names law, seed, day and shape, and changes with day, hour and camera."""
    key = farm_scene(42, (20, 30), bands=7, day=99).key
    assert key.startswith(f"{FARM_LAW}/seed=42/day=99/shape=20x30")
    others = [
        farm_scene(42, (20, 30), bands=7, day=100),
        farm_scene(42, (20, 30), bands=7, day=99, hour=9.5),
        farm_scene(42, (20, 30), bands=7, camera=LineCamera(electrons_per_dn=3.0), day=99),
    ]
    assert len({key, *(scene.key for scene in others)}) == 4


def test_land_is_the_same_on_another_day() -> None:
    """Fields, rows and borders stay in place; trees and ponds of April and June overlap by more than 75 %."""
    june, april = farm_plan(4, SIZE, day=172), farm_plan(4, SIZE, day=110)
    for one, other in zip(june.fields, april.fields, strict=True):
        np.testing.assert_array_equal(one.parcel.corners, other.parcel.corners)
        assert (one.use, one.row_angle_deg, one.row_period_px) == (other.use, other.row_angle_deg, other.row_period_px)
    assert [kind for _, kind in june.borders] == [kind for _, kind in april.borders]
    scenes = [farm_scene(4, SIZE, bands=2, day=day).labels for day in (110, 172)]
    for label in ("tree", "water"):
        masks = [scene == CLASSES.index(label) for scene in scenes]
        assert (masks[0] & masks[1]).sum() > 0.75 * (masks[0] | masks[1]).sum()


def test_planes_are_the_materials_of_the_day() -> None:
    """A day's scene mixes only materials of that day, in the order of the whole list."""
    plan = farm_plan(0, day=225)
    assert len(plan.materials) < len(MATERIALS)
    assert list(plan.materials) == sorted(plan.materials, key=MATERIALS.index)
    assert not any(name.startswith("wheat") for name in plan.materials)
    assert farm_scene(0, bands=3, day=225).electrons.shape == (len(plan.materials), 3)


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
    """A day outside of the year, a farm without sun, a negative seed, an empty shape and a single band are errors."""
    with pytest.raises(error, match=words):
        farm_scene(**{"seed": 0, "shape": (8, 8), **what})
