"""Checks of exports: STAC's own core schemas, and the layout of cloud-optimised files."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import rasterio
from pystac.validation.local_validator import get_local_schema_cache
from referencing import Registry, Resource


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
