"""Write polygons as users have them: files of named outlines in any coordinates."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas
from shapely.geometry.base import BaseGeometry


def sketch(path: Path, shapes: Mapping[str, BaseGeometry], crs: Any = None, **choices: Any) -> str:
    """Write polygons by name, in pixels if there is no CRS; return the path as a setting."""
    if crs is None:
        features = [
            {"type": "Feature", "properties": {"name": name}, "geometry": shape.__geo_interface__}
            for name, shape in shapes.items()
        ]
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
    else:
        table = geopandas.GeoDataFrame({"name": list(shapes)}, geometry=list(shapes.values()), crs=crs)
        table.to_file(path, engine="pyogrio", **choices)
    return str(path)
