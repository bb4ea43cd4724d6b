"""Names of classes that lie beside label files: a list in a text file, JSON, and what GDAL, QGIS and ENVI write.

Each is read leniently, as people write them: ``1 crop``, ``crop: 1``, ``crop, 0, 255, 0``, ``#00ff00 crop``, or names
alone, in the order of their numbers.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from pipeline.errors import SceneError
from storage.readers.envi_cubes import find_envi_pair, load_envi_header
from storage.readers.scene_toml import ClassValue

STEMS = ("classes", "class_names", "classnames", "labels", "label_names", "legend", "categories", "class_dict", "names")
TEXTS, TABLES = (".txt", ".csv", ".tsv"), (".json",)
MOST_BYTES = 1 << 20  # of a legend
_HEX = re.compile(r"^#?([0-9a-fA-F]{6})$")


@dataclass(frozen=True)
class Legend:
    """Names by the value of their class in the label files, or in the order of their numbers where no value is told."""

    path: Path
    names: Mapping[ClassValue, str]
    listed: tuple[str, ...] = ()

    def name_of(self, value: ClassValue, place: int, values: Sequence[ClassValue]) -> str | None:
        """The name of a value, the ``place``-th of the ``values`` that the files hold; None where none is told.

        Names in a list without numbers are those of 0, 1, ...; where there are as many as values, of these in order.
        """
        if value in self.names:
            return self.names[value]
        if isinstance(value, int) and self.listed and max(v for v in values if isinstance(v, int)) < len(self.listed):
            return self.listed[value]
        return self.listed[place] if isinstance(value, int) and len(self.listed) == len(values) else None


def find_legend(folders: Sequence[Path], labels: Sequence[Path]) -> Legend | None:
    """The first legend beside the labels, or one that stands in or beside a label file; None where there is none."""
    for label in labels[:1]:
        for found in _of_label(label):
            if found.names or found.listed:
                return found
    for folder in dict.fromkeys(folders):
        for path in sorted(folder.iterdir()):
            if path.stem.lower() in STEMS and path.suffix.lower() in (*TEXTS, *TABLES) and path.is_file():
                legend = read_legend(path)
                if legend is not None:
                    return legend
    return None


def read_legend(path: Path) -> Legend | None:
    """Read one legend; None where nothing in it names a class."""
    if path.stat().st_size > MOST_BYTES:
        return None
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() in TABLES:
            pairs = list(_of_table(json.loads(text)))
        else:
            pairs = [pair for line in text.splitlines() if (pair := _of_line(line)) is not None]
    except (ValueError, RecursionError):
        return None
    names = {value: name for value, name in pairs if value is not None}
    listed = tuple(name for value, name in pairs if value is None)
    return Legend(path, names, listed) if names or listed else None


def _of_line(line: str) -> tuple[ClassValue | None, str] | None:
    """Value and name of one line, in any order; None of a heading, a comment or an empty line."""
    bare = line.strip()
    if not bare or bare.startswith(("//", "__ignore__")) or (bare.startswith("#") and not _HEX.match(bare.split()[0])):
        return None
    parts = next(csv.reader([bare])) if "," in bare else re.split(r"[\t:;=]+", bare)
    words = [word for part in parts for word in part.split()]
    numbers = [int(word) for word in words if word.isdecimal()]
    colours = [found[1] for word in words if (found := _HEX.match(word)) and not word.isdecimal()]
    name = " ".join(w for w in words if not w.isdecimal() and not (_HEX.match(w) and w.startswith("#")))
    if not name or name.lower().split()[0] in ("name", "class", "id", "r"):
        return None
    if len(numbers) >= 3 and max(numbers[-3:]) < 256:
        return (numbers[-3], numbers[-2], numbers[-1]), name
    if not numbers and colours and name != colours[0]:
        return _colour(colours[0]), name
    return (numbers[0] if numbers else None), name


def _colour(hexadecimal: str) -> ClassValue:
    red, green, blue = bytes.fromhex(hexadecimal)
    return red, green, blue


def _of_table(content: Any) -> Iterator[tuple[ClassValue | None, str]]:
    """Pairs of value and name in what a JSON file holds, however they are put."""
    if isinstance(content, dict):
        inner = next((content[key] for key in ("classes", "categories", "labels", "legend") if key in content), None)
        if isinstance(inner, dict | list):
            yield from _of_table(inner)
            return
        for key, value in content.items():
            if isinstance(value, str):
                yield _value(key), value
            elif (found := _value(value)) is not None:
                yield found, str(key)
    elif isinstance(content, list):
        for entry in content:
            if isinstance(entry, str):
                yield None, entry
            elif isinstance(entry, dict):
                told = [entry.get(key) for key in ("color", "colour", "rgb", "id", "value", "index", "class")]
                values = [found for one in told if (found := _value(one)) is not None]
                name = entry.get("name", entry.get("label", entry.get("title")))
                if isinstance(name, str):
                    yield (values[0] if values else None), name


def _value(told: Any) -> ClassValue | None:
    if isinstance(told, bool):
        return None
    if isinstance(told, int):
        return told
    if isinstance(told, str):
        found = _HEX.match(told)
        return int(told) if told.isdecimal() else None if found is None else _colour(found[1])
    if isinstance(told, list) and len(told) >= 3 and all(isinstance(one, int) and 0 <= one < 256 for one in told[:3]):
        return told[0], told[1], told[2]
    return None


def _of_label(label: Path) -> Iterator[Legend]:
    """What stands beside one label file: GDAL's .aux.xml, QGIS's .qml; of ENVI, what its header says."""
    for path in (label.with_name(label.name + ".aux.xml"), label.with_suffix(".qml")):
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            continue
        try:
            root = ElementTree.fromstring(path.read_bytes())
        except ElementTree.ParseError:
            continue
        listed = tuple((entry.text or "").strip() for entry in root.iter("Category"))
        entries = [(entry.get("value", ""), entry.get("label", "")) for entry in root.iter("paletteEntry")]
        yield Legend(
            path,
            {int(value): name for value, name in entries if value.isdecimal() and len(value) < 10 and name},
            listed,
        )
    try:
        header, _ = find_envi_pair(label)
        told = load_envi_header(header).fields.get("class names", "") if header.is_file() else ""
    except SceneError:
        return
    yield Legend(header, {}, tuple(name.strip() for name in told.split(",") if name.strip()))
