"""Merge the class maps of georeferenced runs, such as those of tiles, to one image: `export --merge`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from spectralzoom.flows.archive.export_layers import ExportedRun, map_layers, warning_tag
from spectralzoom.flows.publish.receipt import load_receipt
from spectralzoom.flows.publish.scores import warnings_of
from spectralzoom.flows.settings.flags import check_outside
from spectralzoom.flows.terminal.processes import writing
from spectralzoom.flows.terminal.progress import show_text, show_warnings
from spectralzoom.pipeline.errors import IncompleteStoreError, SettingsError, ShapeError
from spectralzoom.pipeline.ground.georeference import crs_name
from spectralzoom.storage.export.image_files import Layer, merged_layer, write_cog
from spectralzoom.storage.store import Archive

MERGED = "class_map.tif"


def export_merged(archive: str | Path, out: Path, console: Console) -> dict[str, Any]:
    """Write the class maps of the newest run of each scene as one cloud-optimised GeoTIFF; the newest map is on top.

    Raises SettingsError: no run has a CRS, maps differ in CRS, pixel or classes, or ``out`` lies in the archive;
    ArchiveError: the file cannot be written.
    """
    opened = Archive.open(archive, create=False, write=False)
    path = check_outside(out, opened.root) / MERGED
    runs, left_out = _newest_runs(opened, partial(show_text, console=console))
    if not runs:
        raise SettingsError(f"no run of {opened.name} has a CRS, so there is nothing to merge; export runs one by one")
    layers = [map_layers(run)[0] for run in runs]
    for run, layer in zip(runs, layers, strict=True):
        _check_alike(runs[0], layers[0], run, layer)
    same = {name: text for name, text in layers[0].tags.items() if all(one.tags.get(name) == text for one in layers)}
    warned = [f"{run.id}: {one}" for run in runs for one in warnings_of(run.receipt)]
    show_warnings(warned, console)
    tags = {**same, "runs": ", ".join(run.id for run in runs), **warning_tag(warned)}
    with writing(out), TemporaryDirectory(prefix="spectralzoom-") as scratch, console.status(f"writing {path.name}"):
        out.mkdir(parents=True, exist_ok=True)
        write_cog(path, replace(merged_layer(layers, Path(scratch)), title="Class map", tags=tags))
    if left_out:
        console.print(f"[dim]note: runs without a CRS, left out: {escape(', '.join(left_out))}[/]", soft_wrap=True)
    console.print(f"  {escape(str(path))}", soft_wrap=True)
    return {"warnings": warned, "file": str(path), "runs": [run.id for run in runs]}


def _newest_runs(archive: Archive, note: Callable[[str], None]) -> tuple[list[ExportedRun], list[str]]:
    """Return the newest run with a CRS of each scene, the newest first, and the names of those without a CRS.

    ``note`` gets the damage of each run that is left out.
    """
    newest: dict[str, ExportedRun] = {}
    for folder in reversed(archive.runs()):
        try:
            run = ExportedRun(archive, folder, load_receipt(folder))
        except (IncompleteStoreError, ShapeError) as error:
            note(f"note: left out: {error}")
            continue
        newest.setdefault(str(run.receipt["settings"]["scene"]), run)
    runs = [run for run in newest.values() if run.geobox is not None]
    return runs, [run.id for run in newest.values() if run.geobox is None]


def _check_alike(first: ExportedRun, wanted: Layer, run: ExportedRun, found: Layer) -> None:
    """Refuse a map with another CRS, pixel or legend than the first, or a turned one (SettingsError)."""
    facts: Sequence[tuple[Any, ...]] = (
        ("CRS", crs_name(wanted.geobox), crs_name(found.geobox)),
        ("pixels of", *(f"{one.geobox.affine.a:.6g} x {one.geobox.affine.e:.6g}" for one in (wanted, found))),
        ("classes", *(list(one.legend.names) if one.legend else [] for one in (wanted, found))),
        ("rotation", 0.0, float(np.hypot(found.geobox.affine.b, found.geobox.affine.d))),
    )
    for what, expected, there in facts:
        if expected != there:
            raise SettingsError(
                f"the map of {run.id} has {what} {there}, expected {expected} as {first.id}; warp the tiles to one"
                " grid and survey them again, or export them one by one"
            )
