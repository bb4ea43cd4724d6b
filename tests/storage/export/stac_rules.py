"""Checks of exported STAC items: handwritten schemas of the extension fields, and STAC's own core schemas.

The extensions' official schemas lie on a server and come with no package. The schemas here follow the extensions'
documentation for each exported field: name, type, range, and fields that need each other. They leave out
fields that are not exported, collections' summaries, and rules that only the official schemas have.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import rasterio
from pystac.validation.local_validator import get_local_schema_cache
from referencing import Registry, Resource

NUMBER, TEXT = {"type": "number"}, {"type": "string", "minLength": 1}
FIELDS: Mapping[str, Mapping[str, Any]] = {
    "proj:code": {"type": ["string", "null"], "pattern": "^[A-Za-z0-9_]+:[A-Za-z0-9_]+$"},
    "proj:wkt2": {"type": ["string", "null"], "pattern": r"^[A-Z]+CRS\["},
    "proj:shape": {"type": "array", "items": {"type": "integer", "minimum": 1}, "minItems": 2, "maxItems": 2},
    "proj:transform": {"type": "array", "items": NUMBER, "anyOf": [{"minItems": n, "maxItems": n} for n in (6, 9)]},
    "proj:bbox": {"type": "array", "items": NUMBER, "anyOf": [{"minItems": n, "maxItems": n} for n in (4, 6)]},
    "processing:level": {"enum": ["RAW", "L0", "L1", "L2", "L3", "L4"]},
    "processing:lineage": TEXT,
    "processing:software": {"type": "object", "minProperties": 1, "additionalProperties": {"type": "string"}},
}
PREFIXES = {"proj": "projection/v2.0.0", "processing": "processing/v1.2.0"}


def extension_problems(item: Mapping[str, Any]) -> list[str]:
    """Return the problems of the extension fields in one item; empty if there are none."""
    return list(_problems(item))


def _problems(item: Mapping[str, Any]) -> Iterator[str]:
    used = set()
    for place, kind, table in _tables(item):
        for name in table:
            prefix, sign, _ = name.partition(":")
            if not sign:
                continue
            used.add(prefix)
            if name not in FIELDS:
                yield f"{place}: {name} is no field that is known"
            elif kind == "band":  # fields of both extensions stand in properties and assets
                yield f"{place}: {name} does not belong there"
            else:
                checker = jsonschema.Draft7Validator(FIELDS[name])
                yield from (f"{place}: {name}: {error.message}" for error in checker.iter_errors(table[name]))
        yield from (f"{place}: {text}" for text in _together(table))
    uri = "https://stac-extensions.github.io/{}/schema.json"
    stated = {prefix for prefix, name in PREFIXES.items() if uri.format(name) in item["stac_extensions"]}
    if stated != used or len(stated) != len(item["stac_extensions"]):
        yield f"stac_extensions names {sorted(stated)}, used are {sorted(used)}"


def _tables(item: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    yield "properties", "properties", item["properties"]
    for key, asset in item["assets"].items():
        yield key, "asset", asset
        for number, band in enumerate(asset.get("bands", ())):
            yield f"{key}, band {number}", "band", band


def _together(table: Mapping[str, Any]) -> Iterator[str]:
    """Yield problems of fields that need each other."""
    if "proj:bbox" in table and table.get("proj:code") is None and table.get("proj:wkt2") is None:
        yield "proj:bbox without a CRS"
    box, transform, shape = (table.get(f"proj:{name}") for name in ("bbox", "transform", "shape"))
    if box and transform and shape and len(transform) >= 6 and len(shape) == 2:
        a, _, c, _, e, f = transform[:6]
        rows, columns = shape
        corners = [min(c, c + a * columns), min(f, f + e * rows), max(c, c + a * columns), max(f, f + e * rows)]
        if any(abs(one - other) > 1e-6 * max(abs(one), 1) for one, other in zip(box, corners, strict=True)):
            yield f"proj:bbox {box} is not that of transform and shape, {corners}"


def core_problems(path: Path) -> list[str]:
    """Return the problems of an item or a collection by STAC's core schemas, which pystac brings."""
    content = json.loads(path.read_text(encoding="utf-8"))
    schemas = get_local_schema_cache()
    known = Registry().with_resources([(name, Resource.from_contents(schema)) for name, schema in schemas.items()])
    kind = "collection" if content.get("type") == "Collection" else "item"
    schema = schemas[f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json"]
    errors = jsonschema.Draft7Validator(schema, registry=known).iter_errors(content)
    return [f"{error.json_path}: {error.message}" for error in errors]


def is_cog(path: Path) -> bool:
    """Return whether GDAL finds the layout of a cloud-optimised file, with overviews down to one tile of 512 px."""
    with rasterio.open(path) as file:
        levels = [1, *file.overviews(1)]
        tiled = file.profile.get("tiled") or max(file.shape) <= 512
        of_cog = file.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG"
        return bool(of_cog and tiled and max(file.shape) / levels[-1] <= 512)
