"""Compute the geolocation grid: where the samples of each line lie in the pixels of the scene."""

from __future__ import annotations

from spectralzoom.flows.stage import Output, stage
from spectralzoom.flows.stages.register import open_sweeps
from spectralzoom.pipeline.geometry.camera import LineCamera
from spectralzoom.pipeline.geometry.grid import SceneGrid
from spectralzoom.pipeline.rectify.placed import PixelGrid, TieTable
from spectralzoom.pipeline.rectify.scan_paths import ScanPath
from spectralzoom.storage.arrays.geolocation import write_geolocation
from spectralzoom.storage.store import Ref

TIE_POINTS = "geolocation.zarr"


MADE_BY = ("pipeline/rectify", "pipeline/geometry", "storage/arrays/geolocation.py")


@stage("geolocation grid", version=6, made_by=MADE_BY)
def locate(out: Output, signal: Ref, seams: Ref | None = None, *, camera: LineCamera, grid: SceneGrid) -> None:
    """Write the tie points of each sweep; none where they are not accurate enough."""
    tables: dict[str, list[tuple[ScanPath, TieTable]]] = {}
    sweeps = open_sweeps(signal, seams, camera)
    for number, one in enumerate(sweeps):
        made = one.placed(camera, PixelGrid.of_scene(grid)).scan_paths
        whole = [(scan_path, table) for scan_path, table in made if table is not None]
        # a sweep whose lines are too uneven for tie points is located directly
        tables[one.lines.sweep.name] = whole if len(whole) == len(made) else []
        out.report((number + 1) / len(sweeps))
    write_geolocation(out.path / TIE_POINTS, tables)
