"""Fields of STAC's extensions are as their documentation asks; what is not, is found."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.export.stac_items import write_stac
from tests.storage.export.stac_rules import extension_problems
from tests.storage.export.test_stac_items import ABOUT, item

pytest.importorskip("pystac", reason="STAC is written with pystac, of the extra [geo]")


@pytest.fixture
def content(tmp_path: Path) -> dict[str, Any]:
    """An item with every extension in it."""
    found: dict[str, Any] = json.loads(write_stac(tmp_path, ABOUT, item("r1"))[0].read_text())
    return found


@pytest.mark.parametrize("placed", [True, False])
def test_items_are_as_the_extensions_ask(tmp_path: Path, placed: bool) -> None:
    """With a place on the map and without one."""
    path = write_stac(tmp_path, ABOUT, item("r1", placed=placed))[0]
    assert extension_problems(json.loads(path.read_text())) == []


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("properties", "proj:code"), 32632, "is not of type 'string'"),
        (("properties", "proj:code"), "32632", "does not match"),
        (("properties", "proj:epsg"), 32632, "no field that is known"),
        (("properties", "hsi:wavelength_min"), 444.5, "greater than the maximum"),
        (("properties", "hsi:wavelength_min"), 0.9, "go from 0.9 to 0.8"),
        (("properties", "processing:level"), "4", "is not one of"),
        (("properties", "processing:software"), {"a": 1}, "is not of type 'string'"),
        (("assets", "class_map", "proj:shape"), [80, 100, 1], "is too long"),
        (("assets", "class_map", "proj:shape"), [100, 80], "is not that of transform and shape"),
        (("assets", "class_map", "proj:transform"), [0.5, 0, 0, 0, -0.5], "is not valid under any"),
        (("assets", "class_map", "hsi:wavelength_min"), 0.4, "does not belong there"),
        (("assets", "mosaic", "bands", 0, "eo:center_wavelength"), 0, "less than or equal"),
        (("assets", "class_map", "classification:classes", 0, "name"), "sugar beet", "does not match"),
        (("assets", "class_map", "classification:classes", 0, "color_hint"), "#0AC81E", "does not match"),
        (("assets", "class_map", "classification:classes", 0, "value"), 1, "two classes have one value"),
        (("stac_extensions",), [], "stac_extensions names"),
    ],
)
def test_what_the_extensions_do_not_allow_is_found(
    content: dict[str, Any], place: tuple[Any, ...], value: Any, words: str
) -> None:
    """Each rule has a field that breaks it."""
    broken = copy.deepcopy(content)
    part: Any = broken
    for name in place[:-1]:
        part = part[name]
    part[place[-1]] = value
    assert any(words in text for text in extension_problems(broken))


def test_numbers_are_those_of_json(content: dict[str, Any]) -> None:
    """Nothing in an item is a number that JSON does not have."""
    assert np.isfinite(content["assets"]["class_map"]["proj:transform"]).all()
    json.dumps(content, allow_nan=False)
