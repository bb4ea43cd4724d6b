"""Lookup tables as a stored artefact: one group a sweep, in it one a track, so that a second run makes none again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from pipeline.errors import IncompleteStoreError, ShapeError
from pipeline.rectify.placed import TieTable
from pipeline.rectify.tracks import Track
from storage.archive.keys import KEY_LENGTH
from storage.arrays.layout import create_group, damage_named, open_group, read_array, write_image, write_small

Tables = Mapping[str, Sequence[tuple[Track, TieTable]]]

_TANGENT = "tangent of the undeflected direction's plane"


def path_digest(
    position: NDArray[np.floating], usable: NDArray[np.bool_] | None = None, shift: NDArray[np.floating] | None = None
) -> str:
    """Name a sweep's path, in 20 hex digits, by all that its tracks depend on: which lines are usable, where they lie.

    Positions and their corrections ``shift`` are (line, 2), as of :func:`pipeline.rectify.tracks.make_tracks`. What a
    line that is not usable reports does not count, nor whether a correction is zero or none. Camera, binning, step and
    grid are the stage's own parameters. Raises ShapeError: arrays do not fit the lines.
    """
    lines = np.asarray(position, np.float64)
    flags = np.ones(len(lines), np.bool_) if usable is None else np.asarray(usable, np.bool_)
    moved = np.zeros_like(lines) if shift is None else np.asarray(shift, np.float64)
    if lines.ndim != 2 or lines.shape[1] != 2 or flags.shape != lines.shape[:1] or moved.shape != lines.shape:
        raise ShapeError(
            f"expected positions (line, 2), flags (line,) and shifts (line, 2), got {lines.shape}, {flags.shape} and"
            f" {moved.shape}"
        )
    digest = hashlib.sha256(flags.tobytes())
    for values in (lines, moved):
        digest.update(np.ascontiguousarray(values[flags] + 0.0, "<f8").tobytes())  # + 0.0: -0 and 0 are one place
    return digest.hexdigest()[:KEY_LENGTH]


def write_lookup(path: Path, tables: Tables, facts: Mapping[str, Any] | None = None) -> None:
    """Store the tracks and tie tables of sweeps, by name; ``facts`` are attributes: camera, grid, tolerance."""
    root = create_group(path, "lookup", {**(facts or {}), "sweeps": list(tables)})
    for number, (name, tracks) in enumerate(tables.items()):
        sweep = root.create_group(f"sweep_{number}", attributes={"sweep": name, "tracks": len(tracks)})
        for at, (track, table) in enumerate(tracks):
            _write_track(sweep, f"track_{at}", track, table)


def open_lookup(path: Path) -> dict[str, tuple[tuple[Track, TieTable], ...]]:
    """Read the tracks and tie tables of all sweeps, by name (IncompleteStoreError: the store is missing or damaged)."""
    root = open_group(path)
    with damage_named(str(path)):
        names = [str(name) for name in root.attrs["sweeps"]]  # type: ignore[union-attr]
    tables = {}
    for number, name in enumerate(names):
        sweep = _member(root, f"sweep_{number}")
        with damage_named(str(sweep.store_path)):
            count = int(sweep.attrs["tracks"])  # type: ignore[arg-type]
        tables[name] = tuple(_read_track(_member(sweep, f"track_{at}")) for at in range(count))
    return tables


def _write_track(sweep: zarr.Group, name: str, track: Track, table: TieTable) -> None:
    group = sweep.create_group(
        name,
        attributes={
            "width": track.width,
            "spacing": table.spacing,
            "shape": list(table.shape),
            "corner": list(table.corner),
            "kept": list(table.kept),
            "bound_px": table.bound_px,
            "samples": table.samples,
        },
    )
    about = {"long_name": "line centre on the scan axis", "units": "1", "comment": _TANGENT}
    write_small(group, "scan", ("knot",), track.scan, about)
    about = {"long_name": "line centre along the line", "units": "1", "comment": _TANGENT}
    write_small(group, "across", ("knot",), track.across, about)
    write_small(group, "lines", ("member",), track.lines.astype(np.int64), {"long_name": "line of each member"})
    write_small(group, "starts", ("knot",), track.starts.astype(np.int64), {"long_name": "first member of each knot"})
    write_small(group, "seen", ("knot",), track.seen, {"long_name": "whether any line saw the knot"})
    about = {"long_name": "knot coordinate and sample of every spacing-th pixel", "units": "1"}
    write_image(group, "ties", ("tie_y", "tie_x", "coordinate"), table.ties, about)


def _read_track(group: zarr.Group) -> tuple[Track, TieTable]:
    with damage_named(str(group.store_path)):
        about: dict[str, Any] = dict(group.attrs)
        width, bound = float(about["width"]), float(about["bound_px"])
        spacing, samples = int(about["spacing"]), int(about["samples"])
        shape, corner, kept = ((int(about[name][0]), int(about[name][1])) for name in ("shape", "corner", "kept"))
    seen = read_array(group, "seen")
    lines, starts = (read_array(group, name).astype(np.intp) for name in ("lines", "starts"))
    track = Track(read_array(group, "scan"), read_array(group, "across"), lines, starts, seen, width)
    return track, TieTable(read_array(group, "ties"), spacing, shape, bound, seen, samples, corner, kept)


def _member(group: zarr.Group, name: str) -> zarr.Group:
    with damage_named(f"{group.store_path}/{name}"):
        found = group[name]
    if not isinstance(found, zarr.Group):
        raise IncompleteStoreError(f"{group.store_path}/{name} is no group; run verify on the archive")
    return found
