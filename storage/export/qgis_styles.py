"""QGIS style files (.qml) beside rasters and polygons: classes with names and colours, ramps, bands as colours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from storage.archive.whole_files import write_whole

STYLE = "application/xml"
VERSION = "3.34"  # of QGIS, the earliest that these were written for
GREENS = ((120, 70, 20), (240, 230, 150), (20, 110, 30))  # of indices, from low to high
GREYS = ((0, 0, 0), (255, 255, 255))
REDS = ((255, 235, 205), (245, 130, 50), (150, 0, 20))  # of doses above 0
NONE = (215, 215, 215)  # of a dose of 0

Colour = tuple[int, ...]
Entry = tuple[Any, str, Colour]  # value, name, red green blue


def ramp_colour(share: float, ramp: Sequence[Colour]) -> Colour:
    """The colour at a share, 0 to 1, of a ramp of colours evenly apart."""
    place = min(max(share, 0.0), 1.0) * (len(ramp) - 1)
    low = min(int(place), len(ramp) - 2)
    return tuple(round(a + (place - low) * (b - a)) for a, b in zip(ramp[low], ramp[low + 1], strict=True))


def write_class_style(path: Path, classes: Sequence[Entry]) -> None:
    """Style a raster of class numbers."""
    root, renderer = _raster({"type": "paletted", "band": "1", "opacity": "1", "alphaBand": "-1"})
    palette = SubElement(renderer, "colorPalette")
    for number, name, colour in classes:
        SubElement(palette, "paletteEntry", value=str(number), label=name, color=_hex(colour), alpha="255")
    _write(path, root)


def write_ramp_style(path: Path, low: float, high: float, ramp: Sequence[Colour]) -> None:
    """Style a raster of one band by a ramp of colours from ``low`` to ``high``."""
    span = {"classificationMin": f"{low:g}", "classificationMax": f"{high:g}"}
    root, renderer = _raster({"type": "singlebandpseudocolor", "band": "1", "opacity": "1", "alphaBand": "-1", **span})
    kind = {"colorRampType": "INTERPOLATED", "classificationMode": "2", "clip": "0"}
    scale = {"minimumValue": f"{low:g}", "maximumValue": f"{high:g}"}
    shader = SubElement(SubElement(renderer, "rastershader"), "colorrampshader", {**kind, **scale})
    for number, colour in enumerate(ramp):
        value = f"{low + (high - low) * number / (len(ramp) - 1):g}"
        SubElement(shader, "item", value=value, label=value, color=_hex(colour), alpha="255")
    _write(path, root)


def write_colour_style(path: Path, bands: Sequence[int], low: float, high: float) -> None:
    """Style a raster by three of its bands, counted from 1, as red, green and blue, each from ``low`` to ``high``."""
    named = dict(zip(("redBand", "greenBand", "blueBand"), map(str, bands), strict=True))
    root, renderer = _raster({"type": "multibandcolor", "opacity": "1", "alphaBand": "-1", **named})
    for colour in ("red", "green", "blue"):
        stretch = SubElement(renderer, f"{colour}ContrastEnhancement")
        for name, text in (
            ("minValue", f"{low:g}"),
            ("maxValue", f"{high:g}"),
            ("algorithm", "StretchToMinimumMaximum"),
        ):
            SubElement(stretch, name).text = text
    _write(path, root)


def write_polygon_style(path: Path, column: str, entries: Sequence[Entry]) -> None:
    """Style polygons by the values of one column."""
    root = Element("qgis", version=VERSION, styleCategories="Symbology")
    about = {"type": "categorizedSymbol", "attr": column, "symbollevels": "0", "enableorderby": "0"}
    renderer = SubElement(root, "renderer-v2", about)
    categories, symbols = SubElement(renderer, "categories"), SubElement(renderer, "symbols")
    for number, (value, name, colour) in enumerate(entries):
        kind = "string" if isinstance(value, str) else "double"
        words = {"symbol": str(number), "value": str(value), "label": name, "type": kind, "render": "true"}
        SubElement(categories, "category", words)
        symbol = SubElement(symbols, "symbol", {"name": str(number), "type": "fill", "alpha": "0.8"})
        options = SubElement(SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1"}), "Option", type="Map")
        fill = ",".join(map(str, (*colour, 255)))
        for key, text in (
            ("color", fill),
            ("style", "solid"),
            ("outline_color", "60,60,60,255"),
            ("outline_width", "0.1"),
        ):
            SubElement(options, "Option", {"name": key, "type": "QString", "value": text})
    SubElement(root, "layerGeometryType").text = "2"
    _write(path, root)


def _raster(renderer: dict[str, str]) -> tuple[Element, Element]:
    root = Element("qgis", version=VERSION, styleCategories="Symbology")
    return root, SubElement(SubElement(root, "pipe"), "rasterrenderer", renderer)


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _write(path: Path, root: Element) -> None:
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    write_whole(path, f"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n{text}\n")
