"""Store geolocation grids: a group for each sweep, in it one for each scan path with its tie points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from spectralzoom.pipeline.rectify.placed import TieTable
from spectralzoom.pipeline.rectify.scan_paths import ScanPath
from spectralzoom.storage.arrays import layout

Tables = Mapping[str, Sequence[tuple[ScanPath, TieTable]]]


def write_geolocation(path: Path, tables: Tables) -> None:
    """Store the scan paths and tie tables of sweeps, by name."""
    root = layout.create_group(path, "lookup", {"sweeps": list(tables)})
    for number, (name, scan_paths) in enumerate(tables.items()):
        sweep = root.create_group(f"sweep_{number}", attributes={"sweep": name, "scan_paths": len(scan_paths)})
        for at, (scan_path, table) in enumerate(scan_paths):
            _write_scan_path(sweep, f"scan_path_{at}", scan_path, table)


def open_geolocation(path: Path) -> dict[str, tuple[tuple[ScanPath, TieTable], ...]]:
    """Read scan paths and tie tables of all sweeps, by name (IncompleteStoreError: the store is missing or damaged)."""
    root = layout.open_group(path)
    tables: dict[str, tuple[tuple[ScanPath, TieTable], ...]] = {}
    with layout.damage_named(str(path)):
        for number, name in enumerate(root.attrs["sweeps"]):  # type: ignore[arg-type]
            sweep: Any = root[f"sweep_{number}"]
            count = int(sweep.attrs["scan_paths"])
            tables[str(name)] = tuple(_read_scan_path(sweep[f"scan_path_{at}"]) for at in range(count))
    return tables


def _write_scan_path(sweep: zarr.Group, name: str, scan_path: ScanPath, table: TieTable) -> None:
    group = sweep.create_group(
        name,
        attributes={
            "width": scan_path.width,
            "spacing": table.spacing,
            "shape": list(table.shape),
            "corner": list(table.corner),
            "kept": list(table.kept),
            "bound_px": table.bound_px,
            "samples": table.samples,
        },
    )
    tangent = {"units": "1", "comment": "tangent of the undeflected direction's plane"}
    columns: dict[str, tuple[str, NDArray[Any], dict[str, str]]] = {
        "scan": ("knot", scan_path.scan, {"long_name": "line centre on the scan axis", **tangent}),
        "across": ("knot", scan_path.across, {"long_name": "line centre along the line", **tangent}),
        "lines": ("member", scan_path.lines.astype(np.int64), {"long_name": "line of each member"}),
        "starts": ("knot", scan_path.starts.astype(np.int64), {"long_name": "first member of each knot"}),
        "seen": ("knot", scan_path.seen, {"long_name": "whether any line saw the knot"}),
    }
    for array, (dim, values, attributes) in columns.items():
        layout.write_small(group, array, (dim,), values, attributes)
    about = {"long_name": "knot coordinate and sample of every spacing-th pixel", "units": "1"}
    layout.write_image(group, "tie_points", ("tie_y", "tie_x", "coordinate"), table.tie_points, about)


def _read_scan_path(group: zarr.Group) -> tuple[ScanPath, TieTable]:
    about: dict[str, Any] = dict(group.attrs)
    spacing, samples = int(about["spacing"]), int(about["samples"])
    shape, corner, kept = ((int(about[name][0]), int(about[name][1])) for name in ("shape", "corner", "kept"))
    seen = layout.read_array(group, "seen")
    lines, starts = (layout.read_array(group, name).astype(np.intp) for name in ("lines", "starts"))
    scan_path = ScanPath(
        layout.read_array(group, "scan"), layout.read_array(group, "across"), lines, starts, seen, float(about["width"])
    )
    tie_points, bound = layout.read_array(group, "tie_points"), float(about["bound_px"])
    return scan_path, TieTable(tie_points, spacing, shape, bound, seen, samples, corner, kept)
