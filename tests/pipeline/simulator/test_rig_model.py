"""The rig's numbers: finite, within the range that makes sense, and refused with the setting's name."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import pytest

from pipeline.errors import SettingsError
from pipeline.simulator.rig_model import Rig

RIG = Rig()
PARTS = ("camera", "optics", "mirror", "detector", "air", "sky")
NUMBERS = [
    (part, item)
    for part in PARTS
    for item in fields(getattr(RIG, part))
    if "least" in item.metadata or (part == "camera" and isinstance(item.default, float))
]


def with_number(part: str, name: str, value: Any) -> Rig:
    """A rig as its defaults are but for one number."""
    return replace(RIG, **{part: replace(getattr(RIG, part), **{name: value})})


@pytest.mark.parametrize(("part", "item"), NUMBERS, ids=lambda one: getattr(one, "name", one))
def test_numbers_that_are_not_finite_are_refused_by_name(part: str, item: Any):
    """Infinity only where it is the default; no number never."""
    for value in (math.nan, -math.inf, math.inf):
        if value == item.default:
            assert with_number(part, item.name, value) == RIG
            continue
        with pytest.raises(SettingsError, match=rf"{part}\.{item.name} must be a (finite )?number"):
            with_number(part, item.name, value)


def test_numbers_beyond_their_range_are_refused_with_it():
    """Aperture and share of stray light."""
    with pytest.raises(SettingsError, match=r"optics\.aperture_mm must be a number from 0\.1 to 1000 mm, got 0"):
        with_number("optics", "aperture_mm", 0.0)
    with pytest.raises(SettingsError, match=r"optics\.stray_share must be a number from 0 to 0\.5, got 0\.6"):
        with_number("optics", "stray_share", 0.6)


def test_a_distance_may_be_endless_but_not_nothing():
    """None is light at the aperture, infinity the limit of no parallax."""
    assert with_number("air", "distance_m", math.inf).distances_m == (math.inf, math.inf)
    with pytest.raises(SettingsError, match=r"air\.distance_m must be a number of at least 0\.001 m or inf, got nan"):
        with_number("air", "distance_m", math.nan)
