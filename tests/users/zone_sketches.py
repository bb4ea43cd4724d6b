"""Write polygons as users have them: files of named outlines."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas
from shapely.geometry.base import BaseGeometry


def sketch(path: Path, shapes: Mapping[str, BaseGeometry], crs: Any) -> str:
    """Write polygons by name; return the path as a setting."""
    table = geopandas.GeoDataFrame({"name": list(shapes)}, geometry=list(shapes.values()), crs=crs)
    table.to_file(path, engine="pyogrio")
    return str(path)
