"""Stored geolocation tables are read bit by bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import zarr

from spectralzoom.pipeline.errors import IncompleteStoreError
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.mirror import direction_to_position, scene_to_direction
from spectralzoom.pipeline.rectify.placed import PixelGrid, TieTable, tie_table
from spectralzoom.pipeline.rectify.scan_paths import ScanPath, make_scan_paths
from spectralzoom.storage.arrays.geolocation import open_geolocation, write_geolocation

CAMERA = LineCamera()


def tabulated(scan_px: np.ndarray) -> list[tuple[ScanPath, TieTable]]:
    """Return the scan paths of lines at these positions, each with its table."""
    tangents = np.stack([np.full_like(scan_px, 100.0), scan_px], axis=-1) * CAMERA.ifov_rad
    scan_paths = make_scan_paths(direction_to_position(scene_to_direction(tangents)), CAMERA)
    grid = PixelGrid((-5.0, -250.0), 1.0, (60, 700))
    return [(scan_path, tie_table(scan_path, CAMERA, grid, along="x")) for scan_path in scan_paths]


def test_geolocation_tables_round_trip(tmp_path: Path) -> None:
    """Scan paths that turn, dwell and have gaps, and their tables, are read as they were written."""
    there = np.concatenate([np.arange(20.0), np.arange(25.0, 50), [49.0, 49.0], np.arange(48.0, 0, -1)])
    tables = {"coarse 0": tabulated(np.arange(50.0)), "fine/1": tabulated(there), "dark": []}
    write_geolocation(tmp_path / "geolocation.zarr", tables)
    found = open_geolocation(tmp_path / "geolocation.zarr")
    assert list(found) == list(tables)
    for name, scan_paths in tables.items():
        assert len(found[name]) == len(scan_paths)
        for pair, again in zip(scan_paths, found[name], strict=True):
            for value, other in zip(pair, again, strict=True):
                for field in dataclasses.fields(value):
                    np.testing.assert_array_equal(getattr(other, field.name), getattr(value, field.name))
                    assert type(getattr(other, field.name)) is type(getattr(value, field.name))
    root = zarr.open_group(tmp_path / "geolocation.zarr", mode="r")
    assert root["sweep_0"].attrs["sweep"] == "coarse 0"
    assert root["sweep_0/scan_path_0"].attrs["spacing"] == 16
    assert 0 < root["sweep_0/scan_path_0"].attrs["bound_px"] <= 2e-3


def test_a_damaged_geolocation_store_is_refused(tmp_path: Path) -> None:
    """A missing store, a missing scan path and changed bytes each raise an error that names the place."""
    path = tmp_path / "geolocation.zarr"
    with pytest.raises(IncompleteStoreError, match=r"geolocation\.zarr cannot be read"):
        open_geolocation(path)
    write_geolocation(path, {"a": tabulated(np.arange(50.0))})
    chunk = next((path / "sweep_0" / "scan_path_0" / "scan" / "c").iterdir())
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"!")
    with pytest.raises(IncompleteStoreError, match="scan cannot be read"):
        open_geolocation(path)
    (path / "sweep_0" / "scan_path_0" / "zarr.json").unlink()
    with pytest.raises(IncompleteStoreError, match="scan_path_0"):
        open_geolocation(path)
