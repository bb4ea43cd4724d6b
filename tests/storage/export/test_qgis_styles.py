"""QGIS styles: the classes, ranges and colours that they were given stand in them, as QGIS names these things."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from storage.export.qgis_styles import (
    REDS,
    ramp_colour,
    write_class_style,
    write_colour_style,
    write_polygon_style,
    write_ramp_style,
)

ENTRIES = [(0, "soil & stones", (158, 119, 82)), (7, 'weed "wild"', (220, 30, 30))]


def test_classes_have_names_and_colours(tmp_path: Path) -> None:
    """A palette's entries by number; letters that XML keeps for itself come back."""
    write_class_style(tmp_path / "a.qml", ENTRIES)
    root = ElementTree.parse(tmp_path / "a.qml").getroot()
    assert root.tag == "qgis"
    found = [dict(entry.attrib) for entry in root.iterfind("pipe/rasterrenderer[@type='paletted']/colorPalette/*")]
    assert [(one["value"], one["label"], one["color"]) for one in found] == [
        ("0", "soil & stones", "#9e7752"),
        ("7", 'weed "wild"', "#dc1e1e"),
    ]


def test_ramps_go_from_low_to_high(tmp_path: Path) -> None:
    """Values evenly apart, the outer ones those given; three bands by their numbers with one range."""
    write_ramp_style(tmp_path / "a.qml", -0.5, 1.5, REDS)
    items = list(ElementTree.parse(tmp_path / "a.qml").iterfind(".//colorrampshader/item"))
    assert [(float(item.attrib["value"]), item.attrib["color"]) for item in items][::2] == [
        (-0.5, "#ffebcd"),
        (1.5, "#960014"),
    ]
    write_colour_style(tmp_path / "a.qml", (7, 4, 1), 0.1, 0.6)
    (renderer,) = ElementTree.parse(tmp_path / "a.qml").iterfind("pipe/rasterrenderer")
    assert [renderer.attrib[f"{name}Band"] for name in ("red", "green", "blue")] == ["7", "4", "1"]
    assert {one.text for one in renderer.iterfind("*/maxValue")} == {"0.6"}


def test_polygons_have_a_symbol_each(tmp_path: Path) -> None:
    """Every category of the column leads to a symbol with its colour."""
    write_polygon_style(tmp_path / "a.qml", "dose", [(0.0, "none", (215, 215, 215)), (2.5, "2.5 l/ha", (150, 0, 20))])
    (renderer,) = ElementTree.parse(tmp_path / "a.qml").iterfind("renderer-v2[@attr='dose']")
    found = {}
    for category in renderer.iterfind("categories/category"):
        symbol = renderer.find(f"symbols/symbol[@name='{category.attrib['symbol']}']")
        assert symbol is not None
        colour = symbol.find(".//Option[@name='color']")
        assert colour is not None
        found[float(category.attrib["value"])] = colour.attrib["value"]
    assert found == {0.0: "215,215,215,255", 2.5: "150,0,20,255"}


@pytest.mark.parametrize(("share", "colour"), [(0, REDS[0]), (0.5, REDS[1]), (1, REDS[2]), (2, REDS[2]), (-1, REDS[0])])
def test_a_ramp_meets_its_colours(share: float, colour: tuple[int, ...]) -> None:
    """At its ends and in its middle; beyond the ends those stay."""
    assert ramp_colour(share, REDS) == colour
